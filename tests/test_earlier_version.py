"""Takes and results of Tricap 0.1.0 are still read: version_0_1/ has a take.toml with every key and setting of that version, and the text
files of a run."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.__main__ import main
from tricap.addon.scene.contents import read_contents
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.motion.sources import read_motion_source
from tricap.core.results.run_json import read_run
from tricap.core.run import settings as run_settings
from tricap.core.run import take_run
from tricap.core.take.take import read_take
from tricap.core.take.writing import read_table

from .core.conftest import Body, three_cameras, write_take

VERSION_0_1 = Path(__file__).parent / "version_0_1"
RENAMED = [
    (group, field, earlier)
    for group, settings in run_settings.SETTINGS.items()
    for field in dataclasses.fields(settings)
    for earlier in field.metadata["was"]
]


@pytest.fixture
def take(tmp_path: Path) -> Path:
    """The take of version 0.1.0, with footage of two images, a mask and keypoints."""
    folder = write_take(tmp_path / "take", three_cameras(), [[Body()]] * 4, interlaced="both")
    (folder / "mask.png").write_bytes(cv2.imencode(".png", np.full((150, 200), 255, np.uint8))[1].tobytes())
    person = {"people": [{"pose_keypoints_2d": [value for i in range(25) for value in (60.0 + i, 40.0 + i, 0.9)]}]}
    (folder / "kp" / "C").mkdir(parents=True)
    for i in range(2):
        (folder / "kp" / "C" / f"clip_{i:012d}_keypoints.json").write_text(json.dumps(person))
    for name in ("take.toml", "rig.toml"):
        shutil.copy(VERSION_0_1 / name, folder / name)
    return folder


@pytest.fixture
def out(take: Path, tmp_path: Path) -> Path:
    """The results of version 0.1.0, as far as they are text."""
    folder = shutil.copytree(VERSION_0_1 / "out", tmp_path / "out")
    run = folder / "run.json"
    run.write_text(run.read_text().replace('"take": "TAKE"', f'"take": {json.dumps(str(take))}'))
    return folder


def current_name(group: str, name: str) -> tuple[str, str]:
    """Group and name of a setting of today by those of an earlier version."""
    same_group = next((field.name for g, field, earlier in RENAMED if g == group and earlier == name), name)
    return next(((g, field.name) for g, field, earlier in RENAMED if earlier == f"{group}.{name}"), (group, same_group))


def other_value(field: "dataclasses.Field[Any]") -> Any:
    """A valid value of a setting that is not its default."""
    default, meta = field.default, field.metadata
    if isinstance(default, bool):
        return not default
    if meta["choices"]:
        return next(choice for choice in meta["choices"] if choice != default)
    step = 1 if isinstance(default, int) else 0.5 * abs(default) or 0.001
    return default + step if meta["high"] is None or default + step <= meta["high"] else default - step


def test_every_key_of_the_take_is_read(take: Path) -> None:
    opened = read_take(take)
    assert [view.name for view in opened.views] == ["L", "C", "R"] and opened.body_model == "arm.R" and opened.locked == ("elbow.R twist",)
    assert (opened.reference_view, opened.interlaced, opened.first_field, opened.frames) == ("C", "both", "even", (0, 2))
    assert len(opened.keyframes) == 1 and len(opened.corrections) == 2 and len(opened.keypoints) == 1
    assert main(["check", str(take), "--quiet"]) in (0, 1)


@pytest.mark.parametrize("group", [group for group in read_table(VERSION_0_1)["settings"] if group in run_settings.SETTINGS])
def test_every_setting_of_the_take_has_its_value(group: str) -> None:
    tables = read_table(VERSION_0_1)["settings"]
    settings = take_run.settings_of(tables, {}, "take.toml")
    for name, value in tables[group].items():
        now, knob = current_name(group, name)
        assert getattr(settings[now], knob) == value, name


def test_a_setting_that_no_version_had_is_refused() -> None:
    tables = read_table(VERSION_0_1)["settings"] | {"matching": {"patch_inches": 13}}
    with pytest.raises(InputError, match="no setting “patch_inches”"):
        take_run.settings_of(tables, {}, "take.toml")


@pytest.mark.parametrize(("group", "field", "earlier"), RENAMED, ids=[f"{g}.{f.name}" for g, f, _ in RENAMED])
def test_a_renamed_setting_may_be_set_under_its_earlier_name(group: str, field: "dataclasses.Field[Any]", earlier: str) -> None:
    earlier_group, _, earlier_name = earlier.rpartition(".")
    table = {earlier_group or group: {earlier_name: other_value(field)}}
    for tables in ((table, {}), ({}, table)):
        assert getattr(take_run.settings_of(*tables, "take.toml")[group], field.name) == other_value(field)


def test_the_results_are_read(out: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run = read_run(out / "run.json")
    assert set(run["stages"]) == {"measure", "track", "fit", "report"}
    take_run.settings_of(run["settings"], {}, "run.json")
    contents = read_contents(out, Monitor())
    assert contents.motion is not None and contents.shape is not None and contents.prepared.skin is not None
    assert contents.motion.frames.tolist() == list(range(6)) and contents.footage is not None
    assert any("clouds" in warning for warning in contents.warnings)
    motion = read_motion_source(out)
    assert len(motion.frames) == 6 and {"upper_arm.R", "forearm.R"} <= set(motion.rig.names)
    assert main(["check", str(out)]) == 1 and "trajectories.npz" in capfd.readouterr().out
