"""The rest pose on the floor, and the root bone that carries the path."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.fingers import shape_for_skin
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.foundation.progress import Monitor
from tricap.core.motion.floor import floor_height
from tricap.core.motion.sources import from_run

from .conftest import FPS
from .walking import FLOOR_M, FRAMES, walk


def test_the_floor_is_found_from_standing_feet(person: tuple[BodyShape, float]) -> None:
    shape, hip_m = person
    foot = next(b for b, bone in enumerate(shape.skeleton.bones) if bone.name == "foot.R")
    _, head_m = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dof_names)))
    values = walk(shape, hip_m)
    found = floor_height(shape, values, np.arange(FRAMES), FPS, float(head_m[foot, 2]) + hip_m)
    assert found == pytest.approx(FLOOR_M, abs=1e-6)
    assert floor_height(shape, np.full_like(values, np.nan), np.arange(FRAMES), FPS, 0.1) is None
    arm = default_shape(read_model("arm.R"))
    assert floor_height(arm, np.zeros((3, len(arm.skeleton.dof_names))), np.arange(3), FPS, 0.1) is None


def placed(bpy: ModuleType, body: Any, names: tuple[str, ...]) -> np.ndarray:
    """Matrices (T, B, 4, 4) of bones in the world."""
    found = []
    for frame in range(FRAMES):
        bpy.context.scene.frame_set(frame)
        found.append([body.matrix_world @ body.pose.bones[name].matrix for name in names])
    return np.array(found)


def test_the_rest_pose_stands_on_the_floor_and_the_root_carries_the_path(empty: ModuleType, out: Path) -> None:
    from tricap.addon.scene.build import build_scene

    build_scene(out)
    body, motion = empty.data.objects["Body"], from_run(out)
    skin = np.array([v.co for v in empty.data.objects["Skin"].data.vertices])
    assert abs(skin[:, 2].min()) < 1e-6 and body.location.z == pytest.approx(FLOOR_M, abs=1e-5)
    bones = {name: np.array(bone.head_local) for name, bone in body.data.bones.items()}
    for name, head in bones.items():
        if name.endswith(".R"):
            np.testing.assert_allclose(head * (-1, 1, 1), bones[name[:-1] + "L"], atol=1e-6)
    rows = [b for b, name in enumerate(motion.rig.names) if name in body.pose.bones]
    found = placed(empty, body, tuple(motion.rig.names[b] for b in rows))
    np.testing.assert_allclose(found[..., :3, 3], motion.head_m[:, rows], atol=5e-6)
    np.testing.assert_allclose(found[..., :3, :3], motion.R[:, rows], atol=1e-5)
    root = placed(empty, body, ("root",))[:, 0, :3, 3]
    np.testing.assert_allclose(root[:, :2], motion.head_m[:, 0, :2], atol=1e-6)
    np.testing.assert_allclose(root[:, 2], FLOOR_M, atol=1e-5)
    assert {bone.color.palette for bone in body.data.bones} == {"THEME01", "THEME04", "THEME09"}


def test_the_views_of_a_written_file_look_at_the_person(empty: ModuleType, out: Path, tmp_path: Path) -> None:
    """The person stands somewhere in the world; a file that the command writes opens with it in view."""
    from tricap.addon.scene.build import build_scene

    build_scene(out, tmp_path / "body.blend")
    empty.ops.wm.open_mainfile(filepath=str(tmp_path / "body.blend"))
    pelvis = empty.data.objects["Body"].matrix_world @ empty.data.objects["Body"].pose.bones["pelvis"].head
    views = [s.region_3d for screen in empty.data.screens for a in screen.areas for s in a.spaces if s.type == "VIEW_3D"]
    assert views and all((view.view_location - pelvis).length < 0.3 and 3 < view.view_distance < 6 for view in views)


@pytest.mark.slow
def test_another_floor_leaves_the_motion_in_the_world(empty: ModuleType, out: Path) -> None:
    from tricap.addon.scene import standing
    from tricap.addon.scene.build import build_scene

    build_scene(out)
    scene, body, names = empty.context.scene, empty.data.objects["Body"], ("pelvis", "foot.L", "head")
    before, other = placed(empty, body, names), FLOOR_M + 0.07
    standing.stand_on(scene, other)
    assert standing.floor_of(scene) == pytest.approx(other) and empty.data.objects["Floor"].location.z == pytest.approx(other)
    np.testing.assert_allclose(placed(empty, body, names), before, atol=5e-6)
    np.testing.assert_allclose(placed(empty, body, ("root",))[:, 0, 2, 3], other, atol=1e-5)
    build_scene(out)
    body = empty.data.objects["Body"]
    assert body.location.z == pytest.approx(other, abs=1e-6), "a scene that is built again keeps its floor"
    np.testing.assert_allclose(placed(empty, body, names), before, atol=5e-6)


@pytest.mark.slow
def test_the_scene_is_tidy_and_a_render_shows_the_body(empty: ModuleType, out: Path) -> None:
    from tricap.addon.scene.build import build_scene

    empty.context.scene.world = None
    build_scene(out)
    (top,) = empty.context.scene.collection.children
    parts = {part.name: {o.name for o in part.all_objects if o.type != "META"} for part in top.children}
    assert parts == {
        "Cameras": set(),
        "Measured": set(),
        "Body": {"Body", "Ellipsoids", "Skin"},
        "Lights": {"Key light", "Fill light"},
        "Floor": {"Floor"},
    }
    assert not top.objects and top.children["Measured"].hide_render and not empty.data.objects["Skin"].hide_render
    assert empty.context.scene.world is not None
    floor = empty.data.objects["Floor"]
    path, corners = from_run(out).head_m[:, 0], np.array([floor.matrix_world @ v.co for v in floor.data.vertices])
    assert np.abs(corners[:, 2] - FLOOR_M).max() < 1e-5
    assert (corners.min(axis=0)[:2] < path.min(axis=0)[:2] - 1).all() and (corners.max(axis=0)[:2] > path.max(axis=0)[:2] + 1).all()
    build_scene(out)
    assert len(empty.data.collections) == 7, "an earlier build is replaced, with its collections"


def walker(bpy: ModuleType, *, fingers: bool = False) -> Any:
    """The walking person in an empty scene, without a skin; with the bones of fingers and toes that a skin brings."""
    from tricap.addon.scene import action, armature
    from tricap.addon.scene.standing import Standing

    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    scene, shape = bpy.context.scene, default_shape(read_model("full"))
    shape = shape_for_skin(shape, SkinSettings()) if fingers else shape
    stand = Standing(lift_m=0.96, floor_m=FLOOR_M)
    body, values = armature.add_armature(scene.collection, shape, stand), walk(shape, 0.96)
    known = {bone.name: np.full(FRAMES, 0.003) for bone in armature.rig_bones(shape) if not armature.is_finger(bone)}
    action.add_action(body, shape, np.arange(FRAMES), shape.skeleton.dof_names, values, np.full(values.shape, 0.01), stand, known)
    scene.frame_start, scene.frame_end = 0, FRAMES - 1
    return body


def test_the_path_moves_to_the_object_and_back_with_its_edits(blender: ModuleType) -> None:
    body, scene = walker(blender), blender.context.scene
    names = ("pelvis", "hand.R")
    curve = body.animation_data.action.fcurve_ensure_for_datablock(body, 'pose.bones["root"].location', index=0)
    for point in curve.keyframe_points:
        point.co.y += 0.25  # an edit that must not be lost
    before = placed(blender, body, names)
    assert scene.tricap.path == "BONE"
    scene.tricap.path = "OBJECT"
    assert scene.tricap.path == "OBJECT"
    np.testing.assert_allclose(placed(blender, body, names), before, atol=1e-6)
    assert np.ptp([point.co.y for point in curve.keyframe_points]) > 0.2 and curve.data_path == "location"
    np.testing.assert_allclose(body.pose.bones["root"].location, 0, atol=1e-7)
    scene.tricap.path = "IN_PLACE"
    still = placed(blender, body, names)
    np.testing.assert_allclose(still[:, 0, :2, 3], 0, atol=1e-6)
    np.testing.assert_allclose(still[..., 2, 3], before[..., 2, 3], atol=1e-6)
    body.location.x += 3.0  # the person is put elsewhere
    for path in ("BONE", "OBJECT", "BONE"):
        scene.tricap.path = path
        np.testing.assert_allclose(placed(blender, body, names)[..., :3, 3], before[..., :3, 3] + (3, 0, 0), atol=1e-6)
    body.data.bones["root"].name = "mover"
    scene.tricap.path = "OBJECT"  # there is nothing to move
    assert scene.tricap.path == "BONE"


def test_a_part_of_a_body_stands_nowhere(blender: ModuleType, small_run: Any) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    assert blender.ops.tricap.build_scene(out=str(small_run.out)) == {"FINISHED"}
    assert blender.data.objects["Body"].location.z == 0 and blender.context.scene.tricap.path == "BONE"
    blender.context.scene.tricap.path = "OBJECT"  # there is nothing to move
    assert blender.context.scene.tricap.path == "BONE"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fbx", "glb"])
def test_posed_fingers_are_exported(empty: ModuleType, out: Path, tmp_path: Path, kind: str) -> None:
    """A finger that the animator bends arrives in other programs' files, with the skin that it deforms."""
    from tricap.addon.retarget.export import exporting_played
    from tricap.addon.retarget.files import open_moving
    from tricap.addon.retarget.read import ended
    from tricap.addon.scene.build import build_scene

    build_scene(out)
    body, scene, bent = empty.data.objects["Body"], empty.context.scene, "f_index.02.R"
    for frame, angle in ((scene.frame_start, 0.0), (scene.frame_end, 0.9)):
        body.pose.bones[bent].rotation_euler.x = angle
        body.pose.bones[bent].keyframe_insert("rotation_euler", index=0, frame=frame)
    scene.frame_set(scene.frame_end)
    wanted = [np.array(body.matrix_world @ body.pose.bones[name].head) for name in ("f_index.03.R", "thumb.03.L")]
    ended(exporting_played(body, kind, tmp_path / f"a.{kind}", "plain", Monitor()))
    armature = open_moving(tmp_path / f"a.{kind}")
    names = {name.replace(".", "_"): name for name in armature.data.bones.keys()}
    scene = empty.context.scene
    scene.frame_set(round(armature.animation_data.action.frame_range[1]))
    found = [np.array(armature.matrix_world @ armature.pose.bones[names[name]].head) for name in ("f_index_03_R", "thumb_03_L")]
    np.testing.assert_allclose(found, wanted, atol=1e-4)
    groups = {group.name.replace(".", "_") for o in empty.data.objects if o.type == "MESH" for group in o.vertex_groups}
    assert {"f_index_02_R", "thumb_03_L"} <= groups
