"""What a pose explains of points and silhouettes, and the ways of limbs through frames in which nothing else holds them."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.body.skin.contour_skin import body_skin
from tricap.core.fitting.explained import explained_area, limb_gains, misplaced
from tricap.core.fitting.inputs.background import UNIT_PX
from tricap.core.fitting.inputs.cloud_points import CloudPoints
from tricap.core.fitting.inputs.fit_input import BackgroundDistances, FitInput, Packed
from tricap.core.fitting.limb import Limb, halton, whole_limbs
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.solve.problem import Scales
from tricap.core.fitting.solve.solver import Solution
from tricap.core.fitting.stages.contradicted import ANYWHERE_M, CONTRADICTED, widened
from tricap.core.fitting.stages.hidden_limbs import reacquired_poses
from tricap.core.fitting.stages.limb_modes import elsewhere, of_joints
from tricap.core.fitting.stages.limb_paths import (
    LARGEST_JUMP,
    _begin,
    _better,
    _courses,
    _even,
    _meeting,
    _points_of_bones,
    _stretches,
    _unevenness,
    follow_limbs,
)
from tricap.core.fitting.stages.pose_tracking import PoseTracking
from tricap.core.fitting.stages.sequence import fit_context
from tricap.core.fitting.state import free_bones
from tricap.core.foundation.progress import Monitor

from .limb_scene import front_rig, measured_cloud, person_seen

STEP_PX, FRAMES = 4, 5
SHAPE = default_shape(read_model("full"))
NAMES = [bone.name for bone in SHAPE.skeleton.bones]
BEFORE = np.zeros(len(SHAPE.skeleton.dof_names))


def _raised(degrees: float) -> np.ndarray:
    """The right arm lifted to the side by so many degrees."""
    motion = BEFORE.copy()
    motion[SHAPE.skeleton.layout["shoulder.R abduction"]] = np.radians(-degrees)
    return motion


POSES = np.array([_raised(10.0 * t) for t in range(FRAMES)])
NOTHING = CloudPoints(frame=0, xyz_m=np.zeros((0, 3)), normals=np.zeros((0, 3)), sigma_m=np.zeros(0))


def _regions(rig) -> list[BackgroundDistances]:
    """The person in the views, in all frames."""
    found = []
    for camera in rig.cameras:
        images = []
        for pose in POSES:
            person = person_seen(camera, SHAPE, pose)[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX]
            far = cv2.distanceTransform((~person).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
            images.append(np.minimum(far * STEP_PX / UNIT_PX, 255))
        found.append(
            BackgroundDistances(view=camera.name, frame=np.arange(FRAMES), distance=Packed(images), step_px=STEP_PX, unit_px=UNIT_PX)
        )
    return found


@pytest.fixture(scope="module")
def fit():
    rig = front_rig()
    return fit_context(_given(FRAMES, _regions(rig)), FitSettings())


def _given(frames: int, background: list[BackgroundDistances]) -> FitInput:
    rig, rng = front_rig(), np.random.default_rng(0)
    joints = joint_positions(SHAPE.skeleton, SHAPE.lengths_m, BEFORE)
    clicks = {name: {c.name: c.project(at) for c in rig.cameras} for name, at in joints.items()}
    clouds = [measured_cloud(SHAPE, BEFORE, t, rng, points=200, noise=0.001, gross=0.0) for t in range(frames)]
    return FitInput(rig=rig, model="full", clouds=clouds, time_s=np.arange(frames) / 30, clicks={0: clicks}, background=background)


def _arm(fit) -> Limb:
    return next(limb for limb in whole_limbs(fit.parameters) if NAMES[limb.bones[0]] == "upper_arm.R")


def _vector(fit) -> np.ndarray:
    return fit.parameters.vector(SHAPE)


@pytest.mark.slow
def test_the_whole_limbs_are_arms_and_legs(fit) -> None:
    limbs, arm = whole_limbs(fit.parameters), _arm(fit)
    assert {NAMES[limb.bones[0]] for limb in limbs} == {"upper_arm.R", "upper_arm.L", "thigh.R", "thigh.L"}
    assert {NAMES[b] for b in arm.outer} == {"upper_arm.R", "forearm.R", "hand.R"}
    dofs = {SHAPE.skeleton.dof_names[c] for c in arm.columns}
    moved = {"shoulder.R": ("flexion", "abduction", "twist"), "elbow.R": ("flexion", "twist"), "wrist.R": ("flexion", "deviation")}
    assert dofs == {f"{joint} {name}" for joint, names in moved.items() for name in names}


@pytest.mark.slow
def test_an_arm_gains_most_where_the_silhouettes_show_it(fit) -> None:
    limb, vector = _arm(fit), _vector(fit)
    evidence, state = fit.seen(4, NOTHING), fit.parameters.state(POSES[4], vector)
    near = evidence.near(limb, state)
    gains = limb_gains(near, limb, np.array([_raised(degrees) for degrees in (0.0, 20.0, 40.0, 60.0)]), vector, 0.02)
    assert np.argmax(gains) == 2 and gains[2] > 0.4 * near.unexplained(limb.head_m(POSES[4], vector)) > 100
    assert gains[0] < 0 and gains[3] < 0  # in the background
    assert misplaced(evidence, limb, state) < 1.0
    assert misplaced(evidence, limb, fit.parameters.state(_raised(60.0), vector)) > CONTRADICTED
    assert sum(len(view.xy_px) for view in near.cells) < 0.5 * sum(len(view.xy_px) for view in evidence.cells)


@pytest.mark.slow
def test_an_arm_explains_the_fingers_of_its_hand_or_a_fist(fit) -> None:
    limb, vector = _arm(fit), _vector(fit)
    state = fit.parameters.state(BEFORE, vector)
    near = fit.seen(0, NOTHING).near(limb, state)
    wrist, knuckles = (state.joints_m[SHAPE.skeleton.joint_names.index(name)] for name in ("wrist.R", "knuckles.R"))
    beyond = []
    for view in near.cells:
        first, end = view.camera.project(np.stack([knuckles + 0.2 * (knuckles - wrist), 2 * knuckles - wrist]))
        beyond.append((view.xy_px - first) @ (end - first) > 0)
    cells, taken = zip(*((view.take(~out), share[~out]) for view, share, out in zip(near.cells, near.taken_cells, beyond)))
    fist = replace(near, cells=cells, taken_cells=taken)
    fingers = near.unexplained(wrist) - fist.unexplained(wrist)
    open_hand, closed = (limb_gains(seen, limb, BEFORE[None], vector, 0.01)[0] for seen in (near, fist))
    assert open_hand - closed > 0.5 * fingers > 5 and closed > 0.5 * fist.unexplained(wrist)


@pytest.mark.slow
def test_gains_above_the_least_are_exact_and_the_others_are_not_above_it(fit) -> None:
    limb, vector = _arm(fit), _vector(fit)
    near = fit.seen(4, NOTHING).near(limb, fit.parameters.state(POSES[4], vector))
    poses = limb.poses(POSES[4], limb.samples(POSES[4][limb.columns], 200, np.pi))
    exact = limb_gains(near, limb, poses, vector, 0.03)
    for least in np.quantile(exact, [0.5, 0.95]):
        bound = limb_gains(near, limb, poses, vector, 0.03, float(least))
        above = exact > least
        assert above.any() and not above.all()
        np.testing.assert_allclose(bound[above], exact[above], atol=1e-3)
        assert (bound[~above] <= least + 1e-3).all() and (bound > exact - 1e-3).all()


def test_rims_of_the_rest_of_the_body_are_no_limb(fit) -> None:
    """Cells of which the body explains all but a little are not the arm's, wherever it lies; all of them together would be."""
    limb, vector, pose = _arm(fit), _vector(fit), POSES[4:5]
    near = fit.seen(4, NOTHING).near(limb, fit.parameters.state(pose[0], vector))
    rims = replace(near, taken_cells=[np.full(len(view.xy_px), 0.85) for view in near.cells])
    state = fit.parameters.state(pose[0], vector)
    assert limb_gains(rims, limb, pose, vector, 0.02)[0] == -misplaced(rims, limb, state)
    half = replace(near, taken_cells=[np.full(len(view.xy_px), 0.5) for view in near.cells])
    assert limb_gains(half, limb, pose, vector, 0.02)[0] > 20


def test_a_limb_that_leaps_and_returns_costs_more_than_one_that_swings(fit) -> None:
    time_s, swing = np.arange(6) / 30, np.zeros((6, 2, 3))
    swing[:, 1, 0] = 0.02 * np.arange(6)
    leap = swing.copy()
    leap[3] += 0.5
    assert _unevenness(_arm(fit), swing, time_s) < 1.0
    assert _unevenness(_arm(fit), leap, time_s) == pytest.approx(2 * LARGEST_JUMP, abs=1.0)  # there and back


def test_a_limb_that_ends_beside_a_camera_is_not_seen_there(fit) -> None:
    """Its image is far beyond all numbers of pixels, and none overflows."""
    limb, vector, poses = _arm(fit), _vector(fit), POSES[-1:]
    state = fit.parameters.state(POSES[-1], vector)
    near, hand = fit.seen(4, NOTHING).near(limb, state), state.head_m[limb.outer[-1]]
    first, middle, last = near.cells
    t_m = np.array([0.0, 0.0, 2e-6 - hand[2]])
    beside = replace(middle.camera, R_cam_world=np.eye(3), t_cam_world_m=t_m, distortions=[0.1, 0.1, 0.0, 0.0, 0.1])
    flat = replace(near, cells=(first, replace(middle, camera=beside), last))
    with np.errstate(over="raise", invalid="raise"):
        gain = limb_gains(flat, limb, poses, vector, 0.02)
    assert np.isfinite(gain).all()


def test_what_a_body_explains_falls_when_a_limb_leaves_the_silhouettes(fit) -> None:
    vector, posed = _vector(fit), free_bones(fit.parameters)
    seen = fit.seen(0, NOTHING)
    area = [explained_area(seen, fit.parameters.state(_raised(d), vector), posed, 0.015) for d in (0.0, 15.0, 45.0)]
    assert area[0] > area[1] + 50 > area[2] + 100


def test_an_arm_inside_the_trunk_or_before_points_behind_it_is_misplaced(fit) -> None:
    vector, limb = _vector(fit), _arm(fit)
    inside = fit.parameters.state(_raised(-55.0), vector)  # through the trunk
    assert misplaced(fit.seen(0, NOTHING), limb, inside) > CONTRADICTED
    ahead = BEFORE.copy()
    ahead[SHAPE.skeleton.layout["shoulder.R flexion"]] = np.radians(35.0)
    state = fit.parameters.state(ahead, vector)
    along = np.linspace(0.1, 0.9, 40)[:, None]
    places = np.concatenate([state.head_m[b] + along * state.lengths_m[b] * state.R[b][:, 1] for b in limb.outer])
    centre = fit.seen(0, NOTHING).cells[1].camera.centre_m
    wall = centre + (places - centre) * 1.1  # the middle view sees it through the arm
    points = CloudPoints(frame=0, xyz_m=wall, normals=np.tile([0.0, -1.0, 0.0], (len(wall), 1)), sigma_m=np.full(len(wall), 0.001))
    own = replace(points, xyz_m=places)
    seen = [misplaced(fit.seen(0, points), limb, state) for points in (points, own)]
    assert seen[0] > seen[1] + CONTRADICTED


def test_an_arm_without_points_is_found_by_its_silhouettes(fit) -> None:
    found = reacquired_poses(fit, 4, NOTHING, BEFORE, _vector(fit))
    true, was, now = (joint_positions(SHAPE.skeleton, SHAPE.lengths_m, m)["wrist.R"] for m in (POSES[4], BEFORE, found[-1]))
    assert np.linalg.norm(was - true) > 0.3 and np.linalg.norm((now - true)[[0, 2]]) < 0.10  # across the view


def test_a_limb_that_tracking_lost_is_followed_through_the_frames(fit) -> None:
    """The motion to be improved leaves the arm where it was clicked; it was lifted, without a measured point."""
    first = Solution(motion=BEFORE[None], vector=_vector(fit), cost=1.0, scales=Scales(), iterations=1, converged=True)
    tracking = PoseTracking(fit=fit, points=[NOTHING] * FRAMES, time_s=np.arange(FRAMES) / 30, first=first, tracks=None)
    lost = np.tile(BEFORE, (FRAMES, 1))
    motion = follow_limbs(tracking, lost, Monitor())
    true, now = (joint_positions(SHAPE.skeleton, SHAPE.lengths_m, m)["elbow.R"] for m in (POSES, motion))
    assert np.linalg.norm((now - true)[:, [0, 2]], axis=1).max() < 0.05 < np.linalg.norm((now[0] - true[-1])[[0, 2]])
    assert np.array_equal(follow_limbs(tracking, lost, Monitor()), motion)  # nothing is random


def test_an_arm_that_is_not_certain_at_the_start_is_found_by_the_other_frames(fit) -> None:
    first = Solution(motion=POSES[-1][None], vector=_vector(fit), cost=1.0, scales=Scales(), iterations=1, converged=True)
    unsure = replace(fit, clicked={}, unsure=("elbow.R", "wrist.R"))
    raised = np.tile(POSES[-1], (FRAMES, 1))  # in the first frame, too, where it hangs

    def off(context) -> float:
        tracking = PoseTracking(fit=context, points=[NOTHING] * FRAMES, time_s=np.arange(FRAMES) / 30, first=first, tracks=None)
        motion = follow_limbs(tracking, raised, Monitor())
        true, now = (joint_positions(SHAPE.skeleton, SHAPE.lengths_m, m)["elbow.R"] for m in (POSES[:1], motion[:1]))
        return float(np.linalg.norm((now - true)[0, [0, 2]]))

    assert off(unsure) < 0.05 < 0.15 < off(fit)
    (arm,) = [limb for limb in whole_limbs(fit.parameters) if _begin(unsure, limb) is None]
    assert _begin(fit, arm) == fit.click
    clicks = SimpleNamespace(joint=np.array([SHAPE.skeleton.joint_names.index("wrist.R")]))
    assert _begin(replace(unsure, clicked={3: clicks}), arm) == 3 and _courses(3, 5) == [[3, 4], [3, 2, 1, 0]]


def test_a_limb_without_points_goes_evenly_from_where_it_was_seen_to_where_it_is_seen_next() -> None:
    bare, time_s = fit_context(_given(FRAMES, []), FitSettings()), np.arange(FRAMES) / 30
    first = Solution(motion=BEFORE[None], vector=_vector(bare), cost=1.0, scales=Scales(), iterations=1, converged=True)
    skins = [body_skin(SHAPE, POSES[t]).vertices_m for t in (0, -1)]
    ends = [CloudPoints(frame=0, xyz_m=X, normals=np.zeros_like(X), sigma_m=np.full(len(X), 1e-3)) for X in skins]
    points = [ends[0], *[NOTHING] * (FRAMES - 2), ends[1]]
    tracking = PoseTracking(fit=bare, points=points, time_s=time_s, first=first, tracks=None)
    (arm,) = [limb for limb in whole_limbs(bare.parameters) if NAMES[limb.bones[0]] == "upper_arm.R"]
    astray = np.array([POSES[0], *[_raised(130.0)] * (FRAMES - 2), POSES[-1]])
    seen = _points_of_bones(tracking, astray)[:, arm.bones].sum(axis=1) >= bare.settings.min_points
    assert seen.tolist() == [True, False, False, False, True] and _stretches(seen) == [range(FRAMES)]
    assert _stretches(np.array([False, True, True, False, True, False])) == [
        range(2, 5)
    ]  # nothing is known before the first and after the last
    way = _even(tracking, astray, arm, range(FRAMES))
    assert [t for t, _, _ in way] == [1, 2, 3]
    even = astray.copy()
    for t, angles, _ in way:
        even[t, arm.columns] = angles
    assert np.allclose(even[:, arm.columns], POSES[:, arm.columns])
    assert _better(tracking, astray, arm, way, anchored=True).keys() == {1, 2, 3}
    assert not _better(tracking, even, arm, way, anchored=True)  # what is as even stays
    meeting = _meeting(tracking, astray, arm, range(FRAMES), Monitor())  # half of it from each end
    assert sorted(t for t, _, _ in meeting) == [1, 2, 3] and _better(tracking, astray, arm, meeting, anchored=True)
    assert not _better(tracking, even, arm, meeting, anchored=True)


def test_nothing_is_followed_where_no_background_is_known(fit) -> None:
    bare = fit_context(_given(1, []), FitSettings())
    first = Solution(motion=BEFORE[None], vector=_vector(fit), cost=1.0, scales=Scales(), iterations=1, converged=True)
    tracking = PoseTracking(fit=bare, points=[NOTHING], time_s=np.zeros(1), first=first, tracks=None)
    assert np.array_equal(follow_limbs(tracking, BEFORE[None], Monitor()), BEFORE[None])


def test_a_contradicted_limb_is_not_certain(fit) -> None:
    limbs, D, J = whole_limbs(fit.parameters), len(SHAPE.skeleton.dofs), len(SHAPE.skeleton.joint_names)
    covariance, sigma = np.eye(D) * 1e-4, np.full(J, 0.01)
    area = np.array([2 * CONTRADICTED if NAMES[limb.bones[0]] == "upper_arm.R" else 0.0 for limb in limbs])
    widened(fit.parameters, area, covariance, sigma)
    of = dict(zip(SHAPE.skeleton.joint_names, sigma))
    assert of["elbow.R"] == of["wrist.R"] == ANYWHERE_M and of["elbow.L"] == of["shoulder.R"] == 0.01
    assert np.linalg.eigvalsh(covariance).min() > 0
    layout = SHAPE.skeleton.layout
    assert np.sqrt(covariance[layout["elbow.R flexion"]] * 1.0).max() > 0.5 > np.sqrt(covariance[layout["elbow.L flexion"]]).max()


def test_a_limb_that_explains_less_than_it_could_may_be_elsewhere(fit) -> None:
    """Where the silhouettes show the arm it has no other place of any weight; left where it was, it has; unseen, it may be anywhere."""
    bare, vector, time_s = fit_context(_given(FRAMES, []), FitSettings()), _vector(fit), np.arange(FRAMES) / 30
    sigmas = []
    for context, motion in ((fit, POSES), (fit, np.tile(BEFORE, (FRAMES, 1))), (bare, POSES)):
        at = Solution(motion=motion, vector=vector, cost=1.0, scales=Scales(), iterations=1, converged=True)
        found = elsewhere(context, [NOTHING] * FRAMES, at, time_s, range(3, FRAMES), whole_limbs(fit.parameters))
        variance = of_joints(found, SHAPE.skeleton, FRAMES - 3)
        sigmas.append(dict(zip(SHAPE.skeleton.joint_names, np.sqrt(variance[-1]))))
        assert all(np.linalg.eigvalsh(one.covariance).min() > -1e-12 for one in found)
    right, left_behind, unseen = sigmas
    assert right["wrist.R"] < 0.13  # 0.111 across the depth, which three outlines leave open
    assert left_behind["wrist.R"] > 1.5 * right["wrist.R"] and unseen["wrist.R"] > 1.5 * right["wrist.R"]
    assert right["pelvis"] == right["shoulder.R"] == 0.0 and right["elbow.R"] <= right["wrist.R"] + 0.01


@pytest.mark.parametrize(("dimensions", "count"), [(1, 1), (3, 800), (60, 40)])
def test_points_of_a_cube_are_those_of_halton(dimensions: int, count: int) -> None:
    from scipy.stats import qmc

    assert np.array_equal(halton(dimensions, count), qmc.Halton(dimensions, scramble=False).random(count))
