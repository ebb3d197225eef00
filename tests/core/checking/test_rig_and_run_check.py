"""`tricap check` of rigs and of results: every fault is made and must be named; the demo's rig and a finished run pass."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.checking.findings import Cause
from tricap.core.checking.rig_check import check_rig, wide_findings
from tricap.core.checking.run_check import check_run
from tricap.core.checking.take_check import check_clouds, check_first_frame
from tricap.core.cli import main
from tricap.core.fitting.inputs.start_joints import NeedsClick, StartJoints
from tricap.core.fitting.stages.set_up import NobodyFound
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig, write_rig
from tricap.core.geometry.view_angles import no_view_alike
from tricap.core.images.picture import decoded
from tricap.core.motion.formats.ply import read_ply, write_cloud
from tricap.core.motion.tables import read_joints
from tricap.core.run import pipeline
from tricap.core.run.take_run import open_run
from tricap.core.synthetic.arm import arm_rig
from tricap.core.synthetic.sample import unpack
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

SAMPLE = Path(__file__).resolve().parents[3] / "addon" / "sample.zip"

CAMERAS = arm_rig(768).cameras


def scaled(matrix: np.ndarray, focal: float = 1.0, shift_px: float = 0.0) -> np.ndarray:
    changed = matrix.copy()
    changed[0, 0], changed[1, 1], changed[0, 2] = matrix[0, 0] * focal, matrix[1, 1] * focal, matrix[0, 2] + shift_px
    return changed


def same_place() -> Rig:
    return Rig(cameras=(CAMERAS[0], replace(CAMERAS[1], R_cam_world=CAMERAS[0].R_cam_world, t_cam_world_m=CAMERAS[0].t_cam_world_m),
                        CAMERAS[2]))  # fmt: skip


def looking_away() -> Rig:
    turn = np.diag([-1.0, 1.0, -1.0])
    b = CAMERAS[2]
    return Rig(cameras=(CAMERAS[0], replace(b, R_cam_world=turn @ b.R_cam_world, t_cam_world_m=turn @ b.t_cam_world_m)))


def with_first(**changes: Any) -> Rig:
    return Rig(cameras=(replace(CAMERAS[0], **changes), *CAMERAS[1:]))


RIGS: dict[str, tuple[Rig, str]] = {
    "same place": (same_place(), "same place"),
    "looking away": (looking_away(), "no common view"),
    "in millimetres": (Rig(cameras=tuple(replace(c, t_cam_world_m=1000 * c.t_cam_world_m) for c in CAMERAS)), "unit"),
    "one camera": (Rig(cameras=CAMERAS[:1]), "one camera"),
    "focal length of another size": (with_first(matrix=scaled(CAMERAS[0].matrix, focal=0.1)), "odd camera"),
    "principal point of a crop": (with_first(matrix=scaled(CAMERAS[0].matrix, shift_px=300)), "odd camera"),
    "distortion that folds": (with_first(distortions=np.array([-3.0, 0.0, 0.0, 0.0, 0.0])), "odd camera"),
    "distortion that folds the middle": (with_first(distortions=np.array([-0.5, -0.5, 2.5, 2.5, -0.5])), "input"),
    "fisheye that folds": (with_first(fisheye=True, distortions=np.array([-4.0, 0.0, 0.0, 0.0, 0.0])), "odd camera"),
    "fisheye that folds the middle": (with_first(fisheye=True, distortions=np.array([-30.0, 0.0, 0.0, 0.0, 0.0])), "input"),
    "no width": (with_first(affinity=np.array([-1.0, 0.0])), "input"),
    "metres that are called millimetres": (Rig(cameras=tuple(replace(c, t_cam_world_m=c.t_cam_world_m / 1000) for c in CAMERAS)), "unit"),
    "poor by its own word": (Rig(cameras=CAMERAS, metadata={"verdict": "Poor: points within 20 mm."}), "poor calibration"),
    "red without a word for it": (
        Rig(cameras=CAMERAS, metadata={"verdict": "The adjustment did not converge.", "light": "red"}),
        "poor calibration",
    ),
    "large residuals": (Rig(cameras=CAMERAS, metadata={"sigma0_px": 2.5}), "poor calibration"),
}


@pytest.mark.parametrize("name", RIGS)
def test_a_fault_of_a_rig_is_named(name: str, tmp_path: Path) -> None:
    rig, cause = RIGS[name]
    write_rig(tmp_path / "rig.toml", rig)
    checked = check_rig(tmp_path / "rig.toml")
    assert cause in {f.cause for f in checked.findings}, checked.lines()
    assert json.dumps(checked.to_table(), allow_nan=False)


@pytest.mark.slow
def test_a_run_warns_of_cameras_at_the_same_position(arm_recording: Callable[..., Path]) -> None:
    """Its warnings had nothing but a wrong unit."""
    footage = open_take(read_take(arm_recording()))
    assert check_first_frame(footage, 0) == []
    a, b, c = footage.rig.cameras
    rig = Rig(cameras=(replace(b, name=a.name), b, c))
    assert "same place" in [finding.cause for finding in check_first_frame(replace(footage, rig=rig), 0)]


@pytest.mark.slow
@pytest.mark.parametrize("width", [1.04, 1.1])
def test_a_run_warns_of_a_camera_with_another_focal_length(arm_recording: Callable[..., Path], width: float) -> None:
    """Its rays still meet those of one other camera, so that a body was fitted without a word."""
    footage = open_take(read_take(arm_recording()))
    a, b, c = footage.rig.cameras
    rig = Rig(cameras=(replace(a, matrix=a.matrix * [[width, 1, 1], [1, 1, 1], [1, 1, 1]]), b, c))
    (finding,) = check_first_frame(replace(footage, rig=rig), 0)
    assert "along the epipolar lines" in finding.sentence and "calibrate again" in finding.advice
    assert any("along the epipolar lines" in said for said in check_clouds(replace(footage, rig=rig), [0], [900], [0.1], Monitor()))


def test_a_sound_rig_passes_and_a_broken_one_says_why(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", arm_rig(768))
    assert main.main(["check", str(tmp_path / "rig.toml")]) == 0
    (tmp_path / "rig.toml").write_text("[cam_0]\nname = 3")
    assert main.main(["check", str(tmp_path / "rig.toml")]) == 1


@pytest.fixture(scope="module")
def finished(arm_recording: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of five frames, and the take that it was made of beside it."""
    folder = tmp_path_factory.mktemp("run")
    shutil.copytree(arm_recording(), folder / "take")
    pipeline.run(folder / "take", folder / "out", {"growing": {"spacing_px": 6}, "skin": {"texture_px": 64}}, frames=(0, 5))
    return folder


def stopped(folder: Path) -> None:
    edit(folder, lambda run: run["stages"].clear())


def cloud_gone(folder: Path) -> None:
    (folder / "out" / "clouds" / "0002.ply").unlink()


def file_gone(folder: Path) -> None:
    (folder / "out" / "motion.csv").unlink()


def skin_gone(folder: Path) -> None:
    shutil.rmtree(folder / "out" / "skin")


def frames_cut_without_body(folder: Path) -> None:
    """The table of the frames belongs to every run, also where no body was asked for."""
    edit(folder, lambda run: run["stages"]["fit"].update(not_done="no body was asked for"))
    (folder / "out" / "frames.csv").write_text("")


def scene_cut(folder: Path) -> None:
    (folder / "out" / "body.blend").write_bytes(b"BLENDER17-01 and no end")


def take_changed(folder: Path) -> None:
    with open(folder / "take" / "take.toml", "a") as file:
        file.write("# another thought\n")


def edit(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    run = json.loads((folder / "out" / "run.json").read_text())
    change(run)
    (folder / "out" / "run.json").write_text(json.dumps(run))


def clouds(folder: Path, change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], frames: str = "*") -> None:
    for path in (folder / "out" / "clouds").glob(f"{frames}.ply"):
        v = change(dict(read_ply(path).vertex))
        write_cloud(path, xyz_m=np.stack([v[a] for a in "xyz"], 1), sigma_m=v["sigma"],
                    normals=np.stack([v[a] for a in ("nx", "ny", "nz")], 1), intensity=v["intensity"])  # fmt: skip


def thin(folder: Path) -> None:
    clouds(folder, lambda v: {name: a[::5] for name, a in v.items()}, "0003")


def unsure(folder: Path) -> None:
    clouds(folder, lambda v: v | {"sigma": v["sigma"] * 0 + 0.02})


def bare_forearm(folder: Path) -> None:
    def without(v: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        far = v["x"] > -0.33
        return {name: a[far] for name, a in v.items()}

    clouds(folder, without)


def unsure_angle(folder: Path) -> None:
    path = folder / "out" / "motion.csv"
    header, *rows = [line.split(",") for line in path.read_text().splitlines()]
    column = header.index("sigma elbow.R flexion")
    path.write_text("\n".join(",".join([*row[:column], "25.0", *row[column + 1 :]]) for row in rows).join([",".join(header) + "\n", "\n"]))


def warned(folder: Path) -> None:
    edit(folder, lambda run: run["warnings"].append("The rays of matched points miss each other by 2.0 px."))


def rays(folder: Path) -> None:
    edit(folder, lambda run: run["stages"]["measure"].update(residual_px=2.0))


def damaged(folder: Path) -> None:
    (folder / "out" / "run.json").write_text('{"format": "tricap-run", "stages": 3}')


RESULTS = {stopped: "not finished", cloud_gone: "frames missing", file_gone: "files missing", skin_gone: "files missing",
           frames_cut_without_body: "files missing", scene_cut: "files missing",
           take_changed: "stale result", thin: "coverage", unsure: "large sigma", bare_forearm: "coverage",
           unsure_angle: "large sigma", warned: "warning",
           rays: "rays miss", damaged: "input"}  # fmt: skip


@pytest.mark.slow
def test_a_finished_run_passes(finished: Path) -> None:
    checked = check_run(finished / "out", Monitor())
    assert [f for f in checked.findings if f.cause != "large sigma"] == [], checked.lines()  # the twist of 384 px may be unsure
    assert checked.figures["points_per_frame"] > 100 and "elbow.R flexion" in checked.figures["angle_sigma_deg"]


@pytest.mark.slow
@pytest.mark.parametrize("fault", RESULTS, ids=lambda fault: fault.__name__)
def test_a_fault_of_a_result_is_named(fault: Callable[[Path], None], finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "run")
    edit(tmp_path / "run", lambda run: run.update(take=str(tmp_path / "run" / "take")))
    fault(tmp_path / "run")
    sound = {f.sentence for f in check_run(finished / "out", Monitor()).findings}
    new = [f for f in check_run(tmp_path / "run" / "out", Monitor()).findings if f.sentence not in sound]
    assert RESULTS[fault] in {f.cause for f in new}, new


@pytest.mark.slow
def test_a_run_makes_again_what_is_gone_or_cut(finished: Path, tmp_path: Path) -> None:
    again = {"growing": {"spacing_px": 6}, "skin": {"texture_px": 64}}

    def damaged(out: Path) -> None:  # as long as before
        (out / "joints.csv").write_bytes(b"frame,TIME" + (out / "joints.csv").read_bytes()[10:])

    for spoil in (lambda out: (out / "clouds" / "0001.ply").unlink(), lambda out: (out / "joints.csv").write_bytes(b"frame,"), damaged):
        out = Path(shutil.copytree(finished / "out", tmp_path / "out", dirs_exist_ok=True))
        spoil(out)
        with open_run(finished / "take", out, again, (0, 5)) as job:
            assert not pipeline.is_complete(job)
        pipeline.run(finished / "take", out, again, frames=(0, 5))
        for name in ("clouds/0001.ply", "joints.csv"):
            assert (out / name).read_bytes() == (finished / "out" / name).read_bytes()


def test_a_run_that_came_to_no_end_is_named(plane_take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed, which leaves the lock, or stopped after some of its stages; and not where a command was to do no more."""
    out, given = tmp_path / "out", {"growing": {"spacing_px": 16}}

    def unfinished() -> list[str]:
        return [f.sentence for f in check_run(out, Monitor()).findings if f.cause == "not finished"]

    def stop(*_: object) -> None:
        raise Cancelled("Stopped.")

    with monkeypatch.context() as patch, pytest.raises(Cancelled):
        patch.setattr(pipeline, "write_report", stop)
        pipeline.run(plane_take, out, given, frames=(0, 2))
    assert unfinished() == [f"The run in {out} ended before its stage “report” was done."]
    assert main.main(["track", str(plane_take), "--out", str(out), "--frames", "0:2", "--quiet", "--set", "growing.spacing_px=16"]) == 0
    assert unfinished() == []
    with open_run(plane_take, out, given, (0, 2)) as job, pytest.raises(NobodyFound), job.resumable(stopped=str):
        job.record["stages"].pop("fit")  # the take wants no body
        raise NobodyFound("Click the left wrist.")
    asked = [f for f in check_run(out, Monitor()).findings if f.cause == "not finished"]
    assert [(f.sentence, f.advice) for f in asked] == [(f"The run in {out} ended with a question.", "Click the left wrist.")]
    pipeline.run(plane_take, out, given, frames=(0, 2))
    assert unfinished() == []
    (out / ".tricap-lock").write_text('{"pid": 1}')
    assert unfinished() == [f"A run in {out} was killed before its end, or is still at work (.tricap-lock)."]


def test_a_question_about_the_start_comes_with_a_picture(plane_take: Path, tmp_path: Path) -> None:
    """It is gone when the next fit begins."""
    out, joints = tmp_path / "out", {"elbow.R": np.array([0.0, 0.0, 1.5]), "wrist.R": np.array([0.1, 0.0, 1.5])}
    start = StartJoints(frame=1, xyz_m=joints, stature=1.0, model="arm.R", probability=0.6, rivals={"front and back": 0.4}, ask="wrist.R")
    picture = out / "report" / "question.png"
    with open_run(plane_take, out, {}, (0, 2)) as job:
        with pytest.raises(NeedsClick, match=f"Click the right wrist.*{re.escape(str(picture))} shows what was found there.$") as asked:
            with job.resumable(stopped=str):
                raise NeedsClick(start)
        assert job.results.read_run()["asks"] == str(asked.value) and decoded(picture).shape[2] == 3
        job.remove_body(())
        assert not picture.exists()
    with open_run(plane_take, out, {}, (0, 2)) as job:
        assert "asks" not in job.results.read_run(), "the question is asked again, if it still stands"


def test_a_question_whose_picture_cannot_be_made_is_asked(plane_take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreadable(*_: object) -> None:
        raise InputError("C/0001.png cannot be read.")

    start = StartJoints(frame=1, xyz_m={}, stature=1.0, model="arm.R", probability=0.6, rivals={}, ask="wrist.R")
    with open_run(plane_take, tmp_path / "out", {}, (0, 2)) as job:
        monkeypatch.setattr(type(job.footage), "read_whole", unreadable)
        with pytest.raises(NeedsClick, match="There is no picture of it: C/0001.png cannot be read"), job.resumable(stopped=str):
            raise NeedsClick(start)


def test_the_points_of_a_trunk_lie_on_its_flesh(tmp_path: Path) -> None:
    """A stout person, whose surface is nowhere near the spine, is as well measured as another one; bare shins are told."""
    unpack(SAMPLE, tmp_path / "sample")
    out = tmp_path / "sample" / "results"
    joints = read_joints(out / "joints.csv")
    for path in (out / "clouds").iterdir():
        v = read_ply(path).vertex
        low, high = (joints.joints_m[name][joints.frames.tolist().index(int(path.stem))] for name in ("pelvis", "neck"))
        xyz = np.stack([v[a] for a in "xyz"], 1)
        inner = (np.hypot(*(xyz - (low + high) / 2)[:, :2].T) < 0.13) & (v["z"] > low[2] - 0.05) & (v["z"] < high[2])
        rows = ~inner & (v["z"] > 0.35)
        write_cloud(path, xyz_m=xyz[rows], sigma_m=v["sigma"][rows], intensity=v["intensity"][rows],
                    normals=np.stack([v[a] for a in ("nx", "ny", "nz")], 1)[rows])  # fmt: skip
    (found,) = [f for f in check_run(out, Monitor()).findings if "hardly any measured points" in f.sentence]
    assert "foot.L" in found.sentence and "spine" not in found.sentence and "hip" not in found.sentence


def test_views_from_too_far_apart_are_found():
    def turned(degrees: float) -> list[Camera]:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return [CAMERAS[0], CAMERAS[1], replace(CAMERAS[2], R_cam_world=turn @ CAMERAS[1].R_cam_world)]

    assert not wide_findings(CAMERAS, 1) and not wide_findings(turned(40), 1)
    (found,) = wide_findings(turned(60), 1)
    assert found.cause == Cause.FAR_APART and "(60°)" in found.sentence and "hardly any surface" in found.sentence
    (found,) = wide_findings([turned(60)[2], CAMERAS[1]], 1)
    assert "no surface is measured" in found.sentence and no_view_alike([turned(60)[2], CAMERAS[1]], 1) and not no_view_alike(turned(60), 1)
    assert not wide_findings([*turned(60), CAMERAS[0]], 1)  # two others are near enough


def changed_rig(folder: Path, old: str, new: str) -> Path:
    path = folder / "rig.toml"
    write_rig(path, arm_rig(768))
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


@pytest.mark.parametrize("misspelt, known", [("distorsions", "distortions"), ("distortion", "distortions"), ("Distortions", "distortions"),
                                             ("affinty", "affinity"), ("fish_eye", "fisheye")])  # fmt: skip
def test_a_misspelt_key_of_a_camera_is_an_error(tmp_path: Path, misspelt: str, known: str) -> None:
    """All lenses were taken as free of distortion, without a word."""
    new = f"{misspelt} = " if known == "distortions" else f"{misspelt} = {'true' if known == 'fisheye' else '[0.0, 0.0]'}\ndistortions = "
    path = changed_rig(tmp_path, "distortions = ", new)
    said = check_rig(path).lines()
    assert any(f"has “{misspelt}”, which would be ignored; write “{known}”" in line for line in said), said


@pytest.mark.parametrize("old, new, said", [
    ("distortions = ", "# ", "has no `distortions`: its lens counts as free of distortion"),
    ("[cam_0]", 'units = "mm"\n[cam_0]', 'write unit = "mm" under [metadata]'),
    ("[metadata]\nunit", "[Metadata]\nunit", "did you mean [metadata]?"),
    ("unit = ", "units = ", "“units” under [metadata], which is not read"),
    ("distortions = ", "sigma = {focal = 5.0}\ndistortions = ", "has “focal”, which is no unknown"),
    ("distortions = ", "sigmas = {f = 5.0}\ndistortions = ", "has “sigmas”, which is not read; did you mean “sigma”?"),
])  # fmt: skip
def test_what_a_rig_lacks_or_names_nearly_is_named_by_the_check_and_the_run(
    plane_take: Path, tmp_path: Path, old: str, new: str, said: str
) -> None:
    path = changed_rig(tmp_path, old, new)
    if "units" in new:
        path.write_text(path.read_text(encoding="utf-8").replace('unit = "m"', ""), encoding="utf-8")
    assert any(said in line for line in check_rig(path).lines()), check_rig(path).lines()
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    text = (take / "rig.toml").read_text(encoding="utf-8")
    (take / "rig.toml").write_text(text.replace("distortions = ", "# "), encoding="utf-8")
    with open_run(take, tmp_path / "out", frames=(0, 2)) as job:
        assert sum("has no `distortions`" in warning for warning in job.record["warnings"]) == 3


def test_keys_of_other_tools_and_an_empty_list_of_distortions_are_no_finding(tmp_path: Path) -> None:
    path = changed_rig(
        tmp_path, "distortions = ", "rotation_count = 0\nerror = 0.3\nport = 1\nexposure = -5\ngrid_count = 20\ndistortions = "
    )
    path.write_text(path.read_text(encoding="utf-8") + "adjusted = false\nerror = 0.0\n[aruco]\nsize = 3\n", encoding="utf-8")
    assert check_rig(path).findings == ()
    lines = ["distortions = []" if line.startswith("distortions") else line for line in path.read_text(encoding="utf-8").splitlines()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert check_rig(path).findings == ()
