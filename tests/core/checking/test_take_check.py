"""`tricap check TAKE`: every fault is made and must be named, and sound recordings pass without a complaint."""

import json
import re
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest

from tricap.core.checking.findings import Cause, Checked
from tricap.core.checking.survey import Survey, picture_findings, rate_findings
from tricap.core.checking.take_check import check_clouds, check_take, joint_findings, sudden_gaps, sudden_step, timing_finding
from tricap.core.checking.timing import Film, TimeOffset, _between, energy_lags, estimate_offsets, lag_sigmas
from tricap.core.cli import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig, read_rig, write_rig
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.run import pipeline, take_run
from tricap.core.take.footage import open_take
from tricap.core.take.take import FrameClicks, Take, read_take

from ..images.test_sequence import with_a_pause

SHARED = Path(__file__).parents[4] / "shared" / "takes"
Record = Callable[..., Path]
Fault = Callable[[Path], None]


def pictures(take: Path, view: str) -> list[Path]:
    return sorted((take / view).glob("*.png"))


def change(path: Path, edit: Callable[[np.ndarray], np.ndarray]) -> None:
    picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    path.write_bytes(cv2.imencode(".png", np.clip(np.rint(edit(picture.astype(float))), 0, 255).astype(np.uint8))[1].tobytes())


def black(take: Path) -> None:
    for path in pictures(take, "L"):
        change(path, lambda p: p * 0 + 3)


def black_for_a_while(take: Path) -> None:
    for path in pictures(take, "R")[3:5]:
        change(path, lambda p: p * 0)


def identical(take: Path) -> None:
    shutil.rmtree(take / "R")
    shutil.copytree(take / "C", take / "R")


def identical_but_encoded_again(take: Path) -> None:
    identical(take)
    for i, path in enumerate(pictures(take, "R")):
        noise = np.random.default_rng(i).normal(0, 1.5, (240, 320))
        change(path, lambda p, noise=noise: 0.9 * p + 8 + noise)  # type: ignore[misc]


def swapped(take: Path) -> None:
    (take / "L").rename(take / "x")
    (take / "R").rename(take / "L")
    (take / "x").rename(take / "R")


def edit_rig(take: Path, **turn: np.ndarray) -> None:
    rig = read_rig(take / "rig.toml")
    cameras = []
    for c in rig.cameras:
        R = rotation_from_vector(turn.get(c.name, np.zeros(3)))  # about the camera's own centre
        cameras.append(replace(c, R_cam_world=R @ c.R_cam_world, t_cam_world_m=R @ c.t_cam_world_m))
    write_rig(take / "rig.toml", Rig(cameras=tuple(cameras), metadata=rig.metadata))


def foreign_rig(take: Path) -> None:
    edit_rig(take, L=np.array([0.04, 0.0, 0.02]), C=np.array([-0.03, 0.01, 0.0]))


def knocked_camera(take: Path) -> None:
    edit_rig(take, R=np.array([0.0026, 0.0, 0.0]))  # 1.6 px across the lines


def flat(take: Path, box: float) -> None:
    for view in "LCR":
        for i, path in enumerate(pictures(take, view)):
            noise, x = np.random.default_rng([i, ord(view)]).normal(0, 2, (240, 320)), np.arange(320)
            change(path, lambda p, i=i, x=x, noise=noise: 100 + box * ((x > 120 + 5 * i) & (x < 200 + 5 * i)) + noise)  # type: ignore[misc]


def no_texture(take: Path) -> None:
    flat(take, 0.0)


def plain_clothes(take: Path) -> None:
    flat(take, 60.0)


def smooth_sleeve(take: Path) -> None:
    for view in "LCR":
        for i, path in enumerate(pictures(take, view)):
            noise = np.random.default_rng([i, ord(view)]).normal(0, 2, (240, 320))
            change(path, lambda p, noise=noise: cv2.GaussianBlur(p, (0, 0), 7) + noise)  # type: ignore[misc]


def dark(take: Path) -> None:
    for path in pictures(take, "C"):
        change(path, lambda p: p * 0.08)


def overexposed(take: Path) -> None:
    for path in pictures(take, "L"):
        change(path, lambda p: p * 2.2)


def repeated(take: Path) -> None:
    files = pictures(take, "R")
    for i in (3, 5):
        shutil.copy(files[i - 1], files[i])


def frozen(take: Path) -> None:
    first, *rest = pictures(take, "R")
    for path in rest:
        shutil.copy(first, path)


def a_frame_late(take: Path) -> None:
    text = (take / "take.toml").read_text().replace('images = "R/*.png"', 'images = "R/*.png"\noffset_frames = -1')
    (take / "take.toml").write_text(text.replace("fps", "frames = [1, 7]\nfps").replace("frame = 0", "frame = 1"))


def seed_on_the_wall(take: Path) -> None:
    wall = np.array([-0.6, 1.2, 1.8])
    at = {c.name: c.project(wall) for c in read_rig(take / "rig.toml").cameras}
    said = ", ".join(f"{name} = [{x:.1f}, {y:.1f}]" for name, (x, y) in at.items())
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text[: text.index("[seeds.joints]")] + f"surface = [{{ {said} }}]\n")


def contradicting_click(take: Path) -> None:
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text[: text.index('"wrist.R"')] + '"wrist.R" = { L = [20.0, 20.0], C = [290.0, 210.0] }\n')


def nobody_clicked(take: Path) -> None:
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text[: text.index("[seeds")])


def one_joint_clicked(take: Path) -> None:
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(re.sub('(?m)^"(shoulder|elbow)[.]R".*$', "", text))


def image_gone(take: Path) -> None:
    pictures(take, "C")[5].unlink()


def image_gone_near_the_end(take: Path) -> None:
    """Each view has as many images as the take asks for, and too few for a gap to stand out by itself."""
    for view in "LCR":
        for path in pictures(take, view)[3:]:
            path.unlink()
    pictures(take, "L")[1].unlink()
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text.replace("fps", "frames = [0, 2]\nfps"))


def other_size(take: Path) -> None:
    for path in pictures(take, "L"):
        change(path, lambda p: p[:-8])


FAULTS = {
    black: "blank view", black_for_a_while: "blank view", identical: "identical views", identical_but_encoded_again: "identical views",
    swapped: "swapped views", foreign_rig: "foreign rig", knocked_camera: "stale calibration", no_texture: "no texture",
    plain_clothes: "no texture",
    smooth_sleeve: "weak texture", dark: "dark", overexposed: "overexposed", repeated: "repeated frames", frozen: "frozen view",
    a_frame_late: "out of step", nobody_clicked: "no clicks", one_joint_clicked: "few clicks",
    seed_on_the_wall: "seed on the background", contradicting_click: "clicks", image_gone: "input", other_size: "input",
    image_gone_near_the_end: "frames missing",
}  # fmt: skip


TOGETHER = {nobody_clicked: knocked_camera, one_joint_clicked: repeated, contradicting_click: overexposed, seed_on_the_wall: dark}


@pytest.fixture(scope="module")
def checked_with(arm_recording: Record, tmp_path_factory: pytest.TempPathFactory) -> Callable[[Fault], Checked]:
    """What is found in a recording with a fault. Those of clicks are checked together with one of the images or the rig, once."""

    @cache
    def check(*faults: Fault) -> Checked:
        take = Path(shutil.copytree(arm_recording(), tmp_path_factory.mktemp("fault") / "take"))
        for make in faults:
            make(take)
        return check_take(take, Monitor())

    pairs = {fault: (first, second) for first, second in TOGETHER.items() for fault in (first, second)}
    return lambda fault: check(*pairs.get(fault, (fault,)))


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda make: make.__name__)
def test_the_fault_is_named(checked_with: Callable[[Fault], Checked], fault: Fault) -> None:
    checked, cause = checked_with(fault), FAULTS[fault]
    assert cause in {f.cause for f in checked.findings}, checked.lines()
    named = next(f for f in checked.findings if f.cause == cause)
    assert named.sentence.endswith(".") and str(checked.to_table())
    json.dumps(checked.to_table(), allow_nan=False)
    if cause in ("blank view", "identical views", "swapped views", "foreign rig", "no texture"):
        assert named.certain and named.advice


@pytest.mark.slow
def test_a_sound_recording_passes(arm_recording: Record) -> None:
    assert check_take(arm_recording(), Monitor()).lines()[0].endswith("no problems found.")


@pytest.mark.parametrize("take", [pytest.param(p, id=p.name) for p in (SHARED / "dev_arm", SHARED / "dev_walk")])
@pytest.mark.slow
def test_the_development_recordings_pass(take: Path) -> None:
    if not take.exists():
        pytest.skip(f"{take} is not on this machine")
    checked = check_take(take, Monitor())
    assert not checked.findings, checked.lines()


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.25, 0.5, -1.3])
def test_a_late_view_is_found_to_a_twentieth_of_a_frame(arm_recording: Record, late: float) -> None:
    """Measured: 0.010 frames at worst at 480 and 384 px."""
    told: list[tuple[str, float]] = []
    monitor = Monitor(lambda stage, done, total: told.append((stage, done / total)))
    offsets = {o.view: o for o in estimate_offsets(open_take(read_take(arm_recording(late_frames=late))), monitor)}
    parts = [part for stage, part in told if stage == "synchronization"]
    assert parts == sorted(parts) and len(parts) > 1, "the bar never goes back"
    assert abs(offsets["R"].delay_frames - late) < 0.05 and offsets["R"].significant
    assert abs(offsets["L"].delay_frames) < 0.02 and not offsets["L"].significant
    assert (offsets["C"].method, offsets["C"].delay_frames) == ("reference", 0.0)


def test_whole_frames_from_the_motion_alone() -> None:
    motion = np.abs(np.sin(np.arange(60) ** 1.3)) + 0.1
    for lag in (-7, 0, 4):
        lags, correlation = energy_lags(motion[10:50], 3 * motion[10 - lag : 50 - lag] + 2)
        assert lags[0] == lag and correlation > 0.99
    assert energy_lags(motion[:40], np.ones(40))[1] == 0


def rhythm(n: int, seed: int = 0) -> np.ndarray:
    """The energy (n,) of a motion that never repeats."""
    random = np.random.default_rng(seed)
    return np.asarray(np.abs(np.convolve(random.normal(size=n + 6), np.hanning(7), "valid"))) + 0.1


def told(a: np.ndarray, b: np.ndarray, *, degrees: float = 20.0) -> TimeOffset:
    """What is said of views, so far apart, in which nothing can be followed, by how much moves in them when."""
    beside = Camera(name="R", size_px=(9, 9), matrix=np.eye(3), R_cam_world=rotation_from_vector(np.array([0, np.radians(degrees), 0])))
    seen = SimpleNamespace(energy=np.stack([a, b]))
    footage = SimpleNamespace(interval_frames=lambda view: 1.0)
    film = SimpleNamespace(survey=seen, cameras=(replace(beside, name="C", R_cam_world=np.eye(3)), beside), frames=list, footage=footage)
    return _between(cast(Film, film), 0, 1, "R", Monitor())


def test_views_that_show_one_movement_from_two_sides_are_not_called_out_of_step() -> None:
    """Ten frames, one rise and fall, sooner in one view than in the other: that is one sample, however well it goes together."""
    t = np.arange(10)
    a, b = 1 + np.exp(-(((t - 6) / 3) ** 2)), 1 + np.exp(-(((t - 4) / 3) ** 2))
    lags, correlation = energy_lags(a, b)
    assert lags[0] == -2 and correlation > 0.99 and lag_sigmas(a, b, -2) < 2
    assert told(a, b).method == "nothing" and not told(a, b).doubtful
    assert (told(a, a).method, told(a, a).delay_frames) == ("energy", 0.0)


def test_many_movements_tell_whole_frames_of_views_that_are_not_far_apart() -> None:
    motion, noise = rhythm(154), 0.1 * rhythm(150, seed=1)
    late = told(motion[:150], motion[4:] + noise)
    assert (late.method, late.delay_frames) == ("energy", 4.0) and late.doubtful
    said = timing_finding(late)
    assert not said.certain and "View R seems to be 4 frames later" in said.sentence and "add -4 to" in said.advice
    assert told(motion[:150], motion[4:] + noise, degrees=60).method == "nothing"


def test_what_only_the_rhythm_tells_is_a_finding_from_three_sigmas_on() -> None:
    late = {lag: TimeOffset(view="R", delay_frames=lag, sigma_frames=0.5, method="energy") for lag in (0.0, 0.15, -1.0, 2.0)}
    assert [lag for lag, offset in late.items() if offset.doubtful] == [2.0]


@pytest.mark.slow
def test_a_take_of_one_frame_has_no_motion_to_look_for(arm_recording: Record, tmp_path: Path) -> None:
    take = Path(shutil.copytree(arm_recording(), tmp_path / "take"))
    said = take / "take.toml"
    said.write_text(said.read_text(encoding="utf-8").replace("fps", "frames = [0, 1]\nfps"), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checked = check_take(take, Monitor())
    assert not checked.findings, checked.lines()


def test_exit_codes_and_json(arm_recording: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(arm_recording(), tmp_path / "take")
    assert main.main(["check", str(tmp_path / "take"), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["good"] and table["kind"] == "take" and table["figures"]["offsets"]["R"]["from"] == "rays"
    image_gone(tmp_path / "take")
    assert main.main(["check", str(tmp_path / "take"), "--quiet"]) == 1
    assert main.main(["check", str(tmp_path / "nothing")]) == 2


MEASURED = {black: "View L is black", identical: "show the same image", swapped: "L and R are swapped",
            foreign_rig: "rig.toml", no_texture: "is blank", frozen: "View R shows the same image",
            seed_on_the_wall: "Surface seed 1"}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("make", MEASURED, ids=lambda make: make.__name__)
def test_measuring_it_all_the_same_names_the_cause(make: Callable[[Path], None], arm_recording: Record, tmp_path: Path) -> None:
    """An error where nothing can be measured, a warning in run.json where something can."""
    shutil.copytree(arm_recording(), tmp_path / "take")
    make(tmp_path / "take")
    try:
        with take_run.open_run(tmp_path / "take", tmp_path / "out", {"growing": {"spacing_px": 16}}, frames=(0, 3)) as run:
            pipeline.measure(run, Monitor())
            assert any(MEASURED[make] in sentence for sentence in run.record["warnings"]), run.record["warnings"]
    except InputError as error:
        assert MEASURED[make] in str(error)


def test_every_run_tells_a_variable_frame_rate(arm_recording: Record, tmp_path: Path) -> None:
    """Though its own frames were all found in the checkpoints, and none was decoded."""
    take = Path(shutil.copytree(arm_recording(), tmp_path / "take"))
    shots = [cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR) for path in pictures(take, "R")]
    writer = cv2.VideoWriter(str(take / "r.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 25.0, shots[0].shape[1::-1])
    for shot in shots:
        writer.write(shot)
    writer.release()
    said = take / "take.toml"
    said.write_text(said.read_text(encoding="utf-8").replace('images = "R/*.png"', 'movie = "r.mp4"'), encoding="utf-8")
    assert not [s for s in check_clouds(open_take(read_take(take)), [0], [9], [0.1], Monitor()) if "frame rate" in s]
    (take / "r.mp4").write_bytes(with_a_pause((take / "r.mp4").read_bytes()))
    assert [s for s in check_clouds(open_take(read_take(take)), [0], [9], [0.1], Monitor()) if "View R has a variable frame rate" in s]


def with_movies(take: Path, rates: dict[str, float]) -> None:
    """Motion JPEG instead of the images of some views, at these rates."""
    said = (take / "take.toml").read_text(encoding="utf-8")
    for view, rate in rates.items():
        shots = [cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR) for path in pictures(take, view)]
        writer = cv2.VideoWriter(str(take / f"{view}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), rate, shots[0].shape[1::-1])
        for shot in shots:
            writer.write(shot)
        writer.release()
        said = said.replace(f'images = "{view}/*.png"', f'movie = "{view}.avi"')
    (take / "take.toml").write_text(said, encoding="utf-8")


def lose_image(path: Path, number: int) -> None:
    """Leave the data of an image of an AVI file empty, as recorders do with images that they lost; the file keeps its length."""
    data = bytearray(path.read_bytes())
    at = data.index(b"00dc", data.index(b"movi"))
    for _ in range(number):
        at = data.index(b"00dc", at + 8 + int.from_bytes(data[at + 4 : at + 8], "little"))
    length = int.from_bytes(data[at + 4 : at + 8], "little")
    data[at : at + 16] = b"00dc" + bytes(4) + b"JUNK" + (length + length % 2 - 8).to_bytes(4, "little")
    entry = data.index(b"idx1") + 8 + 16 * number
    data[entry + 12 : entry + 16] = bytes(4)
    path.write_bytes(data)


def test_an_image_that_a_recorder_lost_is_told_by_check_and_by_every_run(arm_recording: Record, tmp_path: Path) -> None:
    take = Path(shutil.copytree(arm_recording(), tmp_path / "take"))
    with_movies(take, {"R": 25.0})
    footage = open_take(read_take(take))
    assert not [f for f in rate_findings(footage) if f.cause in (Cause.FRAMES_MISSING, Cause.VARIABLE_FRAME_RATE)]
    lose_image(take / "R.avi", 3)
    last = footage.sequences[-1].count - 1
    (take / "take.toml").write_text(f"frames = [0, {last}]\n" + (take / "take.toml").read_text(encoding="utf-8"), encoding="utf-8")
    (said,) = [s for s in check_clouds(open_take(read_take(take)), [0], [9], [0.1], Monitor()) if "time stamps" in s]
    assert "of view R show that images are missing in one place, before its image 3" in said


def test_movies_of_another_rate_than_the_takes_are_told(arm_recording: Record, tmp_path: Path) -> None:
    take = Path(shutil.copytree(arm_recording(), tmp_path / "take"))
    rate = read_take(take).fps
    with_movies(take, {"L": rate, "R": 2 * rate})
    (found,) = rate_findings(open_take(read_take(take)))
    assert found.cause is Cause.FRAME_RATE and "per second in view R" in found.sentence and "view L" not in found.sentence
    said = (take / "take.toml").read_text(encoding="utf-8").replace('"R.avi"', f'"R.avi"\nfps = {2 * rate}')
    (take / "take.toml").write_text(said, encoding="utf-8")
    assert not rate_findings(open_take(read_take(take)))


@pytest.mark.slow
def test_a_frame_that_a_view_lost_in_mid_clip_is_told(arm_recording: Record, tmp_path: Path) -> None:
    take = Path(shutil.copytree(arm_recording(), tmp_path / "take"))
    said = {}
    for name in ("sound", "lost"):
        with take_run.open_run(take, tmp_path / name, {"growing": {"spacing_px": 16}}) as run:
            pipeline.measure(run, Monitor())
        said[name] = [s for s in run.record["warnings"] if "a view may have lost" in s]
        shots = pictures(take, "R")
        for here, there in zip(shots[4:], shots[5:]):
            shutil.copyfile(there, here)
    assert not said["sound"] and len(said["lost"]) == 1 and said["lost"][0].startswith("From frame 4 on, the rays"), said


def test_a_frame_with_much_fewer_points_than_its_neighbours_is_named() -> None:
    """A JPEG with a damaged part is filled with grey by the decoder, and half of the person was missing without a word."""
    frames, points = list(range(10, 20)), np.linspace(2000.0, 1400.0, 10)
    assert not sudden_gaps(frames, points)
    (said,) = sudden_gaps(frames, np.where(np.arange(10) == 4, 0.5 * points, points))
    assert said.startswith("Frame 14 has 867 measured points, and the frames beside it up to 1667: look at its images")
    (said,) = sudden_gaps(frames, np.where(np.isin(np.arange(10), (4, 5, 8)), 0.5 * points, points))
    assert "Frame 14" in said and "(and 2 more frames likewise)" in said
    assert not sudden_gaps(frames, np.where(np.arange(10) < 3, 0.0, points)), "the person enters later"
    assert not sudden_gaps(frames, 0.02 * np.where(np.arange(10) == 4, 0.5 * points, points)), "few points vary by chance"
    assert not sudden_gaps([0], np.array([2000.0]))


def test_steps_that_are_none() -> None:
    steady = 0.1 * np.exp(np.random.default_rng(0).normal(0, 0.1, 40))
    assert not sudden_step(list(range(40)), steady)
    assert not sudden_step(list(range(40)), steady * np.where(np.arange(40) == 20, 9.0, 1.0)), "one frame is no step"
    assert not sudden_step(list(range(40)), 0.01 * steady * np.where(np.arange(40) > 20, 3.0, 1.0)), "it harms nobody"
    assert sudden_step(list(range(10, 50)), steady * np.where(np.arange(40) >= 20, 3.0, 1.0))[0].startswith("From frame 30 on")
    assert sudden_step(list(range(8)), np.array([0.1] * 4 + [0.3] * 4)) and not sudden_step(list(range(7)), np.array([0.1] * 3 + [0.3] * 4))


@pytest.mark.parametrize(("repeats", "harmless"), [((7,), True), ((3, 7), False), ((), None)])
def test_one_repeated_frame_is_a_remark_and_several_are_wrong(repeats: tuple[int, ...], harmless: bool | None) -> None:
    """A camera that drops a frame now and then harms nothing; a conversion to another frame rate does."""
    energy, like = 1.0 + rhythm(12)[None], np.full((1, 12), 50.0)
    energy[0, list(repeats)] = 0.0
    found = picture_findings(Survey(frames=range(12), energy=energy, spread=like, bright=3 * like, white=0 * like), ("R",))
    assert [finding.harmless for finding in found] == ([] if harmless is None else [harmless])
    for finding in found:
        assert str(finding).startswith("Note: " if harmless else "Wrong: ") and finding.figures == {
            "frames": len(repeats),
            "first": repeats[0],
        }


def repeats_of(*energy: np.ndarray) -> list[tuple[str, int, int]]:
    """Frames that are said to be repeated in views of such motion energies (T,)."""
    like = np.full((len(energy), len(energy[0])), 50.0)
    names = tuple("LCR"[: len(energy)])
    found = picture_findings(Survey(frames=range(12), energy=np.stack(energy), spread=like, bright=3 * like, white=0 * like), names)
    return [(str(finding.sentence[5]), int(finding.figures["frames"]), int(finding.figures["first"])) for finding in found]


def test_a_person_who_is_not_there_yet_or_stands_still_is_no_repeated_frame() -> None:
    moving, frames = 1.0 + rhythm(12), np.arange(12)
    for still in (frames < 5, frames > 8, (frames > 3) & (frames < 8)):
        quiet = np.where(still, 0.03, moving)  # the noise alone
        assert not repeats_of(quiet) and not repeats_of(quiet, quiet) and not repeats_of(quiet, moving)
        frozen = np.where(still, 0.0, moving)
        assert repeats_of(frozen, moving) == [("L", still.sum(), np.argmax(still))]
    brief = np.where((frames > 3) & (frames < 7), 0.03, moving)
    assert repeats_of(brief, moving) == [("L", 3, 4)] and repeats_of(brief, brief) == [("L", 3, 4), ("C", 3, 4)]


@pytest.mark.slow
@pytest.mark.parametrize("view", ["L", "C", "R"])
def test_a_camera_that_was_moved_along_its_base_is_named(arm_recording: Record, tmp_path: Path, view: str) -> None:
    """Every pair of views agrees with the rig still, and half of the points were lost."""
    take = Path(shutil.copytree(arm_recording(), tmp_path / "take"))
    rig = read_rig(take / "rig.toml")
    shift = 0.01 * (rig["R"].centre_m - rig["L"].centre_m) / np.linalg.norm(rig["R"].centre_m - rig["L"].centre_m)
    moved = tuple(c if c.name != view else replace(c, t_cam_world_m=c.t_cam_world_m - c.R_cam_world @ shift) for c in rig.cameras)
    write_rig(take / "rig.toml", replace(rig, cameras=moved))
    found = [finding for finding in check_take(take, Monitor()).findings if finding.cause == Cause.STALE_CALIBRATION]
    assert len(found) == 1 and "along the epipolar lines" in found[0].sentence, found


def test_a_black_image_does_not_make_the_others_repeats() -> None:
    energy, spread = np.array([[np.nan, 1.0, 60.0, 60.0]]), np.array([[50.0, 50.0, 0.0, 50.0]])
    found = picture_findings(Survey(frames=range(4), energy=energy, spread=spread, bright=3 * spread, white=0 * spread), ("C",))
    assert not [finding for finding in found if finding.cause == Cause.REPEATED_FRAMES]


def test_a_keyframe_clicked_in_one_view_is_told() -> None:
    views = {name: np.zeros(2) for name in "LC"}
    keys = (FrameClicks(frame=3, joints={"elbow.L": {"L": np.zeros(2)}, "wrist.L": views}), FrameClicks(frame=9, joints={"neck": views}))
    take = SimpleNamespace(clicks=FrameClicks(), keyframes=keys, body_model="full", joints_model="full", keypoints=())
    told = joint_findings(cast(Take, take))[0]
    assert told.harmless and "in one view only: elbow.L (frame 3)." in told.sentence


def test_a_remark_is_no_finding_of_a_check(arm_recording: Record, tmp_path: Path) -> None:
    take = Path(shutil.copytree(arm_recording(), tmp_path / "take"))
    files = pictures(take, "R")
    shutil.copy(files[2], files[3])
    checked = check_take(take, Monitor())
    assert not checked.findings and len(checked.notes) == 2 and "View R repeats the frame before in frame 3" in checked.lines()[1]
    assert checked.to_table()["good"] and checked.to_table()["notes"] == list(checked.notes)
