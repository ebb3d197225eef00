"""Points on hands with their fingers: whose they are, what they tell of the hand's pose, and how far its fingers are bent."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import LARGEST_SIGMA, default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.body.skin.hand_template import BENDS, FINGERS, RELAXED, finger_frames
from tricap.core.fitting.hands import BACK, BEND_SIGMA, Fingers
from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.observations import HandPoints, PosePrior, ShapePrior
from tricap.core.fitting.observations.hand_points import hand_gaps, hand_owners
from tricap.core.fitting.segmentation import surface_points
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.solve.problem import Estimate, Problem
from tricap.core.fitting.solve.solver import solve
from tricap.core.fitting.stages.set_up import fit_context
from tricap.core.fitting.state import ShapeParameters

from .limb_scene import front_rig, measured_cloud, points_on_hand

SHAPE = default_shape(read_model("full"))
PARAMETERS = ShapeParameters(SHAPE)
LAYOUT, AT = SHAPE.skeleton.layout, PARAMETERS.layout
RIGHT, LEFT = AT.hands
ANGLES = [LAYOUT[name] for name in ("elbow.R twist", "wrist.R flexion", "wrist.R deviation")]
GATE_M = 0.045


def _vector(bend: float) -> np.ndarray:
    vector = PARAMETERS.vector()
    vector[AT["bend hand.R"]] = np.log(bend + BACK)
    return vector


def _pose(angles_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    pose = np.zeros(len(SHAPE.skeleton.dofs))
    pose[LAYOUT["shoulder.R abduction"]] = -1.0
    pose[ANGLES] = np.radians(angles_deg)
    return pose


@pytest.mark.parametrize("left", [False, True])
def test_capsules_follow_the_bent_fingers(left: bool) -> None:
    """Their ends are those of the template's bones, and move with the bend as differences say."""
    fingers, (less, more) = Fingers.bent(left, 1.6), (Fingers.bent(left, 1.6 + h) for h in (-1e-6, 1e-6))
    tips = {f.name: finger_frames(f, 1.6).joints[-1] * [-1 if left else 1, 1, 1] for f in FINGERS}
    ends = fingers.first + fingers.length[:, None] * fingers.axis
    for f, k in zip(FINGERS, (5, 8, 11, 14)):
        np.testing.assert_allclose(ends[k], tips[f.name], atol=1e-12)
    by_difference = np.stack(
        [more.first - less.first, (more.first + more.length[:, None] * more.axis) - (less.first + less.length[:, None] * less.axis)], 1
    )
    np.testing.assert_allclose(fingers.by_bend, by_difference / 2e-6, atol=1e-8)
    np.testing.assert_allclose(fingers.length, Fingers.bent(left, 0.0).length, atol=1e-12)


def test_the_foot_of_a_place_is_the_nearest_on_a_tapered_capsule() -> None:
    """No other place along any capsule is nearer; inside of a hand the distance is negative."""
    fingers, places = Fingers.bent(False, RELAXED), np.random.default_rng(2).uniform([-0.8, -0.2, -0.6], [0.8, 2.2, 0.8], (200, 3))
    share = np.linspace(0, 1, 401)[:, None]
    along = fingers.first + share[..., None] * (fingers.length[:, None] * fingers.axis)
    radii = (1 - share) * fingers.radii[:, 0] + share * fingers.radii[:, 1]
    sampled = (np.linalg.norm(places[:, None, None] - along, axis=-1) - radii).min(axis=(1, 2))
    gap, normal, _ = fingers.gaps(places)
    assert np.all(gap <= sampled + 1e-12) and np.abs(gap - sampled).max() < 1e-3
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    assert fingers.gaps(np.array([[0.0, 0.6, 0.0]]))[0][0] < -0.1


def test_points_belong_to_the_hand_if_it_is_nearest_and_faces_them() -> None:
    state = PARAMETERS.state(_pose(), _vector(0.3))
    xyz, normals = points_on_hand(state, "hand.R")
    rows, bone = hand_owners(xyz, normals, state, GATE_M)
    assert len(rows) > 0.95 * len(xyz) and set(bone.tolist()) == {RIGHT}
    tips = (xyz - state.head_m[RIGHT]) @ state.R[RIGHT][:, 1] > 1.3 * state.lengths_m[RIGHT]
    assert tips.sum() > 10 and np.isin(np.flatnonzero(tips), rows).mean() > 0.9, "metaballs end at the knuckles"
    assert len(hand_owners(xyz, -normals, state, GATE_M)[0]) < 0.1 * len(xyz)
    assert len(hand_owners(xyz, np.zeros_like(normals), state, GATE_M)[0]) > 0.95 * len(xyz), "unknown normals do not matter"
    assert not len(hand_owners(xyz + [0, 0, 0.5], normals, state, GATE_M)[0]) and not len(
        hand_owners(xyz[:0], normals[:0], state, GATE_M)[0]
    )
    body = surface_points(state)
    of_others = body[np.linalg.norm(body - state.head_m[RIGHT], axis=1) > 0.25]
    assert not np.any(hand_owners(of_others, np.zeros_like(of_others), state, GATE_M)[1] == RIGHT)


def test_a_hand_on_a_thigh_does_not_take_the_thigh() -> None:
    """The hand is moved into the thigh: of the thigh's points only those within the hand are nearer to it."""
    state = PARAMETERS.state(_pose(), _vector(0.3))
    thigh = [bone.name for bone in SHAPE.skeleton.bones].index("thigh.R")
    moved = replace(state, head_m=state.head_m.copy())
    moved.head_m[RIGHT] = state.head_m[thigh] + 0.4 * state.lengths_m[thigh] * state.R[thigh][:, 1] + 0.09 * state.R[thigh][:, 0]
    points = surface_points(state)
    near_thigh = points[np.linalg.norm(points - moved.head_m[RIGHT], axis=1) < 0.25]
    rows, _ = hand_owners(near_thigh, np.zeros_like(near_thigh), moved, GATE_M)
    gaps = hand_gaps(near_thigh, moved, RIGHT)[0]
    assert (gaps < GATE_M).sum() > len(rows) and np.all(gaps[rows] < 0.01)


def _solved(bend: float, angles: tuple[float, float, float], points: int):
    """The pose and bend that points show, from a relaxed hand with angles of 0 and a bent prior."""
    true = PARAMETERS.state(_pose(angles), _vector(bend))
    xyz, normals = points_on_hand(true, "hand.R", points)

    def observe(_t, state):
        rows, bone = hand_owners(xyz, normals, state, GATE_M)
        found = HandPoints(xyz_m=xyz[rows], bone=bone, sigma_m=np.full(len(rows), 0.005), variance_inflation=30.0)
        return [found, PosePrior(mean=_pose(), sigma=np.full(len(_pose()), np.radians(21.0)))]

    sigma = np.full(len(AT), 0.02)
    sigma[AT.group("bends")] = BEND_SIGMA
    mine = np.concatenate([AT.group("lengths")[[RIGHT]], AT.group("bends")])
    problem = Problem(
        parameters=PARAMETERS,
        observe=observe,
        shape_observations=[ShapePrior(mean=_vector(RELAXED), sigma=sigma)],
        free_shape=mine,
        fixed=np.setdiff1d(np.arange(len(_pose())), ANGLES),
    )
    return solve(problem, Estimate(motion=_pose()[None], vector=_vector(RELAXED)), steps=30)


@pytest.mark.parametrize("bend", [0.2, 2.0])
def test_points_tell_the_hand_s_angles_and_how_far_its_fingers_are_bent(bend: float) -> None:
    angles = (18.0, -12.0, 8.0)
    found = _solved(bend, angles, 90)
    assert np.abs(np.degrees(found.motion[0, ANGLES]) - angles).max() < 3.0
    assert abs(PARAMETERS.bends(found.vector)[RIGHT] - bend) < 0.2 and PARAMETERS.bends(found.vector)[LEFT] == pytest.approx(RELAXED)


def test_a_bend_counts_as_measured_only_if_points_tell_it() -> None:
    """It is kept in either case; hands that nothing shows are relaxed in the skin."""
    sigma, vector = np.full(len(AT), 0.01), _vector(0.3)
    sigma[AT["bend hand.R"]], sigma[AT["bend hand.L"]] = 0.9 * LARGEST_SIGMA, 1.01 * LARGEST_SIGMA
    vector[AT["bend hand.L"]] = np.log(2.0 + BACK)
    shape = PARAMETERS.shape(vector, sigma)
    assert shape.finger_bends["hand.R"] == (pytest.approx(0.3), pytest.approx(0.9 * LARGEST_SIGMA * 0.55))
    assert shape.finger_bend("hand.R") == pytest.approx(0.3) and shape.has_measured_fingers("hand.R")
    assert shape.finger_bend("hand.L") == RELAXED and not shape.has_measured_fingers("hand.L")
    again = ShapeParameters(shape)
    assert again.bends(again.vector()) == {RIGHT: pytest.approx(0.3), LEFT: pytest.approx(2.0)}
    sigma[AT.group("bends")] = BEND_SIGMA
    assert not any(bend.measured for bend in PARAMETERS.shape(_vector(RELAXED), sigma).finger_bends.values()), "the prior alone"
    assert PARAMETERS.bends(_vector(50.0))[RIGHT] == BENDS[1]
    assert ShapeParameters(default_shape(read_model("leg.L"))).layout.hands == ()


def test_the_prior_of_bends_counts_once_however_often_the_others_do() -> None:
    rig, joints = front_rig(), joint_positions(SHAPE.skeleton, SHAPE.lengths_m, _pose())
    clicks = {name: {c.name: c.project(at) for c in rig.cameras} for name, at in joints.items()}
    clouds = [measured_cloud(SHAPE, _pose(), 0, np.random.default_rng(0), points=100, noise=0.001, gross=0.0)]
    fit = fit_context(FitInput(rig=rig, model="full", clouds=clouds, time_s=np.zeros(1), clicks={0: clicks}), FitSettings())
    for weight in (1.0, 60.0):
        prior = next(p for p in fit.shape_observations(weight=weight) if isinstance(p, ShapePrior))
        np.testing.assert_allclose(prior.sigma[AT.group("bends")], BEND_SIGMA * np.sqrt(weight))
        assert prior.sigma[AT.group("radii")].max() == fit.settings.radius_sigma
