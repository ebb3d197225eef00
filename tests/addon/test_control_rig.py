"""*Make Control Rig*: Rigify's controls play the motion and drive the body; IK and FK snap to each other; corrections are layered."""

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from mathutils import Matrix, Quaternion

from tricap.addon.scene.action_curves import curves_of
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.geometry.rotation import angle_of, transposed, twist_about
from tricap.core.motion.formats.bvh import read_bvh
from tricap.core.motion.tables import JointTable

from .test_scene_standing import FRAMES, walk, walker

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


def test_locked_feet_are_baked_and_the_lock_is_muted(blender: ModuleType) -> None:
    """The lock would act on top of the controls: 17 mm off. Of a deleted control rig nothing is left: it acts again."""
    body, scene = walker(blender), blender.context.scene
    bend(body)
    foot_lock = importlib.import_module("bl_ext.user_default.tricap.addon.editing.foot_lock")
    assert blender.ops.tricap.lock_feet() == {"FINISHED"}
    wanted = poses(scene, body)
    for _ in range(2):
        assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
        for found, before in zip(poses(scene, body), wanted, strict=True):
            check_same(found, before, ANGLE_DEG, PLACE_M)
        assert not scene.tricap.foot_lock and "Foot Lock.L" in scene.objects
        scene.frame_set(9)
        assert blender.ops.tricap.snap_limbs(to="IK", limbs="thigh.L") == {"FINISHED"}
        check_same(pose(body), wanted[9], SNAP_DEG, SNAP_M)
        with pytest.raises(foot_lock.InputError, match="“Body controls” drives “Body” and plays the locked feet"):
            foot_lock.activate_all(scene, True)
        assert not scene.tricap.foot_lock
        blender.data.objects.remove(blender.data.objects["Body controls"])


def test_snapping_with_keys_changes_no_other_frame(blender: ModuleType) -> None:
    """One key of IK would hold in all frames: 18° and 154 mm off. Curves of corrections keep their shape between their keys, too."""
    body, scene = corrected(blender), blender.context.scene
    rig, wanted = blender.data.objects["Body controls"], poses(scene, body)
    scene.tool_settings.use_keyframe_insert_auto = True
    for frame, to, limbs in (
        (6, "IK", ""),
        (7, "IK", "upper_arm.L"),
        (9, "FK", ""),
        (7, "FK", "upper_arm.L"),
        (0, "IK", "thigh.L, thigh.R"),
    ):
        scene.frame_set(frame)
        assert blender.ops.tricap.snap_limbs(to=to, limbs=limbs) == {"FINISHED"} and scene.frame_current == frame
        check_same(pose(body), wanted[frame], SNAP_DEG, SNAP_M)
        check_all(scene, body, wanted)
    assert switches(scene, rig, "upper_arm.L") == [1.0] * 6 + [0.0] + [1.0] * 5
    assert switches(scene, rig, "thigh.R") == [0.0] + [1.0] * 5 + [0.0] + [1.0] * 5


@pytest.mark.slow
def test_limbs_are_snapped_over_the_frames_that_are_played(blender: ModuleType) -> None:
    """To IK in the preview range, where a foot is then moved, and back to FK with this correction."""
    body, scene = corrected(blender), blender.context.scene
    rig, wanted = blender.data.objects["Body controls"], poses(scene, body)
    scene.use_preview_range, scene.frame_preview_start, scene.frame_preview_end = True, 3, 8
    scene.frame_set(5)
    mesh = blender.data.objects.new("Skin", blender.data.meshes.new("Skin"))
    scene.collection.objects.link(mesh)
    assert blender.ops.tricap.bake_limbs(to="IK") == {"FINISHED"}
    assert scene.frame_current == 5 and not mesh.hide_viewport
    check_all(scene, body, wanted)
    for limb in ("thigh.L", "upper_arm.R"):
        assert switches(scene, rig, limb) == [1.0] * 3 + [0.0] * 6 + [1.0] * 3
    lift(rig, "foot_ik.R", scene, range(4, 7))
    lifted = poses(scene, body)
    assert max(np.abs(lifted[5][1] - wanted[5][1]).max(axis=1)) > 0.02
    assert blender.ops.tricap.bake_limbs(to="FK", limbs="thigh.R") == {"FINISHED"}
    check_all(scene, body, lifted)
    assert switches(scene, rig, "thigh.R") == [1.0] * FRAMES and switches(scene, rig, "thigh.L")[5] == 0.0
    scene.use_preview_range = False
    assert blender.ops.tricap.bake_limbs(to="FK") == {"FINISHED"}
    check_all(scene, body, lifted)
    assert not any(0.0 in switches(scene, rig, limb) for limb in ("thigh.L", "thigh.R", "upper_arm.L", "upper_arm.R"))
    snapping = importlib.import_module("bl_ext.user_default.tricap.addon.retarget.snapping")
    with pytest.raises(snapping.InputError, match="plays no frames"):
        next(snapping.snapping_frames(body, "FK", (), range(0)))


def test_baking_limbs_is_stopped_and_nothing_has_changed(blender: ModuleType) -> None:
    body, scene = corrected(blender), blender.context.scene
    rig, wanted = blender.data.objects["Body controls"], poses(scene, body)
    snapping = importlib.import_module("bl_ext.user_default.tricap.addon.retarget.snapping")
    before = {curve.data_path: len(curve.keyframe_points) for curve in curves_of(rig.animation_data.action)}
    scene.frame_set(5)
    monitor = snapping.Monitor()
    steps = snapping.snapping_frames(body, "IK", (), range(FRAMES), monitor)
    next(steps)
    next(steps)
    monitor.cancel()
    with pytest.raises(importlib.import_module("bl_ext.user_default.tricap.core.foundation.progress").Cancelled):
        next(steps)
    assert scene.frame_current == 5 and {c.data_path: len(c.keyframe_points) for c in curves_of(rig.animation_data.action)} == before
    check_all(scene, body, wanted)


def corrected(bpy: ModuleType) -> Any:
    """A walker with a control rig whose arm has corrections with curved channels."""
    body = walker(bpy)
    bend(body)
    assert bpy.ops.tricap.make_control_rig() == {"FINISHED"}
    arm = bpy.data.objects["Body controls"].pose.bones["upper_arm_fk.L"]
    for frame, turned in ((1, (1.0, 0.0, 0.0, 0.0)), (4, (0.9, 0.3, 0.0, 0.2)), (10, (0.9, -0.1, 0.3, 0.0))):
        bpy.context.scene.frame_set(frame)
        arm.rotation_quaternion = arm.rotation_quaternion @ Quaternion(turned).normalized()
        arm.keyframe_insert("rotation_quaternion")
    return body


def check_all(scene: Any, body: Any, wanted: list[tuple[np.ndarray, np.ndarray]]) -> None:
    now = scene.frame_current
    for found, before in zip(poses(scene, body, len(wanted)), wanted, strict=True):
        check_same(found, before, SNAP_DEG, 5 * SNAP_M)  # after several changes; IK itself is not exact; measured 2e-4
    scene.frame_set(now)


def switches(scene: Any, rig: Any, limb: str) -> list[float]:
    """Of a limb in every frame: 0 where IK moves it, 1 where FK does."""
    part, side = limb.split(".")
    found = []
    for frame in range(FRAMES):
        scene.frame_set(frame)
        found.append(rig.pose.bones[f"{part}_parent.{side}"]["IK_FK"])
    return found


def lift(rig: Any, name: str, scene: Any, frames: range) -> None:
    for frame in frames:
        scene.frame_set(frame)
        rig.pose.bones[name].matrix = Matrix.Translation((0.0, 0.0, 0.05)) @ rig.pose.bones[name].matrix
        rig.pose.bones[name].keyframe_insert("location")


def test_the_uncertainty_is_shown_where_the_controls_are(blender: ModuleType) -> None:
    """The body is hidden under its control rig; its bones are where they were, and are chosen by their controls."""
    uncertainty = importlib.import_module("bl_ext.user_default.tricap.addon.editing.uncertainty")
    body, scene = walker(blender), blender.context.scene
    bend(body)
    sigmas = uncertainty.sigmas_of(body)
    scene.frame_set(4)
    before, sigma = uncertainty.bones_drawn(body, sigmas, 4)
    assert len(before) == len(sigma) > 15 and len(uncertainty.bones_drawn(body, sigmas, 99)[0]) == 0
    assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
    rig = blender.data.objects["Body controls"]
    assert not body.visible_get()
    np.testing.assert_allclose(uncertainty.bones_drawn(body, sigmas, 4)[0], before, atol=PLACE_M)
    assert uncertainty.chosen_bones(body) == set()
    blender.ops.object.mode_set(mode="POSE")
    for bone in rig.pose.bones:
        chosen = bone.name in ("forearm_fk.L", "hand_ik.R", "chest")
        (bone if hasattr(bone, "select") else bone.bone).select = chosen  # Blender 5 selects pose bones
    assert uncertainty.chosen_bones(body) == {"forearm.L", "hand.R", "chest"}
    blender.ops.object.mode_set(mode="OBJECT")
    rig.hide_set(True)
    assert len(uncertainty.bones_drawn(body, sigmas, 4)[0]) == 0


BUMP = np.array([0.0, 0.3, 0.6, 0.2])  # radians, in the frames from 4 on
PULLED = {"shoulder.L flexion": 1.0, "elbow.L flexion": 1.0, "hip.R flexion": -0.5, "pelvis z": 0.05}
LEAST_KNOWN_M, DOF_SIGMA = 0.04, 0.02  # of the wrist and of every degree of freedom in these frames


def fitted_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let Fit Again, without a take, change the frames from 4 to 7 by BUMP, and their sigmas."""
    around, again = (
        importlib.import_module(f"bl_ext.user_default.tricap.{name}") for name in ("core.run.around_clicks", "addon.correcting.fit_again")
    )
    shape = default_shape(read_model("full"))
    before = walk(shape, 0.96)[4:8]
    after = before.copy()
    names = list(shape.skeleton.dof_names)
    for name, part in PULLED.items():
        after[:, names.index(name)] += part * BUMP
    found = around.FittedAgain(
        shape=shape,
        frames=np.arange(4, 8),
        dof_names=tuple(names),
        before=before,
        after=after,
        sigma=np.full(after.shape, DOF_SIGMA),
        joints=joints_of(shape),
    )
    monkeypatch.setattr(again.project, "chosen", lambda scene, take, out: (Path(), Path(), {}))
    monkeypatch.setattr(around, "fit_around_clicks", lambda *_: found)


def joints_of(shape: Any) -> JointTable:
    """All joints as well known as the walker's, but for the left wrist."""
    sigma = {name: np.full(FRAMES, LEAST_KNOWN_M if name == "wrist.L" else 0.003) for name in shape.skeleton.joint_names}
    return JointTable(
        frames=np.arange(FRAMES),
        time_s=np.zeros(FRAMES),
        joints_m={name: np.zeros((FRAMES, 3)) for name in sigma},
        sigma_m=sigma,
        frame_sigma_m=sigma,
        known={name: ("seen",) * FRAMES for name in sigma},
    )


def test_frames_that_are_fitted_again_have_the_new_sigmas(blender: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also while the uncertainty is shown, for which they have been read."""
    fitted_again(monkeypatch)
    body, scene = walker(blender), blender.context.scene
    editing = "bl_ext.user_default.tricap.addon.editing"
    uncertainty, curves = (importlib.import_module(f"{editing}.{name}") for name in ("uncertainty", "curves"))
    scene.tricap.show_uncertainty = True
    assert uncertainty._shown()[1]["forearm.L"][1] == pytest.approx(np.full(FRAMES, 3.0))
    assert blender.ops.tricap.fit_again() == {"FINISHED"}
    wanted = np.full(FRAMES, 3.0)
    wanted[4:8] = 1e3 * LEAST_KNOWN_M
    shown = uncertainty._shown()[1]
    assert shown["forearm.L"][1] == pytest.approx(wanted) and shown["thigh.L"][1] == pytest.approx(np.full(FRAMES, 3.0))
    _, angle = curves.keys_of(curves.sigma_curves(body)["sigma elbow.L flexion"])
    assert angle == pytest.approx(np.where(np.isin(np.arange(FRAMES), range(4, 8)), DOF_SIGMA, 0.01))


@pytest.mark.parametrize("path", ["BONE", "OBJECT"])
def test_what_is_fitted_again_arrives_in_the_base_layer(blender: ModuleType, monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    """With locked feet, a correction, and a control rig that was moved since."""
    fitted_again(monkeypatch)
    body = locked(blender, path)
    before = poses(blender.context.scene, body)
    assert blender.ops.tricap.fit_again() == {"FINISHED"}
    wanted = poses(blender.context.scene, body)
    body = locked(blender, path)
    scene = blender.context.scene
    scene.frame_set(3)
    assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
    rig = blender.data.objects["Body controls"]
    moved = Matrix.Translation((0.5, -1.0, 0.0)) @ Matrix.Rotation(0.7, 4, "Z")
    rig.matrix_world = moved @ rig.matrix_world
    rig.pose.bones["forearm_fk.R"].rotation_quaternion = (0.9, 0.1, 0.0, 0.2)
    rig.pose.bones["forearm_fk.R"].keyframe_insert("rotation_quaternion", frame=2)
    corrected = poses(scene, body)
    scene.frame_set(9)
    assert blender.ops.tricap.fit_again() == {"FINISHED"} and scene.frame_current == 9
    row = list(body.pose.bones.keys()).index("forearm.R")
    for frame, (found, earlier) in enumerate(zip(poses(scene, body), corrected, strict=True)):
        own = [b for b, bone in enumerate(body.pose.bones) if b != row and bone not in body.pose.bones["forearm.R"].children_recursive]
        check_same(tuple(x[own] for x in found), tuple(x[own] for x in placed(wanted[frame], moved)), ANGLE_DEG, PLACE_M)
        if frame not in range(4, 8):
            check_same(found, earlier, 1e-3, 1e-6)
    assert np.abs(wanted[6][1] - before[6][1]).max() > 0.05


def test_the_base_layer_is_missing(blender: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted_again(monkeypatch)
    walker(blender)
    assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
    tracks = blender.data.objects["Body controls"].animation_data.nla_tracks
    tracks.remove(tracks[0])
    with pytest.raises(RuntimeError, match="“Body controls” no longer plays its base layer.*delete it, and make it again"):
        blender.ops.tricap.fit_again()


def locked(bpy: ModuleType, path: str) -> Any:
    """The walker with bent limbs and locked feet."""
    body = walker(bpy)
    bend(body)
    bpy.context.scene.tricap.path = path
    assert bpy.ops.tricap.lock_feet() == {"FINISHED"}
    return body


def placed(pose: tuple[np.ndarray, np.ndarray], by: Any) -> tuple[np.ndarray, np.ndarray]:
    """A pose after its body was moved."""
    M = np.array(by)
    return M[:3, :3] @ pose[0], pose[1] @ M[:3, :3].T + M[:3, 3]


def poses(scene: Any, body: Any, count: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """`pose` in every frame of the scene, or in the first ones."""
    found = []
    for frame in range(count or scene.frame_end + 1):
        scene.frame_set(frame)
        found.append(pose(body))
    return found


def test_the_shapes_of_the_controls_lie_with_the_body(blender: ModuleType) -> None:
    """Rigify adds them to the collection that is active, which is the user's."""
    body, scene = walker(blender), blender.context.scene
    ours, mine = (blender.data.collections.new(name) for name in ("Body", "Mine"))
    for collection in (ours, mine):
        scene.collection.children.link(collection)
    scene.collection.objects.unlink(body)
    ours.objects.link(body)
    blender.context.view_layer.active_layer_collection = blender.context.view_layer.layer_collection.children["Mine"]
    assert blender.ops.tricap.make_control_rig() == {"FINISHED"}
    rig = blender.data.objects["Body controls"]
    assert not mine.children and not mine.objects and list(scene.collection.children) == [ours, mine]
    (widgets,) = ours.children
    assert all(bone.custom_shape.users_collection == (widgets,) for bone in rig.pose.bones if bone.custom_shape is not None)
    assert blender.context.view_layer.layer_collection.children["Body"].children[0].exclude
    assert blender.context.view_layer.active_layer_collection.name == "Mine"


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


def test_a_control_rig_needs_a_whole_body(blender: ModuleType, small_run: Any) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
    with pytest.raises(RuntimeError, match="needs a whole body"):
        blender.ops.tricap.make_control_rig()
    with pytest.raises(RuntimeError, match="needs a whole body"):
        blender.ops.tricap.snap_limbs(to="FK")
