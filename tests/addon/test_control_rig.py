"""*Make Control Rig*: Rigify's controls play the motion and drive the body; IK and FK snap to each other; corrections are layered."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.addon.scene.standing import curves_of
from tricap.core.geometry.rotation import angle_of, transposed, twist_about
from tricap.core.motion.formats.bvh import read_bvh

from .test_scene_standing import FRAMES, walker

ANGLE_DEG, PLACE_M = 0.2, 1e-3  # promised of the motion; measured 6e-5° and 5e-7 m
SNAP_DEG, SNAP_M = 0.1, 1e-4  # promised of snapping; measured 4e-5° and 4e-7 m


def pose(body: Any) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (B, 3, 3) and heads (B, 3) of the body's bones now."""
    M = np.array([body.matrix_world @ bone.matrix for bone in body.pose.bones])
    return M[:, :3, :3], M[:, :3, 3]


def check_same(found: tuple[np.ndarray, np.ndarray], wanted: tuple[np.ndarray, np.ndarray], angle_deg: float, place_m: float) -> None:
    assert np.degrees(angle_of(transposed(found[0]) @ wanted[0])).max() < angle_deg
    assert np.abs(found[1] - wanted[1]).max() < place_m


def test_the_controls_play_the_motion_and_limbs_snap(blender: ModuleType, tmp_path: Path) -> None:
    body, scene = walker(blender), blender.context.scene
    bend(body)
    wanted = []
    for frame in range(FRAMES):
        scene.frame_set(frame)
        wanted.append(pose(body))
    assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
    rig = blender.data.objects["Body controls"]
    assert rig.users_collection == body.users_collection and blender.context.active_object == rig and not body.visible_get()
    assert {"upper_arm_fk.L", "hand_ik.R", "foot_ik.L", "pelvis", "root"} <= set(rig.pose.bones.keys())
    data = rig.animation_data
    assert len(data.nla_tracks) == 1 and data.nla_tracks[0].lock and data.action.name == "Corrections" and not data.action.layers
    for frame in range(FRAMES):
        scene.frame_set(frame)
        check_same(pose(body), wanted[frame], ANGLE_DEG, PLACE_M)
    scene.frame_set(7)
    for to, switch in (("IK", 0.0), ("FK", 1.0)):
        assert blender.ops.tricap.snap_limbs(to=to) == {"FINISHED"}
        assert rig.pose.bones["thigh_parent.L"]["IK_FK"] == switch
        check_same(pose(body), wanted[7], SNAP_DEG, SNAP_M)
    a_correction_is_layered_and_exported(blender, rig, body, wanted, tmp_path)
    with pytest.raises(RuntimeError, match="has the control rig “Body controls” already"):
        blender.ops.tricap.make_control_rig()
    with pytest.raises(RuntimeError, match="no limb “tail”"):
        blender.ops.tricap.snap_limbs(to="IK", limbs="tail")


def bend(body: Any) -> None:
    """Give elbows, forearms and knees angles, as a measurement does."""
    for name, angles in {"forearm.R": (1.2, 0.5), "forearm.L": (0.7, -0.4), "shin.R": (0.9, 0.1), "shin.L": (0.02, 0.0)}.items():
        for index, angle in enumerate(angles):
            curve = body.animation_data.action.fcurve_ensure_for_datablock(body, f'pose.bones["{name}"].rotation_euler', index=index)
            for k, point in enumerate(curve.keyframe_points):
                point.co.y += angle * (0.8 + 0.02 * k)


def test_fingers_and_toes_have_controls(blender: ModuleType) -> None:
    """Their poses before, with keys or without, are reproduced; controls turn them, each about all axes; a master curls its finger."""
    body, scene = walker(blender, fingers=True), blender.context.scene
    bend(body)
    rng = np.random.default_rng(5)
    for name in ("f_index.01.R", "f_index.02.R", "thumb.01.L", "toe.L"):
        for frame in (0, 5, FRAMES - 1):
            body.pose.bones[name].rotation_euler = rng.normal(0, 0.4, 3)
            body.pose.bones[name].keyframe_insert("rotation_euler", frame=frame)
    body.pose.bones["f_pinky.01.L"].rotation_euler = (0.5, 0.2, -0.1)  # a pose without keys
    wanted = played(blender, body)
    assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
    rig, names = blender.data.objects["Body controls"], list(body.pose.bones.keys())
    for found, before in zip(played(blender, body), wanted):
        check_same(found, before, ANGLE_DEG, 1e-5)
    (strip,) = rig.animation_data.nla_tracks[0].strips
    keyed = {curve.data_path.split('"')[1] for curve in curves_of(strip.action)}
    assert {"f_index.01.R", "toe.L", "f_pinky.01.L"} <= keyed and not {"f_ring.01.R", "toe.R"} & keyed, (
        "a finger at rest is left to the animator"
    )
    unused = [
        bone.name for bone in rig.data.bones if bone.name.startswith(("ORG-f_", "DEF-thumb", "MCH-f_ring.01.R")) or ".001" in bone.name
    ]
    assert not unused and {c.name for c in rig.data.collections_all} >= {"Fingers.L", "Fingers.R"}
    scene.frame_set(7)
    for to in ("IK", "FK"):
        assert blender.ops.tricap.snap_limbs(to=to) == {"FINISHED"}
        check_same(pose(body), wanted[7], SNAP_DEG, SNAP_M)
        for name in ("f_ring.02.R", "thumb.01.L", "toe.R", "toe.L"):
            for axis in range(3):
                turned_alone(blender, rig, body, name, axis)
    ring, before = [names.index(f"f_ring.0{k}.L") for k in (1, 2, 3)], pose(body)
    rig.pose.bones["f_ring.01_master.L"].scale.y = 0.75
    blender.context.view_layer.update()
    turned = transposed(before[0][ring]) @ pose(body)[0][ring]
    np.testing.assert_allclose(twist_about(turned, np.array([1.0, 0.0, 0.0])), np.radians([0, 45, 90]), atol=1e-4, err_msg="it flexes")


def turned_alone(bpy: ModuleType, rig: Any, body: Any, name: str, axis: int) -> None:
    """Turning the control of a finger or toe turns the body's bone, and none above it."""
    control, before, at = rig.pose.bones[name], pose(body), list(body.pose.bones.keys()).index(name)
    control.rotation_mode = "XYZ"
    was = control.rotation_euler[axis]
    control.rotation_euler[axis] += 0.3
    bpy.context.view_layer.update()
    now = pose(body)
    control.rotation_euler[axis] = was
    bpy.context.view_layer.update()
    below = {child.name for child in body.data.bones[name].children_recursive} | {name}
    others = [i for i, other in enumerate(body.pose.bones.keys()) if other not in below]
    assert np.degrees(angle_of(before[0][at].T @ now[0][at])) == pytest.approx(np.degrees(0.3), abs=0.01)
    check_same((now[0][others], now[1][others]), (before[0][others], before[1][others]), SNAP_DEG, SNAP_M)


def played(bpy: ModuleType, body: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """The poses of all frames."""
    found = []
    for frame in range(FRAMES):
        bpy.context.scene.frame_set(frame)
        found.append(pose(body))
    return found


def a_correction_is_layered_and_exported(bpy: ModuleType, rig: Any, body: Any, wanted: list[Any], folder: Path) -> None:
    from mathutils import Quaternion

    bpy.context.scene.frame_set(5)
    bone = rig.pose.bones["upper_arm_fk.L"]
    bone.rotation_quaternion = bone.rotation_quaternion @ Quaternion((1, 0, 0), 0.3)
    bone.keyframe_insert("rotation_quaternion")
    for frame in (0, 5, 11):  # the same correction everywhere, over the motion
        bpy.context.scene.frame_set(frame)
        row = list(body.pose.bones.keys()).index("upper_arm.L")
        turned = np.degrees(angle_of(pose(body)[0][row].T @ wanted[frame][0][row]))
        assert turned == pytest.approx(np.degrees(0.3), abs=0.5)
    assert bpy.ops.tricap.export(kind="bvh", filepath=str(folder / "a.bvh")) == {"FINISHED"}
    found = read_bvh(folder / "a.bvh", unit_m=1.0, up="Y")
    hand = list(body.pose.bones.keys()).index("hand.L")
    assert np.abs(found.head_m[11, found.rig.index["hand.L"]] - pose(body)[1][hand]).max() < 1e-4


def test_a_body_that_was_placed_by_hand_and_a_second_rig(blender: ModuleType) -> None:
    """The body was turned and scaled; a hidden rig is not snapped; nothing is left of a deleted one when another is made."""
    body, scene = walker(blender), blender.context.scene
    bend(body)
    body.rotation_euler.z, body.scale = 0.9, (1.2, 1.2, 1.2)
    scene.tricap.path = "OBJECT"
    scene.frame_set(3)
    wanted = pose(body)
    assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
    check_same(pose(body), wanted, ANGLE_DEG, PLACE_M)
    rig = blender.data.objects["Body controls"]
    rig.hide_set(True)
    with pytest.raises(RuntimeError, match="“Body controls” is hidden; show it first"):
        blender.ops.tricap.snap_limbs(to="IK")
    rig.hide_set(False)
    rig.pose.bones["chest"].rotation_mode, rig.pose.bones["chest"].rotation_euler.x = "XYZ", 0.5
    rig.select_set(True)
    assert blender.ops.object.delete() == {"FINISHED"}
    assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
    check_same(pose(body), wanted, ANGLE_DEG, PLACE_M)
    assert [o.name for o in blender.data.objects if o.type == "ARMATURE"] == ["Body", "Body controls"]
    a_rebuilt_body_leaves_no_control_rig(blender, body)


def a_rebuilt_body_leaves_no_control_rig(bpy: ModuleType, body: Any) -> None:
    from tricap.addon.scene import build

    bpy.data.objects["Body controls"].pose.bones["chest"].keyframe_insert("rotation_quaternion")
    built = bpy.data.collections.new(build.COLLECTION)
    built[build.OUT_KEY] = "earlier"
    bpy.context.scene.collection.children.link(built)
    bpy.context.scene.collection.objects.unlink(body)
    built.objects.link(body)
    (sentence,) = build.remove_earlier()
    assert "“Body controls” was removed" in sentence and sentence.endswith("is kept.")
    assert not bpy.data.objects and not [c for c in bpy.data.collections if c.name.startswith("WGTS")]
    assert any(action.name.startswith("Corrections") and action.use_fake_user for action in bpy.data.actions)


def test_a_control_rig_needs_a_whole_body(blender: ModuleType, small_run: Any) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
    with pytest.raises(RuntimeError, match="needs a whole body"):
        blender.ops.tricap.make_control_rig()
    with pytest.raises(RuntimeError, match="needs a whole body"):
        blender.ops.tricap.snap_limbs(to="FK")
