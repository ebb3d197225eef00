"""Hands that are turned as their points and outlines show them, in frames in which the fitted flat hand was turned over."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.fitting.explained import Evidence
from tricap.core.fitting.hands import hand_capsules, is_hand, thumb_side
from tricap.core.fitting.inputs.background import UNIT_PX
from tricap.core.fitting.inputs.cloud_points import CloudPoints
from tricap.core.fitting.inputs.fit_input import BackgroundDistances, FitInput, Packed
from tricap.core.fitting.limb import Limb, limbs_of, whole_limbs
from tricap.core.fitting.observations import HandPoints, PosePrior
from tricap.core.fitting.segmentation import SegmentationCache, surface_points
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.solve.problem import Estimate, Scales
from tricap.core.fitting.solve.solver import Solution
from tricap.core.fitting.stages import turned_hands, unseen_hands
from tricap.core.fitting.stages.limb_modes import Elsewhere
from tricap.core.fitting.stages.pose_tracking import PoseTracking
from tricap.core.fitting.stages.sequence import fit_context
from tricap.core.fitting.stages.turned_hands import angles_of_hands, priors_at, turn_hands
from tricap.core.foundation.progress import Monitor

from .limb_scene import front_rig, hand_places, measured_cloud, person_seen, points_on_hand

STEP_PX, FRAMES = 4, 6
SHAPE = default_shape(read_model("full"))
LAYOUT = SHAPE.skeleton.layout
HAND, LEFT = ([bone.name for bone in SHAPE.skeleton.bones].index(name) for name in ("hand.R", "hand.L"))
ANGLES = [LAYOUT[name] for name in ("elbow.R twist", "wrist.R flexion", "wrist.R deviation")]
TRUE, OVER = np.radians([60.0, 40.0, -25.0]), np.radians([-60.0, -40.0, 0.0])  # turned over, a flat hand is about in the same place


def _pose(angles: np.ndarray, lifted: float = 60.0) -> np.ndarray:
    motion = np.zeros(len(SHAPE.skeleton.dof_names))
    motion[LAYOUT["shoulder.R abduction"]] = -np.radians(lifted)
    motion[ANGLES] = angles
    return motion


def _points(pose: np.ndarray) -> CloudPoints:
    """Points on the hand that the cameras see."""
    places, radii = hand_places(SHAPE, pose, "hand.R")
    turn = np.random.default_rng(1).normal(size=(3, *places.shape))
    normals = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    normals[..., 1] = -np.abs(normals[..., 1])
    xyz, normals = (places + radii[:, None] * normals).reshape(-1, 3), normals.reshape(-1, 3)
    return CloudPoints(frame=0, xyz_m=xyz, normals=normals, sigma_m=np.full(len(xyz), 1e-3))


def _regions(rig, pose: np.ndarray) -> list[BackgroundDistances]:
    found = []
    for camera in rig.cameras:
        person = person_seen(camera, SHAPE, pose)[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX]
        far = cv2.distanceTransform((~person).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        images = [np.minimum(far * STEP_PX / UNIT_PX, 255)] * FRAMES
        found.append(
            BackgroundDistances(view=camera.name, frame=np.arange(FRAMES), distance=Packed(images), step_px=STEP_PX, unit_px=UNIT_PX)
        )
    return found


@pytest.fixture(scope="module")
def tracking() -> PoseTracking:
    rig, true, rng = front_rig(), _pose(TRUE), np.random.default_rng(0)
    joints = joint_positions(SHAPE.skeleton, SHAPE.lengths_m, true)
    clicks = {name: {c.name: c.project(at) for c in rig.cameras} for name, at in joints.items()}
    clouds = [measured_cloud(SHAPE, true, t, rng, points=200, noise=0.001, gross=0.0) for t in range(FRAMES)]
    time_s = np.arange(FRAMES) / 30
    given = FitInput(rig=rig, model="full", clouds=clouds, time_s=time_s, clicks={0: clicks}, background=_regions(rig, true))
    fit = fit_context(given, FitSettings())
    vector = fit.parameters.vector(SHAPE)
    first = Solution(motion=true[None], vector=vector, cost=1.0, scales=Scales(), iterations=1, converged=True)
    return PoseTracking(fit=fit, points=[_points(true)] * FRAMES, time_s=time_s, first=first, tracks=None)


def _right(fit) -> Limb:
    return next(limb for limb in limbs_of(fit.parameters).values() if limb.hand == "R")


def test_a_hand_has_five_fingers_and_its_thumb_is_beside_the_palm() -> None:
    (right, radii), (left, _) = hand_capsules(False), hand_capsules(True)
    assert right.shape == (8, 2, 3) and radii.shape == (8, 2) and np.array_equal(left * [-1, 1, 1], right)
    tips = right[3:, 1]
    assert tips[:4, 1].min() > 1.4 and tips[4, 0] > tips[:4, 0].max() + 0.2  # the thumb is last
    assert thumb_side(False)[0] > 0 > thumb_side(True)[0]
    assert is_hand("hand.L") and not is_hand("hand") and not is_hand("forearm.L") and not is_hand("handle.R")


@pytest.mark.slow
def test_a_hand_that_was_turned_over_is_turned_back(tracking) -> None:
    over = np.tile(_pose(OVER), (FRAMES, 1))
    limb, vector = _right(tracking.fit), tracking.first.vector
    found = turn_hands(tracking, over, Monitor())
    true, was, now = (limb.ends(motion, vector) for motion in (_pose(TRUE)[None], over, found))
    assert np.linalg.norm(was - true, axis=-1).max() > 0.08 and np.linalg.norm(now - true, axis=-1).max() < 0.03
    others = np.setdiff1d(np.arange(over.shape[1]), limb.columns)
    assert np.array_equal(found[:, others], over[:, others])
    assert np.array_equal(found, turn_hands(tracking, over, Monitor()))  # nothing is random


def test_a_hand_that_is_right_or_not_seen_stays(tracking) -> None:
    right, over = (np.tile(_pose(angles), (FRAMES, 1)) for angles in (TRUE, OVER))
    assert np.array_equal(turn_hands(tracking, right, Monitor()), right)
    nothing = CloudPoints(frame=0, xyz_m=np.zeros((0, 3)), normals=np.zeros((0, 3)), sigma_m=np.zeros(0))
    bare = replace(tracking, fit=replace(tracking.fit, settings=replace(tracking.fit.settings, search_limbs=False)))
    in_views = replace(tracking, fit=replace(tracking.fit, in_views=SimpleNamespace()))
    unknown = replace(tracking, fit=fit_context(_given_without_background(), FitSettings()), points=[nothing] * FRAMES)
    for without in (bare, in_views, unknown):
        assert np.array_equal(turn_hands(without, over, Monitor()), over) and angles_of_hands(without.fit, over) is None


def test_a_little_more_is_no_reason(tracking, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hand on a thigh explains some of its points in any pose; a single frame counts with no more than `MOST`."""
    over, gains = np.tile(_pose(OVER), (FRAMES, 1)), np.array([500.0, 0, 15, 15, 15, 0])
    monkeypatch.setattr(turned_hands, "gain_by_way", lambda given, t, *rest: gains[t])
    limb, true = _right(tracking.fit), _pose(TRUE)[limb_columns(tracking)]
    way = [(t, true, limb.ends(_pose(TRUE)[None], tracking.first.vector)[0]) for t in range(1, FRAMES - 1)]
    assert turned_hands._better(tracking, over, limb, way) == {}
    gains[2:5] = 25.0
    assert turned_hands._better(tracking, over, limb, way).keys() == {1, 2, 3, 4}


def _added(tracking: PoseTracking, clicked, frames: int = FRAMES) -> Elsewhere:
    """What the right hand adds to the covariance of all frames but the first."""
    fit = replace(tracking.fit, clicked=clicked)
    arms = [limb for limb in whole_limbs(fit.parameters) if HAND in limb.outer]
    given = Estimate(motion=np.tile(_pose(TRUE), (frames, 1)), vector=tracking.first.vector)
    (found,) = unseen_hands.unseen_hands(fit, tracking.points[:1] * frames, given, np.arange(frames) / 30, range(1, frames), arms)
    return found


def test_a_hand_that_is_not_seen_is_uncertain_by_centimetres(tracking, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its wrist, that is: the forearm's twist is the arm's."""
    seen = _added(tracking, {})
    assert not seen.covariance.any() and not seen.variance_m2.any()
    nothing = Evidence.of(tracking.points[0].take(np.zeros(0, dtype=np.intp)), [], tracking.fit.settings.voxel_m)
    monkeypatch.setattr(type(tracking.fit), "seen", lambda *_: nothing)
    hand = _added(tracking, {})
    sigma_m, variance = np.sqrt(hand.variance_m2), np.diag(hand.covariance[0])
    assert hand.covariance.shape[0] == FRAMES - 1 and sigma_m.shape == (FRAMES - 1, 1)
    assert 0.04 < sigma_m.min() and sigma_m.max() < 0.1
    own = hand.limb.columns.tolist()
    assert variance[own.index(ANGLES[0])] == 0 and np.allclose(variance[[own.index(a) for a in ANGLES[1:]]], np.radians([60, 20]) ** 2)


def test_single_frames_do_not_decide_whether_a_hand_is_seen_and_clicks_do(tracking, monkeypatch: pytest.MonkeyPatch) -> None:
    T, fit = 50, tracking.fit
    own = np.where(np.arange(T) < 15, 80.0, 5.0)
    own[[4, 22]] = 5.0, 80.0
    monkeypatch.setattr(type(fit), "seen", lambda *_: SimpleNamespace(near=lambda *_: None))

    def share(clicked) -> np.ndarray:
        found = iter(own.tolist())
        monkeypatch.setattr(unseen_hands, "explained", lambda *_: next(found))
        return _added(tracking, clicked, T).variance_m2[:, 0]

    found = share({}) / share({}).max()
    assert not found[:10].any() and np.allclose(found[19:], 1) and 0 <= np.diff(found).min() and np.diff(found).max() < 0.2
    knuckles = np.full_like(fit.clicked[0].joint, SHAPE.skeleton.joint_names.index("knuckles.R"))
    clicked = share({40: replace(fit.clicked[0], joint=knuckles)})
    assert not clicked[36:43].any() and clicked[25] > 0 and clicked[48] > 0


def limb_columns(tracking: PoseTracking) -> np.ndarray:
    return _right(tracking.fit).columns


def _given_without_background() -> FitInput:
    rig, joints = front_rig(), joint_positions(SHAPE.skeleton, SHAPE.lengths_m, _pose(TRUE))
    clicks = {name: {c.name: c.project(at) for c in rig.cameras} for name, at in joints.items()}
    clouds = [measured_cloud(SHAPE, _pose(TRUE), 0, np.random.default_rng(0), points=200, noise=0.001, gross=0.0)]
    return FitInput(rig=rig, model="full", clouds=clouds, time_s=np.zeros(1), clicks={0: clicks})


def test_points_of_hands_are_on_fingers_where_hands_were_looked_for(tracking) -> None:
    """On metaballs elsewhere, where a hand has fewer points than `min_points`, and where its forearm is not seen."""
    fit, pose = tracking.fit, _pose(TRUE)
    state = fit.parameters.state(pose, tracking.first.vector)
    xyz, normals = points_on_hand(state, "hand.R", 60)
    hand = CloudPoints(frame=0, xyz_m=xyz, normals=normals, sigma_m=np.full(len(xyz), 1e-3))
    body, forearm = surface_points(state), int(SHAPE.skeleton.parents[HAND])
    arm = body[np.linalg.norm(body - state.head_m[forearm] - 0.4 * state.lengths_m[forearm] * state.R[forearm][:, 1], axis=1) < 0.1]
    both = np.concatenate([arm, xyz])
    points = CloudPoints(frame=0, xyz_m=both, normals=np.zeros_like(both), sigma_m=np.full(len(both), 1e-3))
    plain = fit.with_fingers(0, points, state)
    assert not any(isinstance(o, HandPoints) for o in plain) and HAND in plain[0].bone
    looked, cache = replace(fit, turned=angles_of_hands(fit, np.tile(pose, (FRAMES, 1)))), SegmentationCache()
    for _ in range(2):  # the second time from the cache
        surface, hands = looked.with_fingers(0, points, state, cache)[:2]
        assert HAND not in surface.bone and forearm in surface.bone and hands.size > 50 and set(hands.bone.tolist()) == {HAND}
    for few in (points.take(np.arange(len(arm) + fit.settings.min_points - 1)), hand):
        surface, hands = looked.with_fingers(0, few, state)[:2]
        assert HAND in surface.bone and not hands.size


def test_the_place_of_a_hand_is_that_against_its_arm(tracking) -> None:
    limb, vector = _right(tracking.fit), tracking.first.vector
    low, high = (limb.ends(_pose(TRUE, lifted)[None], vector) for lifted in (0.0, 90.0))
    assert np.allclose(low, high) and low.shape == (1, 2, 3)
    assert limb.reach_m(tracking.fit.parameters.body(vector)[0]) > 0.15
    arm = next(limb for limb in whole_limbs(tracking.fit.parameters) if limb.hand is None and HAND in limb.outer)
    at = [arm.columns.tolist().index(c) for c in ANGLES]
    assert np.degrees(arm.high[at]) == pytest.approx([90.0, 80.0, 35.0]) and np.degrees(limb.high) == pytest.approx([90.0, 80.0, 70.0])


def test_the_adjustment_holds_hands_where_they_were_found(tracking) -> None:
    motion = np.stack([_pose(TRUE + 0.01 * t) for t in range(FRAMES)])
    fit = replace(tracking.fit, turned=angles_of_hands(tracking.fit, motion))
    (prior,) = [p for p in priors_at(fit, 3) if isinstance(p, PosePrior)]
    (own,) = [p for p in fit.priors if isinstance(p, PosePrior)]
    assert prior.mean[ANGLES] == pytest.approx(TRUE + 0.03) and (prior.sigma[ANGLES] == turned_hands.SIGMA).all()
    others = np.flatnonzero(np.isnan(fit.turned[0]))
    assert np.array_equal(prior.mean[others], own.mean[others]) and np.array_equal(prior.sigma[others], own.sigma[others])
    assert np.array_equal(fit.stretch([3, 4]).turned, fit.turned[3:5], equal_nan=True)
    assert priors_at(tracking.fit, 0) is tracking.fit.priors
