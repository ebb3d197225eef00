"""Edits of the body's own action: smoothing by its sigmas, fewer keys, foot lock; and what the uncertainty strip shows."""

from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape

from .test_scene_standing import FLOOR_M, walk

KNOWN_M, LOST_M = 2e-3, 0.08  # sigmas of places
FRAMES, NOISY = 40, range(10, 20)


def walker(bpy: ModuleType, *, sliding_m: float = 0.0, bent: float = 0.5) -> Any:
    """A person who stands still but for an arm that is uncertain and noisy for ten frames; the body slides by `sliding_m` a frame."""
    from tricap.addon.scene import action, armature
    from tricap.addon.scene.standing import Standing

    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    shape = default_shape(read_model("full"))
    body = armature.add_armature(bpy.context.scene.collection, shape, Standing(lift_m=0.96, floor_m=FLOOR_M))
    values = np.repeat(walk(shape, 0.93)[:1], FRAMES, axis=0)
    values[:, 0] += sliding_m * np.sin(np.arange(FRAMES))
    names = list(shape.skeleton.dof_names)
    for side in "RL":  # knees a little bent, so that a leg can reach
        for name, angle in {f"hip.{side} flexion": bent / 2, f"knee.{side} flexion": bent, f"ankle.{side} flexion": bent / 2}.items():
            if name in names:
                values[:, names.index(name)] = angle
    sigma = np.full(values.shape, np.radians(0.5))
    arm = names.index("shoulder.R flexion")
    values[:, arm] = np.linspace(0, 1, FRAMES)
    values[NOISY, arm] += np.random.default_rng(0).normal(0, 0.2, len(NOISY))
    sigma[NOISY, arm] = 0.2
    places = {bone.name: np.full(FRAMES, KNOWN_M) for bone in armature.rig_bones(shape) if not armature.is_finger(bone)}
    places["forearm.R"][NOISY] = LOST_M
    action.add_action(body, shape, np.arange(FRAMES), names, values, sigma, Standing(lift_m=0.96, floor_m=FLOOR_M), places)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 0, FRAMES - 1
    return body


def arm_angles(bpy: ModuleType, body: Any) -> np.ndarray:
    from tricap.addon.editing.curves import curves_of

    dof = body.data["tricap_dofs"]["shoulder.R flexion"]
    path = f'pose.bones["{dof["bone"]}"].{dof["path"]}'
    curve = next(c for c in curves_of(body.animation_data.action) if c.data_path == path and c.array_index == dof["index"])
    return np.array([curve.evaluate(frame) for frame in range(FRAMES)])


def test_smoothing_moves_what_is_uncertain_and_keeps_the_measured_action(blender: ModuleType) -> None:
    body = walker(blender)
    measured, before = body.animation_data.action, arm_angles(blender, body)
    assert blender.ops.tricap.smooth_uncertain() == {"FINISHED"}
    after, wanted = arm_angles(blender, body), np.sign(before[-1]) * np.linspace(0, 1, FRAMES)
    assert body.animation_data.action != measured and body["tricap_measured_motion"] == measured
    rms = {name: np.sqrt(np.mean((x - wanted)[NOISY] ** 2)) for name, x in (("before", before), ("after", after))}
    assert rms["after"] < 0.3 * rms["before"]
    certain = np.setdiff1d(np.arange(FRAMES), np.arange(NOISY.start - 1, NOISY.stop + 1))
    assert np.degrees(np.abs(after - before)[certain]).max() < 0.5
    again = body.animation_data.action
    assert blender.ops.tricap.smooth_uncertain() == {"FINISHED"} and body.animation_data.action == again


def test_keys_are_reduced_within_the_tolerance(blender: ModuleType) -> None:
    from tricap.addon.editing.curves import motion_curves

    body = walker(blender)
    before = arm_angles(blender, body)
    assert blender.ops.tricap.reduce_keys(tolerance=np.radians(1)) == {"FINISHED"}
    assert sum(len(c.keyframe_points) for c in motion_curves(body)) < 0.1 * FRAMES * len(motion_curves(body))
    assert np.degrees(np.abs(arm_angles(blender, body) - before)).max() < 1.0001


def ankles(bpy: ModuleType, body: Any) -> np.ndarray:
    found = []
    for frame in range(FRAMES):
        bpy.context.scene.frame_set(frame)
        found.append([body.matrix_world @ body.pose.bones[f"foot.{side}"].head for side in "LR"])
    return np.array(found)


def test_locked_feet_stand_still_and_can_be_let_go(blender: ModuleType) -> None:
    body, scene = walker(blender, sliding_m=0.004), blender.context.scene
    before = ankles(blender, body)
    assert np.ptp(before, axis=0).max() > 0.007
    assert blender.ops.tricap.lock_feet() == {"FINISHED"}
    assert scene.tricap.foot_lock and "Foot Lock.L" in blender.data.objects
    assert np.ptp(ankles(blender, body), axis=0).max() < 5e-4
    scene.tricap.foot_lock = False
    np.testing.assert_allclose(ankles(blender, body), before, atol=1e-5)
    scene.tricap.foot_lock = True
    assert blender.ops.tricap.lock_feet() == {"FINISHED"}  # again: nothing piles up
    assert len([o for o in blender.data.objects if o.name.startswith("Foot Lock")]) == 2
    assert blender.ops.tricap.remove_foot_lock() == {"FINISHED"}
    np.testing.assert_allclose(ankles(blender, body), before, atol=1e-5)
    assert not [o for o in blender.data.objects if o.type == "EMPTY"]
    with pytest.raises(RuntimeError, match="are not locked"):
        blender.ops.tricap.remove_foot_lock()


def test_the_pelvis_is_lowered_where_a_straight_leg_would_not_reach(blender: ModuleType) -> None:
    from tricap.addon.editing.foot_lock import smoothly_above

    body = walker(blender, sliding_m=0.03, bent=0.0)
    pelvis = body.pose.bones["pelvis"]
    before, heights = ankles(blender, body), []
    for frame in range(FRAMES):
        blender.context.scene.frame_set(frame)
        heights.append((body.matrix_world @ pelvis.head).z)
    assert blender.ops.tricap.lock_feet() == {"FINISHED"}
    assert np.ptp(ankles(blender, body), axis=0).max() < 5e-4
    lowered = []
    for frame in range(FRAMES):
        blender.context.scene.frame_set(frame)
        lowered.append(heights[frame] - (body.matrix_world @ pelvis.head).z)
    assert 2e-3 < max(lowered) < 0.01 and np.abs(np.diff(lowered)).max() < 1e-3
    assert blender.ops.tricap.remove_foot_lock() == {"FINISHED"}
    np.testing.assert_allclose(ankles(blender, body), before, atol=1e-5)
    peaks = np.array([0, 0, 0, 3.0, 0, 0, 1, 0, 0, 0])
    assert (smoothly_above(peaks, 2) >= peaks).all() and np.abs(np.diff(smoothly_above(peaks, 2))).max() < 1


def test_the_influence_is_blended_and_the_place_changes_where_it_is_zero() -> None:
    from tricap.addon.editing.foot_lock import _blended

    begins, influence = _blended([(0, 5), (8, 12), (30, 40)], 40, 4)
    assert begins == [0, 6, 26] and influence[0] == influence[4] == influence[8] == influence[11] == influence[39] == 1.0
    assert influence[6] == influence[15] == influence[26] == 0.0


def test_the_strips_show_how_well_trunk_and_limbs_are_known(blender: ModuleType) -> None:
    from tricap.addon.editing import uncertainty

    body = walker(blender)
    sigmas = uncertainty.sigmas_of(body)
    strips = uncertainty.strips(body, sigmas, set(), 5)
    assert set(strips) == {"Trunk", "Arm right", "Arm left", "Leg right", "Leg left"}
    worst = {name: uncertainty.of_frames(sigmas, bones)[1] for name, bones in strips.items()}
    np.testing.assert_allclose(worst.pop("Arm right")[[0, NOISY.start]], [1e3 * KNOWN_M, 1e3 * LOST_M], rtol=1e-5)
    assert all(np.allclose(sigma, 1e3 * KNOWN_M) for sigma in worst.values()), "a lost arm is the arm's alone"
    assert uncertainty.strips(body, sigmas, {"forearm.R", "root"}, 1) == {"Selected bones": ["forearm.R"]}
    ((name, every),) = uncertainty.strips(body, sigmas, set(), 4).items()
    assert name == "Least known" and set(every) == set(sigmas), "in a low timeline there is room for one strip only"
    assert uncertainty.name_x(60.0, 36.0, 4.0) == 40.0, "right of the playhead that would cross it"
    assert uncertainty.name_x(60.0, 300.0, 4.0) == uncertainty.name_x(60.0, -9.0, 4.0) == 4.0
    frames, sigma = uncertainty.of_frames(sigmas, {"forearm.R"})
    assert list(frames) == list(range(FRAMES)) and sigma[NOISY.start] == pytest.approx(1e3 * LOST_M)
    blue, red = uncertainty.colour_of(np.array([0.5, 80.0]))[:, :3]
    assert blue.argmax() == 2 and red.argmax() == 0
    assert len(uncertainty.of_frames({}, set())[0]) == 0 and uncertainty.strips(body, {}, set(), 5) == {}


def test_sigmas_of_bones_are_those_of_their_joints(blender: ModuleType) -> None:
    from tricap.addon.scene import action
    from tricap.core.motion.tables import JointTable

    shape = default_shape(read_model("arm.R"))
    own = {"shoulder.R": np.array([1e-3, 2e-3]), "elbow.R": np.array([4e-3, 1e-3]), "wrist.R": np.array([np.nan, np.nan])}
    whole = {name: np.array([9e-3, 9e-3]) for name in own}
    table = JointTable(
        frames=np.array([3, 4]),
        time_s=np.zeros(2),
        joints_m={name: np.zeros((2, 3)) for name in own},
        sigma_m=whole,
        frame_sigma_m=own,
        known={name: ("seen", "seen") for name in own},
    )
    found = action.place_sigmas(shape, table, np.array([4, 3, 8]))
    np.testing.assert_allclose(found["upper_arm.R"], [2e-3, 4e-3, np.nan])
    np.testing.assert_allclose(found["forearm.R"], [9e-3, 9e-3, np.nan], err_msg="a table of an earlier version has the whole sigma only")


def test_what_cannot_be_edited(blender: ModuleType) -> None:
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    with pytest.raises(RuntimeError, match="no fitted body"):
        blender.ops.tricap.reduce_keys()
    body = walker(blender)
    body.animation_data.action = None
    with pytest.raises(RuntimeError, match="has no action to edit"):
        blender.ops.tricap.smooth_uncertain()


def test_doubtful_stretches_are_marked_once(blender: ModuleType) -> None:
    from tricap.addon.scene.build import mark_doubtful

    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    scene = blender.context.scene
    scene.timeline_markers.new("Jump", frame=3)
    mark_doubtful(scene, [(2, 2, "few points"), (5, 9, "joints uncertain")])
    mark_doubtful(scene, [(5, 9, "joints uncertain")])
    assert {(m.name, m.frame) for m in scene.timeline_markers} == {("Jump", 3), ("Doubtful 5–9: joints uncertain", 5)}
