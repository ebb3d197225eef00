"""Armature, action, metaballs and skin against core's kinematics and field."""

from types import ModuleType

import numpy as np
import pytest

from tricap.core.body import metaballs as core_metaballs
from tricap.core.body.complete import complete_shape
from tricap.core.body.metaball_groups import metaball_groups
from tricap.core.body.model_file import model_names, read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.person_skin import rest_skin
from tricap.core.body.skin.posed import Poser

from .conftest import FRAMES, arm

ROTATION = 1e-5  # measured 4e-7 for a limb, 4.2e-6 for the seven joints from pelvis to hand: single precision of the pose matrices
PLACE_M = 5e-6  # measured 2.2e-7, limb; a whole body is seven bones deep
JOINT_MAX_M = 1e-3
SURFACE_RMS_M, SURFACE_MAX_M = 0.1e-3, 0.3e-3  # measured 0.05 and 0.12 mm, arm; 0.07 and 0.21 mm, leg; rest and bent to 110°


def motion_within_limits(shape: BodyShape, count: int, seed: int) -> np.ndarray:
    """Random postures (count, D) over the whole range of every DOF."""
    low = np.array([max(dof.limits[0], -1.0 if i < 3 else -3.5) for i, dof in enumerate(shape.skeleton.dofs)])
    high = np.array([min(dof.limits[1], 1.0 if i < 3 else 3.5) for i, dof in enumerate(shape.skeleton.dofs)])
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


def animated(bpy: ModuleType, shape: BodyShape, motion: np.ndarray, frames: np.ndarray) -> object:
    """The armature with its action."""
    from tricap.addon.scene import action, armature

    armature_object = armature.add_armature(bpy.context.scene.collection, shape)
    action.add_action(armature_object, shape, frames, shape.skeleton.dof_names, motion, np.full(motion.shape, 0.01))
    return armature_object


@pytest.mark.parametrize("model", model_names())
def test_the_pose_channels_are_the_degrees_of_freedom(empty: ModuleType, model: str) -> None:
    shape = default_shape(read_model(model))
    motion = motion_within_limits(shape, 25, seed=5)
    body = animated(empty, shape, motion, np.arange(25))
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    for frame in range(25):
        empty.context.scene.frame_set(frame)
        pose = body.evaluated_get(empty.context.evaluated_depsgraph_get()).pose
        for b, bone in enumerate(shape.skeleton.bones):
            if bone.name.startswith(("collar", "hip")):  # rigid connections, which are no bones of a rig
                assert bone.name not in pose.bones and not bone.dofs
                continue
            matrix = np.array(pose.bones[bone.name].matrix)
            np.testing.assert_allclose(matrix[:3, :3], R[frame, b], atol=ROTATION)
            np.testing.assert_allclose(matrix[:3, 3], head[frame, b], atol=PLACE_M)
            tail = head[frame, b] + shape.lengths_m[b] * R[frame, b, :, 1]
            np.testing.assert_allclose(pose.bones[bone.name].tail, tail, atol=PLACE_M)


def test_rest_frames_and_locks(empty: ModuleType) -> None:
    from tricap.addon.scene import armature

    shape = default_shape(read_model("arm.R"))
    body = armature.add_armature(empty.context.scene.collection, shape)
    for bone in shape.skeleton.bones:
        rest = np.array(body.data.bones[bone.name].matrix_local)[:3, :3]
        np.testing.assert_allclose(rest, bone.R_rest, atol=ROTATION)
        free = {"xyz"[i] for i in range(3) if not body.pose.bones[bone.name].lock_rotation[i]}
        assert free == {dof.axis for dof in bone.dofs}
        assert all(body.pose.bones[bone.name].lock_location) and all(body.pose.bones[bone.name].lock_scale)
        assert body.pose.bones[bone.name].rotation_mode == bone.rotation_mode
    root = body.pose.bones["root"]
    assert not any(root.lock_location) and all(root.lock_rotation)
    forearm = body.pose.bones["forearm.R"]
    assert forearm.lock_ik_z and forearm.use_ik_limit_x
    np.testing.assert_allclose([forearm.ik_min_x, forearm.ik_max_x], np.radians([0, 150]), atol=1e-6)


def test_limits_hold_a_hand_posed_bone_but_never_the_measured_motion(empty: ModuleType) -> None:
    shape, motion, _ = arm()
    body = animated(empty, shape, motion, np.array(FRAMES))
    forearm = body.pose.bones["forearm.R"]
    assert not forearm.constraints["Joint limits"].mute
    body.animation_data.action = None
    forearm.rotation_euler = (-1.0, 0.0, 0.0)
    empty.context.view_layer.update()
    straight = np.array(body.pose.bones["upper_arm.R"].matrix)[:3, 1]
    np.testing.assert_allclose(np.array(forearm.matrix)[:3, 1], straight, atol=1e-5)
    beyond = motion.copy()
    beyond[:, shape.skeleton.layout["elbow.R flexion"]] = -0.2
    other = animated(empty, shape, beyond, np.array(FRAMES))
    assert other.pose.bones["forearm.R"].constraints["Joint limits"].mute


def test_a_bent_elbow_brings_the_forearm_forward(empty: ModuleType) -> None:
    """The person faces −Y: a flexed elbow moves the wrist to −Y of the straight arm."""
    shape = default_shape(read_model("arm.R"))
    motion = np.zeros((2, len(shape.skeleton.dof_names)))
    motion[1, shape.skeleton.layout["elbow.R flexion"]] = np.radians(90)
    body = animated(empty, shape, motion, np.arange(2))
    wrist = []
    for frame in range(2):
        empty.context.scene.frame_set(frame)
        wrist.append(np.array(body.evaluated_get(empty.context.evaluated_depsgraph_get()).pose.bones["forearm.R"].tail))
    assert wrist[0][0] < -0.3 and abs(wrist[0][1]) < 1e-6
    assert wrist[1][1] < -0.2


def test_frames_without_a_fit_get_no_keys(empty: ModuleType) -> None:
    shape, motion, _ = arm()
    motion[2] = np.nan
    body = animated(empty, shape, motion, np.array(FRAMES))
    drivers = {(path, index): len(points) for path, index, points in curves(body)}
    assert set(drivers.values()) >= {len(FRAMES) - 1}
    assert len(drivers) == motion.shape[1]


def test_channels_are_grouped_by_bone_and_sigmas_are_an_action_of_their_own(empty: ModuleType) -> None:
    shape, motion, _ = arm()
    body = animated(empty, shape, motion, np.array(FRAMES))
    data = body.animation_data
    (track,) = data.nla_tracks
    assert track.name == "Uncertainty" and track.lock
    for action, slot in ((data.action, data.action_slot), (track.strips[0].action, track.strips[0].action_slot)):
        bag = action.layers[0].strips[0].channelbag(slot)
        assert all(curve.group is not None and f'"{curve.group.name}"' in curve.data_path for curve in bag.fcurves)
        assert len({group.name for group in bag.groups}) == len(bag.groups) == 3  # root, upper arm, forearm
    empty.context.scene.frame_set(FRAMES[2])
    assert body.pose.bones["forearm.R"]["sigma elbow.R flexion"] == pytest.approx(0.01)


def curves(body: object) -> list[tuple[str, int, object]]:
    """(data path, index, keys) of every curve, in Blender 4.5 and 5.2."""
    strip = body.animation_data.action.layers[0].strips[0]
    bag = strip.channelbag(body.animation_data.action_slot)
    return [(curve.data_path, curve.array_index, curve.keyframe_points) for curve in bag.fcurves]


@pytest.mark.parametrize("balls", ["three", "complete"])
def test_the_metaballs_surface_is_the_fitted_one(empty: ModuleType, balls: str) -> None:
    from tricap.addon.scene import metaballs

    shape = default_shape(read_model("arm.R"))
    shape = shape if balls == "three" else complete_shape(shape)
    motion = np.zeros((2, len(shape.skeleton.dof_names)))
    motion[1, :3] = 0.3, -0.2, 1.1
    motion[1, shape.skeleton.layout["elbow.R flexion"]] = np.radians(70)
    body = animated(empty, shape, motion, np.arange(2))
    flesh = metaballs.add_metaballs(empty.context.scene.collection, body, shape)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    for frame in range(2):
        empty.context.scene.frame_set(frame)
        points = world_vertices(empty, flesh[0])
        assert len(points) > 2000
        F, gradient, _, _ = core_metaballs.field_and_derivatives(shape.metaballs, shape.lengths_m, R[frame], head[frame], points)
        distance = (F - core_metaballs.THRESHOLD) / np.linalg.norm(gradient, axis=1)
        assert np.sqrt((distance**2).mean()) < SURFACE_RMS_M
        assert np.abs(distance).max() < SURFACE_MAX_M


@pytest.mark.slow
def test_at_the_joints_of_a_whole_body_the_metaballs_are_the_families_surface(empty: ModuleType) -> None:
    """Elbows bent by 100° and knees by 80°. Measured 0.11 mm RMS, at most 0.39 mm."""
    from tricap.addon.scene import metaballs

    shape = default_shape(read_model("full"))
    motion = np.zeros((1, len(shape.skeleton.dof_names)))
    for side in "LR":
        motion[0, shape.skeleton.layout[f"elbow.{side} flexion"]] = np.radians(100)
        motion[0, shape.skeleton.layout[f"knee.{side} flexion"]] = np.radians(80)
    body = animated(empty, shape, motion, np.arange(1))
    flesh = metaballs.add_metaballs(empty.context.scene.collection, body, shape)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion[0])
    empty.context.scene.frame_set(0)
    seen = [part for part in flesh if "." not in part.name.replace(".R", "").replace(".L", "")]
    found = metaball_groups(shape)
    assert len(seen) == len(found)
    for family, balls in zip(seen, found):
        points = world_vertices(empty, family)
        active = np.ones((len(points), len(balls.weight)), dtype=bool)
        F, gradient, _, _ = core_metaballs.field_and_derivatives(balls, shape.lengths_m, R, head, points, active)
        distance = (F - core_metaballs.THRESHOLD) / np.linalg.norm(gradient, axis=1)
        assert len(points) > 1000 and np.abs(distance).max() < JOINT_MAX_M


def test_two_bodies_do_not_melt_into_one(empty: ModuleType) -> None:
    from tricap.addon.scene import metaballs

    shape = default_shape(read_model("arm.R"))
    families = []
    for _ in range(2):
        body = animated(empty, shape, np.zeros((1, len(shape.skeleton.dof_names))), np.arange(1))
        families.append({part.name.split(".")[0] for part in metaballs.add_metaballs(empty.context.scene.collection, body, shape)})
    assert families == [{"Flesh"}, {"Flesh B"}]


def test_the_skin_follows_the_bones(empty: ModuleType) -> None:
    from tricap.addon.scene import skin

    shape = default_shape(read_model("arm.R"))
    motion = np.zeros((2, len(shape.skeleton.dof_names)))
    motion[1, :3] = 0.3, -0.2, 1.1
    motion[1, shape.skeleton.layout["shoulder.R flexion"]] = np.radians(50)
    motion[1, shape.skeleton.layout["elbow.R flexion"]] = np.radians(70)
    body = animated(empty, shape, motion, np.arange(2))
    made = rest_skin(shape, SkinSettings())
    skin_object = skin.add_skin(empty.context.scene.collection, body, shape, prepared=made)
    for frame in range(2):  # as in the run's files; Blender's weights are quantised
        empty.context.scene.frame_set(frame)
        posed = Poser(shape, made.weights).posed(made.vertices_m, motion[frame])
        np.testing.assert_allclose(world_vertices(empty, skin_object), posed, atol=1e-4)


def world_vertices(bpy: ModuleType, thing: object) -> np.ndarray:
    """Vertices (V, 3) of the evaluated object, in the world."""
    evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    flat = np.empty(3 * len(mesh.vertices), dtype=np.float32)
    mesh.vertices.foreach_get("co", flat)
    matrix = np.array(evaluated.matrix_world)
    points = flat.reshape(-1, 3).astype(float) @ matrix[:3, :3].T + matrix[:3, 3]
    evaluated.to_mesh_clear()
    return points
