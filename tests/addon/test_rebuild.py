"""*Build Rig and Scene* where there is a body: what the user did with it and put beside it stays."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from mathutils import Quaternion

from tricap.addon.scene.action_curves import curves_of
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.motion.tables import read_motion, write_motion

from .conftest import SmallRun
from .test_scene_standing import placed


@pytest.fixture(autouse=True)
def new_file(blender: ModuleType) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)


def built(bpy: ModuleType, folder: Path) -> Any:
    """The body that the button builds."""
    assert bpy.ops.tricap.build_scene(out=str(folder)) == {"FINISHED"}
    return bpy.data.objects["Body"]


def said(capfd: pytest.CaptureFixture[str]) -> str:
    return "".join(capfd.readouterr())


def fitted_again(folder: Path) -> None:
    """Another fit, in which the right arm hangs less."""
    path = folder / "motion.csv"
    skeleton = default_shape(read_model("full")).skeleton
    table = read_motion(path, skeleton)
    values = table.values.copy()
    values[:, table.dof_names.index("shoulder.R flexion")] += 0.4
    write_motion(path, replace(table, values=values), skeleton)


@pytest.mark.slow
def test_things_of_the_user_stay_and_hold_on_to_the_new_body(blender: ModuleType, out: Path) -> None:
    body, scene = built(blender, out), blender.context.scene
    sword, lamp, copy = (blender.data.objects.new(name, None) for name in ("Sword", "Lamp", "Copy"))
    copy = body.copy()
    body.scale = (1.5, 1.5, 1.5)
    part = body.users_collection[0]
    for thing in (sword, lamp, copy):
        part.objects.link(thing)  # as Blender does with what is added while this collection is active
    own = blender.data.collections.new("Props")
    part.children.link(own)
    own.objects.link(inside := blender.data.objects.new("Shield", None))
    sword.parent, sword.parent_type, sword.parent_bone = body, "BONE", "hand.R"
    sword.location = (0.1, 0.2, 0.3)
    follow = lamp.constraints.new("COPY_LOCATION")
    follow.target, follow.subtarget = body, "head"
    driver = inside.driver_add("location", 0).driver
    driver.variables.new().targets[0].id = body
    wanted = {}
    for again in range(2):
        blender.context.view_layer.update()
        wanted[again] = [np.array(thing.matrix_world) for thing in (sword, lamp)]
        body.name = "Hero"
        body = built(blender, out)
    np.testing.assert_allclose(wanted[1], wanted[0], atol=1e-6)
    names = {o.name for o in blender.data.objects}
    assert {"Sword", "Lamp", "Shield", "Body", copy.name} <= names and "Hero" not in names and not [n for n in names if "earlier" in n]
    assert {"Sword", "Lamp", "Shield"} <= {o.name for o in scene.objects}
    assert sword.parent == follow.target == driver.variables[0].targets[0].id == body
    assert body.scale.x == pytest.approx(1.5) and copy.scale.x == pytest.approx(1.0)
    assert "Props" in scene.collection.children and [c.name for c in blender.data.collections].count("Tricap") == 1


@pytest.mark.slow
def test_edits_of_the_motion_are_kept_and_said(blender: ModuleType, out: Path, capfd: pytest.CaptureFixture[str]) -> None:
    body = built(blender, out)
    said(capfd)
    body = built(blender, out)
    assert "kept" not in said(capfd) and len(blender.data.actions) == 2, "nothing was edited"
    blender.context.scene.tricap.path = "OBJECT"
    body.rotation_euler.z = 0.7
    body = built(blender, out)
    assert "kept" not in said(capfd) and blender.context.scene.tricap.path == "OBJECT" and body.rotation_euler.z == pytest.approx(0.7)
    assert blender.ops.tricap.reduce_keys(tolerance=0.01) == {"FINISHED"}
    wanted = {c.data_path + str(c.array_index): len(c.keyframe_points) for c in curves_of(body.animation_data.action)}
    built(blender, out)
    assert "is kept as the action “Simplified motion”; in the Action Editor it can be played" in said(capfd)
    kept = blender.data.actions["Simplified motion"]
    assert kept.use_fake_user and {c.data_path + str(c.array_index): len(c.keyframe_points) for c in curves_of(kept)} == wanted
    measured = blender.data.objects["Body"].animation_data.action
    assert measured.name == "Measured motion"
    curves_of(measured)[3].keyframe_points[4].co.y += 0.1  # by hand, in the Graph Editor
    built(blender, out)
    assert "“Measured motion”" in said(capfd) and len([a for a in blender.data.actions if a.name.startswith("Measured motion")]) == 2


@pytest.mark.slow
def test_feet_stay_locked(blender: ModuleType, out: Path, capfd: pytest.CaptureFixture[str]) -> None:
    body = built(blender, out)
    assert blender.ops.tricap.lock_feet() == {"FINISHED"}
    count = len(blender.data.objects)
    said(capfd)
    body = built(blender, out)
    text = said(capfd)
    assert "The feet are locked in the new motion, too." in text and "edited" not in text
    assert len(blender.data.objects) == count and body.pose.bones["shin.L"].constraints["Foot lock"].target.name in blender.data.objects
    assert blender.ops.tricap.remove_foot_lock() == {"FINISHED"}
    built(blender, out)
    assert "The feet" not in said(capfd)


@pytest.mark.slow
def test_a_control_rig_plays_the_new_motion_with_its_corrections(
    blender: ModuleType, out: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    scene, body = blender.context.scene, built(blender, out)
    plain = placed(blender, body, ("hand.R", "hand.L"))
    assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
    rig = blender.data.objects["Body controls"]
    rig.name = "My controls"
    scene.frame_set(5)
    bone = rig.pose.bones["upper_arm_fk.L"]
    bone.rotation_quaternion = bone.rotation_quaternion @ Quaternion((1, 0, 0), 0.3)
    bone.keyframe_insert("rotation_quaternion")
    layer = blender.data.actions.new("Breathing")
    rig.animation_data.action, first = layer, rig.animation_data.action
    rig.pose.bones["chest"].location.z = 0.02
    rig.pose.bones["chest"].keyframe_insert("location", frame=0)
    track = rig.animation_data.nla_tracks.new()
    track.name = "Breath"
    strip = track.strips.new("Breath", 3, layer)
    strip.blend_type, strip.influence = "COMBINE", 0.5
    rig.animation_data.action, rig.animation_data.action_blend_type = first, "COMBINE"
    before = placed(blender, body, ("hand.R", "hand.L"))
    assert np.abs(before[5, 1] - plain[5, 1]).max() > 0.05, "a correction"
    said(capfd)
    body = built(blender, out)
    text = said(capfd)
    assert "The control rig “My controls” plays the new motion, with your corrections over it." in text and "kept" not in text
    np.testing.assert_allclose(placed(blender, body, ("hand.R", "hand.L")), before, atol=2e-5)
    rigs = [o.name for o in blender.data.objects if o.type == "ARMATURE"]
    assert sorted(rigs) == ["Body", "My controls"] and not [c for c in blender.data.collections if "earlier" in c.name]
    assert len([c for c in blender.data.collections if c.name.startswith("WGTS")]) == 1, "the shapes of the earlier controls are gone"
    rig = blender.data.objects["My controls"]
    assert [t.name for t in rig.animation_data.nla_tracks][1:] == ["Breath"] and rig.animation_data.action == first
    fitted_again(out)
    body = built(blender, out)
    after = placed(blender, body, ("hand.R", "hand.L"))
    np.testing.assert_allclose(after[:, 1], before[:, 1], atol=2e-5, err_msg="the left arm as it was fitted, and corrected")
    assert np.abs(after[:, 0] - before[:, 0]).max(axis=(1, 2)).min() > 0.05, "the right arm as it was fitted anew"
    (out / "body.toml").unlink()
    blender.ops.tricap.build_scene(out=str(out))
    text = said(capfd)
    assert "The control rig “My controls” went with the earlier body." in text and "“Breathing”" in text and first.name in text


def test_a_build_of_an_earlier_version_goes_whole(blender: ModuleType, small_run: SmallRun) -> None:
    """Its things have no marks."""
    body = built(blender, small_run.out)
    for thing in (*blender.data.objects, *blender.data.collections, *blender.data.actions):
        for name in [name for name in thing.keys() if name.startswith("tricap_built")]:
            del thing[name]
    body.users_collection[0].objects.link(blender.data.objects.new("Other", None))
    before = len(blender.data.objects)
    built(blender, small_run.out)
    assert len(blender.data.objects) == before - 1 and "Other" not in blender.data.objects
    assert not [o for o in blender.data.objects if o.name.startswith("earlier")]
