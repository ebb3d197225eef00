"""What a change concerns: the right stages become stale, and only those."""

import json
import os
import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.cli import main
from tricap.core.foundation import store
from tricap.core.foundation.progress import Monitor
from tricap.core.results import edited_tables
from tricap.core.run import pipeline, take_run
from tricap.core.run import settings as run_settings
from tricap.core.run.check import check_run
from tricap.core.run.file_digests import FileDigests
from tricap.core.run.stages import (
    CONTENT,
    STAGE_INPUTS,
    STAGES,
    STAMPED,
    WITHOUT_STAGE,
    Stamp,
    coarse_time_stamp,
    known_keys,
    stage_keys,
    stage_of,
    valid_stages,
)
from tricap.core.take.footage import open_take
from tricap.core.take.take import Take
from tricap.core.take.writing import read_table, take_of_table

from ..conftest import Body, three_cameras, write_take

JOINTS = {"shoulder.R": {"L": [50.0, 40.0], "C": [52.0, 40.0]}, "elbow.R": {"L": [90.0, 70.0], "C": [92.0, 70.0]}}


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stages") / "take"
    return write_take(folder, three_cameras(), [[Body()]] * 4)


def keys(folder: Path, overrides: dict[str, Any] | None = None, stamp: Stamp | None = None, **changes: Any) -> dict[str, str]:
    table = read_table(folder) | {"seeds": {"frame": 1, "joints": JOINTS}, "body": {"model": "arm.R"}} | changes
    take = take_of_table(folder, table)
    return stage_keys(open_take(take), take_run.settings_of(take.settings, overrides or {}, "the test"), folder / "out", stamp)


def stale(folder: Path, overrides: dict[str, Any] | None = None, **changes: Any) -> list[str]:
    before, now = keys(folder), keys(folder, overrides, **changes)
    return [stage for stage in STAGES if before[stage] != now[stage]]


MOVED = {**JOINTS, "elbow.R": {"L": [90.5, 70.0], "C": [92.0, 70.0]}}


@pytest.mark.parametrize(
    ("first", "group", "changes"),
    [
        ("measure", "matching", {}),
        ("measure", "enhance", {}),
        ("measure", "", {"interlaced": "odd"}),
        ("measure", "", {"frames": [0, 3]}),
        ("measure", "", {"reference_view": "L"}),
        ("measure", "", {"seeds": {"frame": 1, "joints": MOVED}}),
        ("measure", "", {"corrections": [{"kind": "region", "view": "L", "frames": [0, 2], "polygon": [[0, 0], [9, 0], [9, 9]]}]}),
        ("track", "tracking", {}),
        ("track", "", {"fps": 50.0}),
        ("track", "", {"corrections": [{"kind": "trajectory", "view": "L", "frame": 0, "xy": [5, 5]}]}),
        ("fit", "fitting", {}),
        ("fit", "skin", {}),
        ("fit", "", {"body": {"model": "arm.L"}}),
        ("fit", "", {"body": {"model": "none"}}),
        ("fit", "", {"body": {"model": "arm.R", "locked": ["elbow.R twist"]}}),
        ("fit", "", {"body": {"model": "arm.R", "limits": {"elbow.R flexion": [0, 90]}}}),
        ("fit", "", {"keyframes": [{"frame": 3, "joints": MOVED}]}),
    ],
)
def test_a_change_concerns_its_stage_and_those_after_it(take: Path, first: str, group: str, changes: dict[str, Any]) -> None:
    overrides = {group: other_than_default(group)} if group else {}
    assert stale(take, overrides, **changes) == list(STAGES[STAGES.index(first) :])


def other_than_default(group: str) -> dict[str, Any]:
    """One knob of the group, changed."""
    for name, knob in run_settings.SETTINGS[group].__dataclass_fields__.items():
        high = knob.metadata["high"]
        if not isinstance(knob.default, (str, bool)) and high is not None and high > knob.default:
            return {name: high}
    for name, knob in run_settings.SETTINGS[group].__dataclass_fields__.items():
        if isinstance(knob.default, bool):
            return {name: not knob.default}
    raise AssertionError(group)


def test_the_order_of_clicks_and_locks_is_no_change(take: Path) -> None:
    """Blender writes joints in the order of the body, people in any; what ran from one take.toml is done for the other."""
    assert stale(take, seeds={"frame": 1, "joints": dict(reversed(JOINTS.items()))}) == []
    bodies = [
        {"model": "arm.R", "locked": locked} for locked in (["elbow.R twist", "elbow.R flexion"], ["elbow.R flexion", "elbow.R twist"])
    ]
    assert stale(take, body=bodies[0]) == ["fit"] and keys(take, body=bodies[0]) == keys(take, body=bodies[1])


def test_nothing_changed_nothing_is_stale_and_a_moved_folder_is_no_change(take: Path, tmp_path: Path) -> None:
    shutil.copytree(take, tmp_path / "moved")
    assert stale(take) == [] and keys(take) == keys(tmp_path / "moved")


def test_other_cameras_and_other_footage_concern_everything(take: Path, tmp_path: Path) -> None:
    moved = tmp_path / "other"
    shutil.copytree(take, moved)
    store.write_text(moved / "rig.toml", (moved / "rig.toml").read_text(encoding="utf-8") + "\n")
    assert all(a != b for a, b in zip(keys(take).values(), keys(moved).values()))
    shutil.rmtree(moved)
    shutil.copytree(take, moved)
    with open(moved / "L" / "0002.png", "ab") as file:
        file.write(b"more")
    assert all(a != b for a, b in zip(keys(take).values(), keys(moved).values()))


def test_footage_exported_again_with_the_same_size_concerns_everything(take: Path, tmp_path: Path) -> None:
    shutil.copytree(take, tmp_path / "take")
    path = tmp_path / "take" / "L" / "0002.png"
    os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns + 2_000_000_000))
    assert all(a != b for a, b in zip(keys(take).values(), keys(tmp_path / "take").values()))


def test_another_image_of_the_same_size_and_second_concerns_everything(take: Path, tmp_path: Path) -> None:
    """Times were compared in whole seconds."""
    shutil.copytree(take, tmp_path / "take")
    path = tmp_path / "take" / "L" / "0002.png"
    os.utime(path, ns=(0, 1_000_200_000_000))
    run = finished(tmp_path / "take")
    other_picture(path)
    os.utime(path, ns=(0, 1_000_900_000_000))
    assert known(tmp_path / "take", run) == []
    large = {"stages": {stage: {"key": key} for stage, key in keys(take, stamp=coarse_time_stamp).items()}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tricap.core.run.stages.reads_content", lambda footage: False)
        for image in (take / "L").glob("*.png"):
            time = image.stat().st_mtime_ns
            os.utime(image, ns=(0, time // 1_000_000_000 * 1_000_000_000))
        assert known(take, large) == list(STAGES), "of a take whose content is not read, a file system with coarse times is the same"


def test_a_run_of_a_version_that_compared_whole_seconds_is_still_known(take: Path, tmp_path: Path) -> None:
    content = keys(take, stamp=FileDigests().stamp)
    run = {"stages": {s: {"key": key, CONTENT: content[s]} for s, key in keys(take, stamp=coarse_time_stamp).items()}}
    assert known(take, run) == list(STAGES)


def finished(folder: Path) -> dict[str, Any]:
    """What run.json has of a run of all stages."""
    content = keys(folder, stamp=FileDigests().stamp)
    return {"stages": {stage: {"key": key, CONTENT: content[stage]} for stage, key in keys(folder).items()}}


def copied(take: Path, to: Path) -> Path:
    """A copy of everything, made later, as by `cp -r`."""
    shutil.copytree(take, to, copy_function=shutil.copyfile)
    for path in to.rglob("*.png"):
        os.utime(path, ns=(0, path.stat().st_mtime_ns + 5_000_000_000))
    return to


def known(folder: Path, run: dict[str, Any], overrides: dict[str, Any] | None = None, **changes: Any) -> list[str]:
    """The stages that are done in a folder, as in the run."""
    now = keys(folder, overrides, **changes)
    found = known_keys(now, run, lambda: keys(folder, overrides, stamp=FileDigests().stamp, **changes))
    return [stage for stage in STAGES if found[stage] == run["stages"][stage]["key"]]


def other_picture(path: Path) -> None:
    """Another picture in a file of the same size, with a later time."""
    size, time = path.stat().st_size, path.stat().st_mtime_ns
    image = cv2.blur(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), (5, 5))
    data = cv2.imencode(".png", image)[1].tobytes()
    path.write_bytes(data + bytes(size - len(data)))  # what follows the end of a PNG is ignored
    os.utime(path, ns=(time, time + 3_000_000_000))
    assert path.stat().st_size == size


def test_a_copy_with_other_times_is_no_change(take: Path, tmp_path: Path) -> None:
    run, copy = finished(take), copied(take, tmp_path / "copy")
    assert keys(copy)["measure"] != keys(take)["measure"] and known(copy, run) == list(STAGES)
    assert known(copy, run, fps=50.0) == ["measure"] and known(copy, run, {"fitting": {"frame_steps": 3}}) == ["measure", "track"]
    earlier = {"stages": {stage: {"key": entry["key"]} for stage, entry in run["stages"].items()}}
    assert known(copy, earlier) == [], "an earlier version noted no content"


def test_another_image_of_the_same_size_concerns_everything(take: Path, tmp_path: Path) -> None:
    run, copy = finished(take), copied(take, tmp_path / "copy")
    other_picture(copy / "L" / "0002.png")
    assert known(copy, run) == []


def test_the_content_is_read_only_where_it_matters(take: Path, tmp_path: Path) -> None:
    run, copy, read = finished(take), copied(take, tmp_path / "copy"), list[int]()

    def content() -> dict[str, str]:
        read.append(1)
        return keys(copy, stamp=FileDigests().stamp)

    assert known_keys(keys(take), run, content) == keys(take) and not read
    assert known_keys(keys(copy), run, content) == keys(take) and len(read) == 1
    for stage, key in keys(copy).items():
        run["stages"][stage][STAMPED] = key
    assert known_keys(keys(copy), run, content) == keys(take) and len(read) == 1


def test_new_contours_of_a_copy_are_told_from_its_times(take: Path, tmp_path: Path) -> None:
    run, copy = finished(take), copied(take, tmp_path / "copy")
    store.write_text(copy / "out" / "contours" / "L.csv", "frame,x,y\n")
    assert known(copy, run) == ["measure", "track"]
    now = known_keys(keys(copy), run, lambda: keys(copy, stamp=FileDigests().stamp))
    assert "fit" in valid_stages(run, now, ignore_contours=True) and "fit" not in valid_stages(run, now)


def test_a_movie_counts_by_its_size_and_its_ends(tmp_path: Path) -> None:
    path, digests = tmp_path / "a.mp4", FileDigests()
    content = np.random.default_rng(0).bytes(5 << 20)
    whole = bytearray(content)
    stamps = []
    for time, at in enumerate((None, 0, len(whole) - 1, len(whole) // 2)):
        changed = bytearray(whole)
        if at is not None:
            changed[at] ^= 1
        path.write_bytes(changed)
        os.utime(path, (time, time))
        stamps.append(digests.stamp(path))
    assert len(set(stamps)) == 3 and stamps[0] == stamps[3], "the middle of a movie is not read"
    path.rename(tmp_path / "a.png")
    assert digests.stamp(tmp_path / "a.png")[2] != stamps[0][2]


def test_a_run_of_a_copy_computes_nothing_and_of_another_image_everything(
    plane_take: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = {"growing": {"spacing_px": 16}}
    pipeline.run(plane_take, tmp_path / "out", given, frames=(0, 2))
    copy, out = copied(plane_take, tmp_path / "copy"), tmp_path / "out"
    argv = ["run", str(copy), "--out", str(out), "--frames", "0:2", "--set", "growing.spacing_px=16", "--workers", "1"]
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file() and path.name != "run.json"}
    assert main.main(argv) == 0 and "Nothing has changed" in capfd.readouterr().out
    assert files == {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file() and path.name != "run.json"}
    before = (out / "run.json").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(FileDigests, "stamp", None)  # the copy is remembered
        assert main.main(argv) == 0 and "Nothing has changed" in capfd.readouterr().out and (out / "run.json").read_bytes() == before
    cloud = (out / "clouds" / "0001.ply").read_bytes()
    other_picture(next(iter(sorted((copy / "L").glob("*1.png")))))
    assert main.main(argv) == 0 and "Nothing has changed" not in capfd.readouterr().out
    assert (out / "clouds" / "0001.ply").read_bytes() != cloud


def test_a_fitted_body_is_not_replaced_by_that_of_another_take_or_of_fewer_frames(
    plane_take: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """`measure` of another take, or of two frames for a quick look, deleted a finished body without a word."""
    out, given = tmp_path / "out", ["--set", "growing.spacing_px=16", "--quiet"]
    pipeline.run(plane_take, out, {"growing": {"spacing_px": 16}}, frames=(0, 3))
    another = copied(plane_take, tmp_path / "another")
    (another / "take.toml").write_text((another / "take.toml").read_text() + "\n# another\n")
    other_picture(another / "L" / "0001.png")
    record = json.loads((out / "run.json").read_text())
    assert record["stages"]["fit"].pop("not_done")  # as with a body, which a plane has not
    record["stages"]["fit"]["joint_sigma_mm"] = 5.0
    (out / "run.json").write_text(json.dumps(record))
    files = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    for take, frames, said in (
        (another, "0:3", "of another take"),
        (plane_take, "0:2", "0:3; for 0:2"),
        (plane_take, "1:4", "0:3; for 1:4"),
    ):
        assert main.main(["measure", str(take), "--out", str(out), "--frames", frames, *given]) == 2
        assert said in capfd.readouterr().err and files == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with take_run.open_run(plane_take, out, {"growing": {"spacing_px": 16}}, (0, 4), spares=True):
        pass  # more frames are no loss
    assert main.main(["measure", str(another), "--out", str(out), "--frames", "0:2", "--restart", *given]) == 0


@pytest.mark.slow
def test_results_of_another_take_are_kept_without_a_body_too(plane_take: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """By single stages and by a batch whose takes have the same name."""
    out, given = tmp_path / "out" / "t", ["--set", "growing.spacing_px=16", "--set", "frames=[0, 2]"]
    one, other = (Path(shutil.copytree(plane_take, tmp_path / name / "t")) for name in "ab")
    (other / "take.toml").write_text((other / "take.toml").read_text() + "\n# other\n")
    other_picture(other / "L" / "0001.png")
    assert main.main(["batch", str(one), "--out", str(tmp_path / "out"), "--workers", "1", *given[:2]]) == 0
    clouds = {path: path.read_bytes() for path in (out / "clouds").iterdir()}
    assert main.main(["measure", str(other), "--out", str(out), *given[:2]]) == 2
    assert "has results of another take" in capfd.readouterr().err
    assert main.main(["batch", str(other), "--out", str(tmp_path / "out"), "--workers", "1", *given[:2]]) != 0
    assert "has results of another take" in "".join(capfd.readouterr())
    assert clouds == {path: path.read_bytes() for path in (out / "clouds").iterdir()}


@pytest.mark.parametrize("restart", [False, True])
def test_what_was_edited_of_a_fit_is_kept_when_it_is_made_again(plane_take: Path, tmp_path: Path, restart: bool) -> None:
    """Edits of motion.csv and of the texture were lost without a word with the next change of a setting."""
    out, given = tmp_path / "out", {"growing": {"spacing_px": 16}}
    pipeline.run(plane_take, out, given, frames=(0, 2))
    for name in edited_tables.EDITABLE:
        store.write_bytes(out / name, b"as the fit wrote it")
    record = json.loads((out / "run.json").read_text())
    assert record["stages"]["fit"].pop("not_done")  # as with a body, which a plane has not
    record["stages"]["fit"] |= {edited_tables.ENTRY: edited_tables.digests(out), "joint_sigma_mm": 5.0}
    (out / "run.json").write_text(json.dumps(record))
    for name in ("motion.csv", "skin/texture.png"):
        (out / name).write_bytes(b"edited")
    with take_run.open_run(plane_take, out, {"growing": {"spacing_px": 16}, "skin": {"relief": False}}, (0, 2), restart=restart) as job:
        assert (out / "motion (edited).csv").read_bytes() == (out / "skin" / "texture (edited).png").read_bytes() == b"edited"
        assert not any((out / name).exists() for name in edited_tables.EDITABLE)
        assert len(job.notes) == 3 and "is kept as “motion (edited).csv”" in job.notes[0] and "fitted before is kept in" in job.notes[2]
    assert len([*out.rglob("*(edited*")]) == 2  # the others were not edited
    assert (out / "earlier_body" / "motion.csv").read_bytes() == b"edited"


def test_a_run_without_a_body_is_replaced_without_a_question(plane_take: Path, tmp_path: Path) -> None:
    pipeline.run(plane_take, tmp_path / "out", {"growing": {"spacing_px": 16}}, frames=(0, 3))
    with take_run.open_run(plane_take, tmp_path / "out", {"growing": {"spacing_px": 16}}, (0, 2), spares=True) as again:
        assert not again.record["stages"]
    assert not json.loads((tmp_path / "out" / "run.json").read_text())[
        "stages"
    ]  # if it stops here, what is made again does not count as made


def test_images_replaced_under_the_same_names_sizes_and_times_are_noticed_when_they_are_measured(plane_take: Path, tmp_path: Path) -> None:
    """The stages after the measured one counted as done, beside clouds of other images."""
    take, out = Path(shutil.copytree(plane_take, tmp_path / "take")), tmp_path / "out"
    given, path = {"growing": {"spacing_px": 16}}, take / "L" / "0001.png"
    os.utime(path, (1000, 1000))
    pipeline.run(take, out, given, frames=(0, 2))
    with take_run.open_run(take, out, given, (0, 2)) as again:
        pipeline.measure(again, Monitor())
        assert {*STAGES, "report"} == set(again.record["stages"]) and not again.notes
    other_picture(path)
    os.utime(path, (1000, 1000))
    with take_run.open_run(take, out, given, (0, 2)) as job:
        assert {*STAGES, "report"} == set(job.record["stages"])
        pipeline.measure(job, Monitor())
        assert set(job.results.read_run()["stages"]) == {"measure"} and job.notes == [take_run.OTHER_IMAGES]
    assert not (out / "trajectories.npz").exists() and not (out / "report").exists() and not (out / "cache" / "body").exists()


def test_footage_that_is_replaced_or_removed_is_named_by_the_run_and_by_the_check(plane_take: Path, tmp_path: Path) -> None:
    take, out = Path(shutil.copytree(plane_take, tmp_path / "take")), tmp_path / "out"
    path = take / "L" / "0001.png"

    def stale() -> list[str]:
        return [finding.sentence for finding in check_run(out, Monitor()).findings if finding.cause == "stale result"]

    with take_run.open_run(take, out, {"growing": {"spacing_px": 16}}, (0, 2)) as job:
        for stage in (pipeline.measure, pipeline.track, pipeline.fit):
            stage(job, Monitor())
        job.warn_if_replaced()
        assert take_run.REPLACED not in job.record["warnings"]
        assert stale() == []
        other_picture(path)
        pipeline.report(job, Monitor())
        assert take_run.REPLACED in job.record["warnings"]
    assert len(stale()) == 1 and stale()[0].startswith(f"Images, masks or time stamps of {take} were replaced since this run")
    path.unlink()
    assert len(stale()) == 1 and "cannot be read as it was for this run" in stale()[0]
    shutil.rmtree(take)
    assert stale() == []


def test_contours_concern_the_fit(take: Path, tmp_path: Path) -> None:
    shutil.copytree(take, tmp_path / "take")
    before = keys(tmp_path / "take")
    store.write_text(tmp_path / "take" / "out" / "contours" / "L.csv", "frame,x,y\n")
    now = keys(tmp_path / "take")
    assert [stage for stage in STAGES if now[stage] != before[stage]] == ["fit"]
    stages = {"fit": {"key": before["fit"]}, "report": {"key": before["fit"]}}
    assert valid_stages({"stages": stages}, now) == {} and valid_stages({"stages": stages}, now, ignore_contours=True) == stages
    other = keys(tmp_path / "take", {"fitting": {"frame_steps": 3}})
    assert valid_stages({"stages": stages}, other, ignore_contours=True) == {}, "a body of other settings is none to begin with"


def test_every_part_of_a_take_concerns_a_stage() -> None:
    """A new field of Take must enter a key in stages.py, too: then add it here, and a case above."""
    measure = {"views", "rig_path", "interlaced", "first_field", "reference_view", "frames", "clicks", "corrections"}
    fit = {"body_model", "locked", "limits", "keyframes", "keypoints"}
    assert {field.name for field in fields(Take)} == measure | fit | {"fps", "folder", "settings", "reference_chosen"}


def test_keypoints_concern_the_fit(take: Path, tmp_path: Path) -> None:
    shutil.copytree(take, tmp_path / "take")
    points = tmp_path / "take" / "points.trc"
    points.write_text("one")
    entry = {"keypoints": [{"files": "points.trc"}]}
    assert stale(tmp_path / "take", **entry) == ["fit"]
    before = keys(tmp_path / "take", **entry)
    points.write_text("longer")
    assert [stage for stage in STAGES if keys(tmp_path / "take", **entry)[stage] != before[stage]] == ["fit"]


def test_every_group_of_knobs_concerns_one_stage() -> None:
    groups = [name for concern in STAGE_INPUTS.values() for name in concern.settings]
    assert sorted([*groups, *WITHOUT_STAGE]) == sorted(run_settings.SETTINGS) and stage_of("tracking") == "track"


@pytest.mark.parametrize("group", ["contour", "key_points"])
def test_what_stands_aside_makes_nothing_stale(take: Path, group: str) -> None:
    assert group in WITHOUT_STAGE and stale(take, {group: other_than_default(group)}) == []


def test_a_preset_concerns_the_stages_of_its_settings(take: Path) -> None:
    assert stale(take, {"method": {"preset": "published"}}) == ["measure", "track", "fit"]


def test_a_run_keeps_what_is_still_good_and_removes_what_is_not(take: Path, tmp_path: Path) -> None:
    now = keys(take)
    run = {"stages": {"measure": {"key": now["measure"]}, "track": {"key": "another"}, "fit": {"key": now["fit"]}, "report": {"key": ""}}}
    assert sorted(valid_stages(run, now)) == ["fit", "measure"]
    assert valid_stages({"stages": {"measure": {"seconds": 1.0}}}, now) == {}, "written by a version that kept no keys"
