"""What a change concerns: the right stages become stale, and only those."""

import os
import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from tricap.core.foundation import store
from tricap.core.run import settings as run_settings
from tricap.core.run import take_run
from tricap.core.run.stages import STAGE_INPUTS, STAGES, WITHOUT_STAGE, stage_keys, stage_of, valid_stages
from tricap.core.take.footage import open_take
from tricap.core.take.take import Take
from tricap.core.take.writing import read_table, take_of_table

from ..conftest import Body, three_cameras, write_take

JOINTS = {"shoulder.R": {"L": [50.0, 40.0], "C": [52.0, 40.0]}, "elbow.R": {"L": [90.0, 70.0], "C": [92.0, 70.0]}}


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stages") / "take"
    return write_take(folder, three_cameras(), [[Body()]] * 4)


def keys(folder: Path, overrides: dict[str, Any] | None = None, **changes: Any) -> dict[str, str]:
    table = read_table(folder) | {"seeds": {"frame": 1, "joints": JOINTS}, "body": {"model": "arm.R"}} | changes
    take = take_of_table(folder, table)
    return stage_keys(open_take(take), take_run.settings_of(take.settings, overrides or {}, "the test"), folder / "out")


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
