"""Corrections, locks and limits: in the scene, in take.toml, undone, and in effect."""

import importlib
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.take.take import read_take
from tricap.core.take.writing import read_table, write_table

from .conftest import SmallRun

ADDON = "bl_ext.user_default.tricap.addon"
SAID = {
    "corrections": [{"kind": "trajectory", "view": "C", "frame": 4, "xy": [1.123456789, 2.5]},
                    {"kind": "region", "view": "L", "frames": [2, 6], "polygon": [[10, 10], [50.5, 10], [50.7, 60.3]]}],
    "body": {"model": "arm.R", "locked": ["elbow.R twist"], "limits": {"elbow.R flexion": [0, 120.1]}},
}  # fmt: skip


def module(name: str) -> ModuleType:
    return importlib.import_module(f"{ADDON}.{name}")


@pytest.fixture
def take(small_run: SmallRun) -> Path:
    return small_run.take


@pytest.fixture
def scene(blender: ModuleType, empty: ModuleType, take: Path) -> Any:
    module("project").open_take(empty.context.scene, take)
    empty.context.scene.frame_set(3)
    return empty.context.scene


def test_what_the_file_says_is_shown_and_written_exactly(blender: ModuleType, scene: Any, take: Path) -> None:
    project = module("project")
    write_table(take, read_table(take) | SAID)
    text = (take / "take.toml").read_text(encoding="utf-8")
    project.open_take(scene, take)
    said = scene.tricap_correcting
    assert [(c.kind, c.view, c.first, c.last, len(c.corners)) for c in said.corrections] == [
        ("trajectory", "C", 4, 4, 1), ("region", "L", 2, 5, 3)]  # fmt: skip
    dofs = {dof.name: dof for dof in said.dofs}
    assert set(dofs) == {"shoulder.R flexion", "shoulder.R abduction", "shoulder.R twist", "elbow.R flexion", "elbow.R twist"}
    assert dofs["elbow.R twist"].locked and dofs["elbow.R flexion"].high == pytest.approx(120.1) and dofs["shoulder.R twist"].low == -110
    project.write(scene)
    assert (take / "take.toml").read_text(encoding="utf-8") == text
    (take / "take.toml").unlink()
    write_table(take, {k: v for k, v in project.table(scene).items()})
    assert read_take(take).corrections[1].xy_px.tolist() == [[10, 10], [50.5, 10], [50.7, 60.3]]


def test_locks_and_limits_of_the_panel(blender: ModuleType, scene: Any) -> None:
    project, said = module("project"), scene.tricap_correcting
    assert project.table(scene)["body"] == {"model": "arm.R"}
    assert blender.ops.tricap.list_dofs() == {"FINISHED"} and project.table(scene)["body"] == {"model": "arm.R"}
    dof = said.dofs["elbow.R flexion"]
    dof.high, said.dofs["shoulder.R twist"].locked = 140.3, True
    taken = project.take(scene)
    assert taken.locked == ("shoulder.R twist",) and taken.limits == {"elbow.R flexion": (0.0, 140.3)}
    dof.low = 150.0
    with pytest.raises(module("jobs").InputError, match="elbow.R flexion.*lower one"):
        project.table(scene)
    dof.low, dof.high, said.dofs["shoulder.R twist"].locked = 0.0, 150.0, False
    assert project.table(scene)["body"] == {"model": "arm.R"}, "as the model has them: nothing to say"
    dof.locked, scene.tricap.model = True, "leg.L"
    assert project.table(scene)["body"] == {"model": "leg.L"}, "the list is another model's"
    scene.tricap.model = "none"
    with pytest.raises(RuntimeError, match="body model first"):
        blender.ops.tricap.list_dofs()


@pytest.mark.parametrize("name", ["arm.R", "full", "leg.L"])
def test_limits_are_those_of_the_model(blender: ModuleType, name: str) -> None:
    limits = module("correcting.tables").model_limits(read_model(name))
    assert all(-360 <= low < high <= 360 and low == round(low, 3) for low, high in limits.values())
    assert not any(dof.endswith((" x", " y", " z")) for dof in limits) and limits[next(n for n in limits if "flexion" in n)]


def test_corrections_by_script(blender: ModuleType, scene: Any) -> None:
    project, ops = module("project"), blender.ops.tricap
    assert ops.remove_trajectory(view="C", x=40.25, y=61.1) == {"FINISHED"}
    assert ops.remove_region(view="R", polygon="[[1, 2], [30, 2.5], [30, 40]]", last=5) == {"FINISHED"}
    assert project.table(scene)["corrections"] == [
        {"kind": "trajectory", "view": "C", "frame": 3, "xy": [40.25, 61.1]},
        {"kind": "region", "view": "R", "frames": [0, 6], "polygon": [[1, 2], [30, 2.5], [30, 40]]}]  # fmt: skip
    assert ops.remove_correction(index=0) == {"FINISHED"} and len(project.table(scene)["corrections"]) == 1
    assert ops.remove_correction() == {"FINISHED"} and "corrections" not in project.table(scene)
    with pytest.raises(RuntimeError, match="no correction"):
        ops.remove_correction()


@pytest.mark.parametrize(("wrong", "why"), [
    (dict(view="X", polygon="[[1, 2], [3, 4], [5, 9]]"), "no view “X”"), (dict(view="C", polygon="[[1, 2], [3, 4]]"), "three or more"),
    (dict(view="C", polygon="here"), "not a list of corners"), (dict(view="C", polygon="[[1, 2], [3, 4], [5]]"), "not a list of corners"),
    (dict(view="C", polygon="[[1, 2], [3, 4], [5, 9]]", first=4, last=2), "not end before it starts")])  # fmt: skip
def test_a_wrong_region_is_told_and_leaves_nothing(blender: ModuleType, scene: Any, wrong: dict[str, Any], why: str) -> None:
    with pytest.raises(RuntimeError, match=why):
        blender.ops.tricap.remove_region(**wrong)
    assert not scene.tricap_correcting.corrections


def test_undo_save_and_open(blender: ModuleType, scene: Any, tmp_path: Path) -> None:
    blender.ops.ed.undo_push(message="before")
    blender.ops.tricap.remove_trajectory(view="C", x=40, y=61)
    blender.ops.ed.undo_push(message="after")
    blender.ops.ed.undo()
    assert not blender.context.scene.tricap_correcting.corrections
    blender.ops.ed.redo()
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b é.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "b é.blend"))
    assert len(module("project").table(blender.context.scene)["corrections"]) == 1


def test_a_correction_makes_the_later_steps_stale(blender: ModuleType, scene: Any, take: Path) -> None:
    from tricap.core.run import take_run
    from tricap.core.run.stages import stage_keys
    from tricap.core.take.footage import open_take

    def keys() -> dict[str, str]:
        module("project").write(scene)
        return stage_keys(open_take(read_take(take)), take_run.settings_of({}, {}, ""), take / "results")

    before = keys()
    blender.ops.tricap.remove_trajectory(view="C", x=40, y=61)
    after = keys()
    assert after["measure"] == before["measure"] and after["track"] != before["track"] and after["fit"] != before["fit"]
    blender.ops.tricap.remove_correction()
    assert keys() == before
    blender.ops.tricap.list_dofs()
    scene.tricap_correcting.dofs["elbow.R twist"].locked = True
    assert keys()["track"] == before["track"] and keys()["fit"] != before["fit"]


def test_a_joint_that_is_pulled_is_clicked_in_every_view(blender: ModuleType, scene: Any, small_run: SmallRun) -> None:
    scene.tricap.out = str(small_run.out)
    cameras = {camera.name: camera for camera in small_run.rig.cameras}
    wrist, frame = small_run.joints_m["wrist.R"][1], 3
    at = cameras["C"].project(wrist) + (4.0, -3.0)
    assert blender.ops.tricap.pull_joint(name="wrist.R", view="C", x=at[0], y=at[1]) == {"FINISHED"}
    clips, clicks = module("project").clips_of(scene), module("clicks")
    got = {view: np.array(clicks.get_click(clip, "wrist.R", frame)) for view, clip in clips.items()}
    depth = cameras["C"].to_camera(wrist)[2]
    moved = cameras["C"].points_at_depth(at, depth)
    for view, camera in cameras.items():
        np.testing.assert_allclose(got[view], camera.project(moved), atol=0.02)
    assert blender.ops.tricap.pull_joint(name="wrist.R", view="L", x=50, y=60) == {"FINISHED"}
    assert np.allclose(clicks.get_click(clips["C"], "wrist.R", frame), got["C"]), "clicks that are there stay"
    with pytest.raises(RuntimeError, match="no joint “tail”"):
        blender.ops.tricap.pull_joint(name="tail", view="L", x=50, y=60)
    with pytest.raises(RuntimeError, match="No body was fitted in frame 99"):
        blender.ops.tricap.pull_joint(name="wrist.R", view="L", frame=99, x=50, y=60)


def test_the_limb_of_a_dragged_joint_is_shown_in_every_view(blender: ModuleType, small_run: SmallRun) -> None:
    from tricap.core.run.pulled_limb import FittedLimbs

    pull, cameras = module("correcting.pull_joint"), {camera.name: camera for camera in small_run.rig.cameras}
    frame, limbs = 3, FittedLimbs.read(small_run.out)
    elbow, wrist = (small_run.joints_m[name][1] for name in ("elbow.R", "wrist.R"))
    forearm_m = np.linalg.norm(wrist - elbow)
    goal = elbow + forearm_m * np.array([0.6, 0.0, 0.8])
    shown = pull.as_pulled(limbs.limb(frame, "wrist.R"), cameras, frame, goal)
    assert shown.name == "wrist.R" and shown.frame == frame and set(shown.joint_px) == set(cameras)
    for view, camera in cameras.items():
        fitted, _ = shown.joint_px[view]
        np.testing.assert_allclose(fitted, camera.project(wrist), atol=0.01)
        assert shown.bones_px[view].shape[1:] == shown.outline_px[view].shape[1:] == (2, 2)
        assert all(np.isfinite(lines[view]).all() for lines in (shown.bones_px, shown.outline_px))
    draw, session = module("overlay.draw"), module("session").get_session()
    draw.show_pulled(shown)
    assert session.file.pulled is shown
    draw.show_pulled(None)
    assert session.file.pulled is None


def test_the_floor_is_clicked_in_two_views(blender: ModuleType, scene: Any, small_run: SmallRun) -> None:
    place = np.array([-0.1, 0.3, -0.12])
    at = {camera.name: (camera.project(place) + 0.5).tolist() for camera in small_run.rig.cameras}
    assert blender.ops.tricap.set_floor(clicks=json.dumps([["L", *at["L"]], ["R", *at["R"]]])) == {"FINISHED"}
    assert scene.tricap.floor_m == pytest.approx(-0.12, abs=0.01)
    for clicks, why in {
        "L": "not a list", json.dumps([["L", *at["L"]]]): "in two views", json.dumps([["L", 1, 2], ["X", 3, 4]]): "no view “X”",
        json.dumps([["L", *at["L"]], ["R", at["R"][0], at["R"][1] + 60]]): "rays miss each other",
    }.items():  # fmt: skip
        with pytest.raises(RuntimeError, match=why):
            blender.ops.tricap.set_floor(clicks=clicks)
    assert scene.tricap.floor_m == pytest.approx(-0.12, abs=0.01)
