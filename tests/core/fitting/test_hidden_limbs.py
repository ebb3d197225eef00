"""An arm that is not where it was predicted is found among the points that nothing else explains."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.fitting.inputs.cloud_points import CloudPoints
from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.segmentation import crop, segment
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.solve.problem import Scales
from tricap.core.fitting.solve.solver import Solution
from tricap.core.fitting.stages.click_frame import _with_lost_limbs
from tricap.core.fitting.stages.hidden_limbs import lost_limbs, reacquired_poses
from tricap.core.fitting.stages.pose_tracking import REACH_M, _reach
from tricap.core.fitting.stages.sequence import fit_context
from tricap.core.foundation.progress import Monitor

from .limb_scene import front_rig, measured_cloud, surface

WRIST, HAND = "wrist.R", ("wrist.R flexion", "wrist.R deviation")


def points_of(shape, motion: np.ndarray, bones: dict[str, int]) -> CloudPoints:
    """Points on the fronts of some bones, so many on each."""
    rng, names = np.random.default_rng(5), [bone.name for bone in shape.skeleton.bones]
    bone = np.repeat([names.index(name) for name in bones], list(bones.values()))
    along, angle = rng.uniform(0.15, 0.9, len(bone)), rng.uniform(0, 2 * np.pi, len(bone))
    xyz, normals = surface(shape, motion, along, angle, bone)
    front = normals[:, 1] < 0
    return CloudPoints(frame=0, xyz_m=xyz[front], normals=normals[front], sigma_m=np.full(front.sum(), 0.001))


@pytest.fixture(scope="module")
def standing():
    shape = default_shape(read_model("full"))
    before = np.zeros(len(shape.skeleton.dof_names))
    rig = front_rig()
    joints = joint_positions(shape.skeleton, shape.lengths_m, before)
    clicks = {name: {c.name: c.project(at) for c in rig.cameras} for name, at in joints.items()}
    clouds = [measured_cloud(shape, before, 0, np.random.default_rng(0), points=200, noise=0.001, gross=0.0)]
    given = FitInput(rig=rig, model="full", clouds=clouds, time_s=np.zeros(1), clicks={0: clicks})
    return fit_context(given, FitSettings()), shape, before


def test_a_raised_arm_is_found(standing) -> None:
    fit, shape, before = standing
    layout, raised = shape.skeleton.layout, before.copy()
    for name, degrees in (("shoulder.R flexion", 70.0), ("elbow.R flexion", 60.0)):
        raised[layout[name]] = np.radians(degrees)
    others = {"chest": 200, "spine": 100, "upper_arm.L": 60, "forearm.L": 60, "thigh.L": 60, "shin.L": 60, "thigh.R": 60, "shin.R": 60}
    vector = fit.parameters.vector(shape)
    (found,) = reacquired_poses(fit, 0, points_of(shape, raised, others | {"upper_arm.R": 80, "forearm.R": 80}), before, vector)
    true, was, now = (joint_positions(shape.skeleton, shape.lengths_m, m)[WRIST] for m in (raised, before, found))
    assert np.linalg.norm(was - true) > 0.3 and np.linalg.norm(now - true) < 0.08
    moved = np.flatnonzero(np.abs(found - before) > 1e-9)
    assert {shape.skeleton.dof_names[i].partition(" ")[0] for i in moved} <= {"shoulder.R", "elbow.R", "wrist.R"}
    assert not reacquired_poses(fit, 0, points_of(shape, raised, others), before, vector)  # hidden: nothing is invented
    unsought = replace(fit, settings=replace(fit.settings, search_limbs=False))
    seen = points_of(shape, raised, others | {"upper_arm.R": 80, "forearm.R": 80})
    assert not reacquired_poses(unsought, 0, seen, before, vector)  # as published


def test_a_forearm_is_found_whose_upper_arm_was_never_lost(standing) -> None:
    fit, shape, before = standing
    layout, bent = shape.skeleton.layout, before.copy()
    for name, degrees in (("shoulder.R twist", 40.0), ("elbow.R flexion", 95.0)):
        bent[layout[name]] = np.radians(degrees)
    seen = {
        "chest": 200,
        "spine": 100,
        "upper_arm.R": 80,
        "upper_arm.L": 60,
        "forearm.L": 60,
        "thigh.L": 60,
        "shin.L": 60,
        "thigh.R": 60,
        "shin.R": 60,
    }
    vector = fit.parameters.vector(shape)
    (found,) = reacquired_poses(fit, 0, points_of(shape, bent, seen | {"forearm.R": 80}), before, vector)
    true, was, now = (joint_positions(shape.skeleton, shape.lengths_m, m)[WRIST] for m in (bent, before, found))
    assert np.linalg.norm(was - true) > 0.3 and np.linalg.norm(now - true) < 0.08
    moved = np.flatnonzero(np.abs(found - before) > 1e-9)
    assert {shape.skeleton.dof_names[i] for i in moved} <= {"shoulder.R twist", "elbow.R flexion", "elbow.R twist", *HAND}
    assert not reacquired_poses(fit, 0, points_of(shape, bent, seen), before, vector)


def test_a_shin_that_has_somebody_elses_points_is_found_where_its_own_are(standing) -> None:
    fit, shape, straight = standing
    folded = straight.copy()
    folded[shape.skeleton.layout["knee.L flexion"]] = np.radians(60.0)
    seen = {
        "chest": 200,
        "spine": 100,
        "thigh.L": 200,
        "thigh.R": 60,
        "shin.R": 60,
        "foot.R": 40,
        "upper_arm.R": 60,
        "forearm.R": 60,
        "upper_arm.L": 60,
        "forearm.L": 60,
    }
    vector, other = fit.parameters.vector(shape), points_of(shape, folded, {"shin.L": 60})

    def with_other(points: CloudPoints) -> CloudPoints:
        return replace(points, **{n: np.concatenate([getattr(points, n), getattr(other, n)]) for n in ("xyz_m", "normals", "sigma_m")})

    both = with_other(points_of(shape, straight, seen | {"shin.L": 120}))
    owners = segment(both, fit.parameters.state(folded, vector), fit.model.surface, fit.settings.gate_m)[1]
    names = [bone.name for bone in shape.skeleton.bones]
    counts = np.bincount(owners, minlength=len(names))
    assert not any(names.index("shin.L") in limb.bones for limb in lost_limbs(fit, counts))  # it has points
    found = reacquired_poses(fit, 0, both, folded, vector)
    true, was, now = (joint_positions(shape.skeleton, shape.lengths_m, m)["ankle.L"] for m in (straight, folded, found[-1]))
    assert np.linalg.norm(was - true) > 0.4 and np.linalg.norm(now - true) < 0.08
    assert not reacquired_poses(fit, 0, with_other(points_of(shape, straight, seen)), folded, vector)  # nothing shows that it is elsewhere


def test_points_take_part_as_far_as_a_limb_may_have_swung(standing) -> None:
    fit, shape, before = standing
    bent = before.copy()
    bent[shape.skeleton.layout["elbow.R flexion"]] = np.radians(120.0)
    points = points_of(shape, bent, {"forearm.R": 80, "hand.R": 40})
    state = fit.parameters.state(before, fit.parameters.vector(shape))
    far = points.xyz_m + [0.0, -1.5, 0.0]  # of somebody else
    assert len(crop(points, state, _reach(fit, state)).xyz_m) == len(points.xyz_m) > len(crop(points, state, REACH_M).xyz_m)
    assert not len(crop(replace(points, xyz_m=far), state, _reach(fit, state)).xyz_m)


def test_the_foot_of_one_who_squats_is_found_flat_on_the_floor(standing) -> None:
    fit, shape, _ = standing
    layout, before = shape.skeleton.layout, np.zeros(len(shape.skeleton.dof_names))
    for name, degrees in (("hip.R flexion", 75.0), ("knee.R flexion", 115.0)):
        before[layout[name]] = np.radians(degrees)
    squatting = before.copy()
    squatting[layout["ankle.R flexion"]] = np.radians(-40.0)  # the shin leans forwards by as much
    seen = {
        "chest": 200,
        "spine": 100,
        "thigh.R": 60,
        "shin.R": 60,
        "thigh.L": 60,
        "shin.L": 60,
        "foot.L": 40,
        "upper_arm.R": 60,
        "forearm.R": 60,
        "upper_arm.L": 60,
        "forearm.L": 60,
    }
    (found,) = reacquired_poses(fit, 0, points_of(shape, squatting, seen | {"foot.R": 80}), before, fit.parameters.vector(shape))
    true, was, now = (joint_positions(shape.skeleton, shape.lengths_m, m)["toe.R"] for m in (squatting, before, found))
    assert np.linalg.norm(was - true) > 0.09 and np.linalg.norm(now - true) < 0.03


def test_a_hand_is_found_where_the_wrist_is_bent(standing) -> None:
    fit, shape, straight = standing
    bent = straight.copy()
    bent[shape.skeleton.layout["wrist.R flexion"]] = np.radians(-65.0)
    body = ("chest", "spine", "thigh.R", "shin.R", "thigh.L", "shin.L", "upper_arm.R", "forearm.R", "upper_arm.L", "forearm.L")
    points = points_of(shape, bent, dict.fromkeys(body, 60) | {"hand.R": 80})
    (found,) = reacquired_poses(fit, 0, points, straight, fit.parameters.vector(shape))
    true, was, now = (joint_positions(shape.skeleton, shape.lengths_m, m)["knuckles.R"] for m in (bent, straight, found))
    assert np.linalg.norm(was - true) > 0.08 and np.linalg.norm(now - true) < 0.03
    assert not reacquired_poses(fit, 0, points, bent, fit.parameters.vector(shape))


def test_at_the_click_frame_a_forearm_bent_the_wrong_way_is_found(standing) -> None:
    fit, shape, before = standing
    layout, bent = shape.skeleton.layout, before.copy()
    for name, degrees in (("shoulder.R twist", 40.0), ("elbow.R flexion", 95.0)):
        bent[layout[name]] = np.radians(degrees)
    elsewhere = [i for i, c in enumerate(fit.clicked[0].joint) if shape.skeleton.joint_names[c] not in (WRIST, "knuckles.R")]
    clicks = replace(
        fit.clicked[0],
        cameras=tuple(fit.clicked[0].cameras[i] for i in elsewhere),
        joint=fit.clicked[0].joint[elsewhere],
        xy_px=fit.clicked[0].xy_px[elsewhere],
    )
    fit, points = replace(fit, clicked={0: clicks}), points_of(shape, bent, {"chest": 100, "upper_arm.R": 80, "forearm.R": 80})
    wrong = Solution(motion=before[None], vector=fit.parameters.vector(shape), cost=1.0, scales=Scales(), iterations=1, converged=True)
    support = fit.support(0, points, before, wrong.vector)
    found = _with_lost_limbs(fit, points, wrong, support, Monitor())
    true, now = (joint_positions(shape.skeleton, shape.lengths_m, m)[WRIST] for m in (bent, found.motion[0]))
    assert np.linalg.norm(now - true) < 0.05 and fit.support(0, points, found.motion[0], found.vector) > support + 25
    assert _with_lost_limbs(fit, points, found, support + 1000, Monitor()) is found
