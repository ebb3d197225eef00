"""One derivative test for every observation: analytic Jacobian against central differences, naming the culprit."""

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.fitting.observations import (
    BackgroundExclusion,
    ClickedJoints,
    EqualRadii,
    FootOnFloor,
    HandPoints,
    ImageSteps,
    JointLimits,
    Keypoints,
    MaterialSteps,
    PosePrior,
    Proportions,
    SelfCollision,
    ShapePrior,
    SilhouetteRays,
    StepsFromFixed,
    SurfacePoints,
    Symmetry,
)
from tricap.core.fitting.observations.background import DistanceMap
from tricap.core.fitting.part_field import PartField
from tricap.core.fitting.solve.block_band import NormalEquations
from tricap.core.fitting.solve.time_priors import Acceleration
from tricap.core.fitting.state import ShapeParameters
from tricap.core.geometry.camera import Camera

STEP = 1e-6
TOLERANCE = 2e-6  # relative to the largest entry of the Jacobian; central differences at 1e-6 measured 3e-8 at worst


def _parameters(model: str, weights: bool = False) -> ShapeParameters:
    return ShapeParameters(default_shape(read_model(model)), weights)


def _motion(parameters: ShapeParameters, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(0, 0.4, len(parameters.skeleton.dofs))


def _cases(parameters: ShapeParameters, state, rng):
    n, dofs, joints = 40, state.layout.n_pose, len(state.skeleton.joint_names)
    bone = state.balls.bone_index[rng.integers(0, len(state.balls.weight), n)]
    along = rng.uniform(0.1, 0.9, n)
    local = np.stack([rng.normal(0, 0.05, n), along * state.lengths_m[bone], rng.normal(0, 0.05, n)], axis=1)
    near = state.head_m[bone] + np.einsum("nij,nj->ni", state.R[bone], local)
    sigma = rng.uniform(0.001, 0.005, n)
    camera = Camera(
        name="C",
        size_px=(800, 600),
        matrix=np.array([[900, 0, 400], [0, 900, 300], [0, 0, 1.0]]),
        distortions=np.array([-0.1, 0.05, 1e-3, -1e-3, 0.0]),
        t_cam_world_m=np.array([0, 0, 3.0]),
    )
    shape = parameters.vector()
    root = rng.normal(0, 0.1, (len(state.lengths_m),) * 2)
    return [
        SurfacePoints.about(state, xyz_m=near, bone=bone, sigma_m=sigma),
        SurfacePoints.about(state, xyz_m=near, bone=bone, sigma_m=sigma, form="paper"),
        ClickedJoints(cameras=(camera,) * joints, joint=np.arange(joints), xy_px=rng.normal(400, 50, (joints, 2)), sigma_px=5.0),
        JointLimits(low=np.full(dofs, -0.2), high=np.full(dofs, 0.2), sigma=0.03),
        PosePrior(mean=np.zeros(dofs), sigma=rng.uniform(0.1, 1, dofs)),
        ShapePrior(mean=shape, sigma=np.full(len(shape), 0.2)),
        EqualRadii(sigma=0.1, log_ratio=0.3),
        Proportions(mean=shape[: len(root)], covariance=root @ root.T + 0.01 * np.eye(len(root))),
        FootOnFloor(joint=np.arange(joints), height_m=rng.normal(0, 0.1, joints), floor_m=0.1, sigma_m=0.02),
        Keypoints(joint=np.arange(joints), xyz_m=rng.normal(0, 1, (joints, 3)), sigma_m=rng.uniform(0.005, 0.02, joints)),
        _collisions(state, rng),
        _empty(camera, joints, rng),
        _rays(state, near, bone, sigma, rng),
        Symmetry(left=np.array([0, 3]), right=np.array([1, 4]), sigma=np.array([0.015, 0.03])),
        *_on_hands(state, rng),
    ]


@pytest.mark.parametrize("form", ["paper", "metric"])
def test_a_point_is_attracted_by_the_field_of_its_part(form: str) -> None:
    """Eq. 15, ½ − F in units of its sigma √(2 ln 2) σ/l, saturates far away; the metric one grows with the distance."""
    parameters = _parameters("arm.R")
    state = parameters.state(np.zeros(len(parameters.skeleton.dofs)), parameters.vector())
    middle = state.head_m[1] + 0.5 * state.lengths_m[1] * state.R[1][:, 1]
    sigma = 0.002
    distance = np.linspace(0.0, 0.3, 3001)
    ray = middle + distance[:, None] * state.R[1][:, 0]
    part = PartField(state.parts[1], state, ray)
    points = SurfacePoints.about(state, xyz_m=ray, bone=np.ones(len(ray), int), sigma_m=np.full(len(ray), sigma), form=form)
    found, on = points.residual(state), int(np.argmin(np.abs(part.F - 0.5)))
    assert abs(found[on]) < 0.05
    if form == "paper":
        mean = state.balls.radii_m[state.parts[1].balls][:, [0, 2]].mean()
        assert np.allclose(found, (0.5 - part.F) / (sigma * np.sqrt(2 * np.log(2)) / mean)) and found[-1] == pytest.approx(
            found[-2], rel=1e-3
        )
    else:
        assert found[on + 20] - found[on] == pytest.approx(1.0, rel=0.1), "20 steps of 0.1 mm are a sigma"
        assert found[-1] > 5 * found[on + 200] > 0


def _collisions(state, rng):
    """Places on the last bone that are less than a large radius away from the bone before it."""
    last = len(state.lengths_m) - 1
    return SelfCollision.about(
        state,
        bone=np.full(6, last),
        fraction=rng.uniform(0.1, 0.6, 6),
        other=np.full(6, state.skeleton.parents[last]),
        radius_m=rng.uniform(0.5, 1.0, 6),
        sigma_m=0.01,
    )


def _on_hands(state, rng) -> list[HandPoints]:
    """Points around each hand as far as its fingers reach."""
    bone = np.repeat(np.array(state.layout.hands, dtype=int), 40)
    local = rng.uniform([-0.6, 0.1, -0.3], [0.6, 2.0, 0.5], (len(bone), 3)) * state.lengths_m[bone, None]
    xyz = state.head_m[bone] + np.einsum("nij,nj->ni", state.R[bone], local)
    return [HandPoints(xyz_m=xyz, bone=bone, sigma_m=rng.uniform(0.001, 0.005, len(bone)), variance_inflation=2.0)] if len(bone) else []


def _empty(camera: Camera, joints: int, rng) -> BackgroundExclusion:
    """DistanceMap that rise evenly to the right and downwards: without the kinks between the nodes of a real table."""
    rise = 0.05 * np.arange(201)[None, :] + 0.03 * np.arange(151)[:, None]
    view = DistanceMap(camera=camera, table=rise, step_px=4.0, first_px=0.0)
    return BackgroundExclusion(
        views=[view, view],
        head=np.arange(joints),
        tail=(np.arange(joints) + 1) % joints,
        fraction=rng.uniform(0.1, 0.9, joints),
        sigma_px=4.0,
    )


def _rays(state, near, bone, sigma, rng):
    """Rays from 3 m away that pass each surface point's limb a few millimetres off."""
    origin = near + np.array([0.0, -3.0, 0.0]) + rng.normal(0, 0.2, near.shape)
    away = near + rng.normal(0, 0.01, near.shape) - origin
    direction = away / np.linalg.norm(away, axis=1, keepdims=True)
    return SilhouetteRays.about(state, origin_m=origin, direction=direction, bone=bone, sigma_m=sigma)


@pytest.mark.parametrize("model", ["arm.R", "leg.L", "full"])
@pytest.mark.parametrize(("seed", "weights"), [(3, False), (1, False), (2, True)])  # with others a ray may lie at a kink of its field
def test_jacobians_equal_differences(model: str, seed: int, weights: bool) -> None:
    rng = np.random.default_rng(seed)
    parameters = _parameters(model, weights)
    vector = parameters.vector() + rng.normal(0, 0.1, len(parameters.layout))
    motion = _motion(parameters, rng)
    names = (*parameters.skeleton.dof_names, *parameters.layout.names)
    x = np.concatenate([motion, vector])

    def state(x):
        return parameters.state(x[: len(motion)], x[len(motion) :])

    every = list(enumerate(names))
    some = every if len(every) < 50 else [every[k] for k in rng.choice(len(every), 30, replace=False)]  # of a whole body others each time
    for observation in _cases(parameters, state(x), rng):
        J = observation.jacobian(state(x))
        scale = np.abs(J).max()
        for k, name in some:
            step = np.zeros(len(x))
            step[k] = STEP
            difference = (observation.residual(state(x + step)) - observation.residual(state(x - step))) / (2 * STEP)
            worst = np.abs(J[:, k] - difference).max() / scale
            assert worst < TOLERANCE, f"{type(observation).__name__}: derivative to “{name}” is off by {worst:.1e}"
        assert np.array_equal(observation.jacobian(state(x), shape=False), J[:, : len(motion)])


def _steps(parameters: ShapeParameters, rng: np.random.Generator, in_view: bool) -> MaterialSteps | ImageSteps:
    bone, sigma = np.arange(20) % len(parameters.skeleton.bones), rng.uniform(0.001, 0.005, 20)
    from_m, to_m = rng.normal(0, 0.3, (2, 20, 3))
    if in_view:
        return ImageSteps(from_m=from_m, ray_m=to_m, across=rng.normal(size=(20, 2, 3)), bone=bone, sigma_m=sigma)
    return MaterialSteps(from_m=from_m, to_m=to_m, bone=bone, sigma_m=sigma)


@pytest.mark.parametrize("in_view", [False, True])
@pytest.mark.parametrize("model", ["arm.R", "leg.L", "full"])
def test_jacobian_of_a_step_between_frames_equals_differences(model: str, in_view: bool) -> None:
    rng = np.random.default_rng(3)
    parameters = _parameters(model)
    vector, D = parameters.vector(), len(parameters.skeleton.dofs)
    x = np.concatenate([_motion(parameters, rng), _motion(parameters, rng), vector])
    names = [f"{name} of frame {k}" for k in "ab" for name in parameters.skeleton.dof_names] + list(parameters.layout.names)
    steps = _steps(parameters, rng, in_view)

    def states(x):
        return parameters.state(x[:D], x[2 * D :]), parameters.state(x[D : 2 * D], x[2 * D :])

    J = np.zeros((steps.size, len(x)))
    for rows, columns, block in steps.blocks(*states(x)):
        J[rows[:, None], columns] = block
    for k, name in enumerate(names):
        h = np.zeros(len(x))
        h[k] = STEP
        difference = (steps.residual(*states(x + h)) - steps.residual(*states(x - h))) / (2 * STEP)
        assert np.abs(J[:, k] - difference).max() / np.abs(J).max() < TOLERANCE, name


@pytest.mark.parametrize("in_view", [False, True])
@pytest.mark.parametrize("model", ["arm.R", "full"])
@pytest.mark.parametrize("backwards", [False, True])
def test_jacobian_of_a_step_from_a_fixed_frame_equals_differences(model: str, backwards: bool, in_view: bool) -> None:
    """The other frame's pose is fixed; its body is the same, so the shape moves both."""
    rng = np.random.default_rng(4)
    parameters = _parameters(model)
    D, other = len(parameters.skeleton.dofs), _motion(parameters, rng)
    x = np.concatenate([_motion(parameters, rng), parameters.vector()])
    names = (*parameters.skeleton.dof_names, *parameters.layout.names)
    steps = _steps(parameters, rng, in_view)

    def observed(x):
        return StepsFromFixed(steps=steps, other=parameters.state(other, x[D:]), backwards=backwards), parameters.state(x[:D], x[D:])

    def residual(x):
        observation, state = observed(x)
        return observation.residual(state)

    observation, state = observed(x)
    J = observation.jacobian(state)
    for k, name in enumerate(names):
        h = np.zeros(len(x))
        h[k] = STEP
        worst = np.abs(J[:, k] - (residual(x + h) - residual(x - h)) / (2 * STEP)).max() / np.abs(J).max()
        assert worst < TOLERANCE, f"derivative to “{name}” is off by {worst:.1e}"
    assert np.array_equal(observation.jacobian(state, shape=False), J[:, :D]) and np.abs(J[:, :D]).max() > 0


def test_accelerations_equal_differences_of_their_cost() -> None:
    """The gradient is −2 g, the second derivatives are twice the band; the times between frames differ."""
    rng, T, D = np.random.default_rng(5), 6, 3
    smooth = Acceleration(time_s=np.cumsum(rng.uniform(0.02, 0.06, T)), sigma=rng.uniform(1, 10, D))
    motion, equations = rng.normal(0, 0.1, (T, D)), NormalEquations.empty(T, D, 0)
    smooth.add_to(equations, motion)
    band = np.zeros((T, D, T, D))
    for t in range(T):
        band[t, :, t] = equations.diagonal[t]
        for blocks, ahead in ((equations.next1, 1), (equations.next2, 2)):
            if t + ahead < T:
                band[t + ahead, :, t], band[t, :, t + ahead] = blocks[t], blocks[t].T
    for t in range(T):
        for d in range(D):
            h = np.zeros((T, D))
            h[t, d] = 1e-3  # the cost is quadratic: differences are exact but for rounding
            up, down = smooth.cost(motion + h), smooth.cost(motion - h)
            assert abs((up - down) / 2e-3 + 2 * equations.g[t, d]) < 1e-6 * np.abs(equations.g).max(), f"frame {t}, DOF {d}"
            moved = NormalEquations.empty(T, D, 0)
            smooth.add_to(moved, motion + h)
            assert np.allclose((equations.g - moved.g) / 1e-3, band[t, d], atol=1e-6 * np.abs(band).max()), f"frame {t}, DOF {d}"
    few = NormalEquations.empty(2, D, 0)
    smooth.add_to(few, motion[:2])
    assert not few.diagonal.any() and smooth.cost(motion[:2]) == 0


@pytest.mark.parametrize("weights", [False, True])
def test_the_layout_gives_every_parameter_its_own_column(weights: bool) -> None:
    layout = _parameters("full", weights).layout
    bones, balls = np.arange(layout.n_bones), np.arange(layout.n_balls)
    parts = [np.arange(layout.n_pose), layout.lengths(bones), layout.radii(balls).ravel(), *([layout.weights(balls)] if weights else [])]
    parts.append(np.array([layout.bend(b) for b in layout.hands]))
    assert np.array_equal(np.concatenate(parts), np.arange(layout.size()))
    assert layout.size(shape=False) == layout.n_pose and layout.size() == layout.n_pose + len(layout)
    for group, columns in (("lengths", parts[1]), ("radii", parts[2]), ("shape", np.concatenate(parts[1:]))):
        assert np.array_equal(layout.columns(group), columns)
    ball, names = 7, layout.names
    assert [names[c - layout.n_pose].rpartition(" ")[2] for c in layout.radii(balls[ball : ball + 1])[0]] == ["x", "z"]


def test_columns_of_two_frames_are_those_of_each_and_of_the_shape() -> None:
    layout, dofs, bones = _parameters("arm.R").layout, np.array([0, 4]), np.array([1])
    both, D = layout.two_frames(dofs, bones, shape=True), layout.n_pose
    poses, shape = layout.split(both, frames=2)
    assert poses.tolist() == [0, 4, D, D + 4] and shape.tolist() == [1]
    for second, own in ((False, [True, True, False, False, True]), (True, [False, False, True, True, True])):
        mine, columns = layout.one_of_two(both, second)
        assert mine.tolist() == own and columns.tolist() == [0, 4, int(layout.lengths(bones)[0])]
    assert layout.two_frames(dofs, bones, shape=False).tolist() == [0, 4, D, D + 4]


def test_fields_are_released_after_their_derivatives_and_evaluated_again() -> None:
    rng = np.random.default_rng(6)
    parameters = _parameters("arm.R")
    state = parameters.state(_motion(parameters, rng), parameters.vector())
    points = _cases(parameters, state, rng)[0]
    before, J = points.residual(state), points.jacobian(state)
    assert not points._last and np.array_equal(points.residual(state), before) and points._last
    again = points.reweighted(state)
    assert again._last and not points._last and np.array_equal(again.jacobian(state), J)


def test_reweighted_rays_are_those_made_anew() -> None:
    parameters, rng = _parameters("full"), np.random.default_rng(8)
    first = parameters.state(_motion(parameters, rng), parameters.vector())
    rays = next(c for c in _cases(parameters, first, rng) if isinstance(c, SilhouetteRays))
    other = parameters.state(first.motion + 0.002, parameters.vector())
    anew = SilhouetteRays.about(other, origin_m=rays.origin_m, direction=rays.direction, bone=rays.bone, sigma_m=rays.sigma_m)
    again = rays.reweighted(other)
    np.testing.assert_allclose(again.contacts(other), anew.contacts(other), atol=1e-8)
    np.testing.assert_allclose(again.residual(other), anew.residual(other), atol=1e-5)
    np.testing.assert_allclose(again.jacobian(other), anew.jacobian(other), atol=1e-3)


def test_the_field_is_largest_where_rays_touch() -> None:
    parameters, rng = _parameters("full"), np.random.default_rng(9)
    state = parameters.state(_motion(parameters, rng), parameters.vector())
    rays = next(c for c in _cases(parameters, state, rng) if isinstance(c, SilhouetteRays))
    there = rays.contacts(state)
    for b in np.unique(rays.bone).tolist():
        rows = rays.bone == b
        F = [PartField(state.parts[b], state, there[rows] + d * rays.direction[rows]).F for d in (-1e-3, 0.0, 1e-3)]
        assert (F[1] >= F[0]).all() and (F[1] >= F[2]).all()


def test_what_was_evaluated_at_a_state_is_not_used_at_another() -> None:
    parameters = _parameters("full")

    def cases():
        rng = np.random.default_rng(7)
        first, other = (parameters.state(_motion(parameters, rng), parameters.vector()) for _ in range(2))
        return first, other, [c for c in _cases(parameters, first, rng) if isinstance(c, SilhouetteRays | BackgroundExclusion)]

    first, other, used = cases()
    fresh = cases()[2]
    assert len(used) == 2
    for one, anew in zip(used, fresh):
        at_first = one.residual(first), one.jacobian(first)
        assert not np.array_equal(at_first[0], one.residual(other))
        assert np.array_equal(one.jacobian(other), anew.jacobian(other))
        assert np.array_equal(one.jacobian(first), at_first[1]) and np.array_equal(one.residual(first), at_first[0])


def test_the_derivative_test_notices_a_wrong_sign() -> None:
    rng = np.random.default_rng(0)
    parameters = _parameters("arm.R")
    state = parameters.state(_motion(parameters, rng), parameters.vector())
    points = _cases(parameters, state, rng)[0]
    moved = state.motion.copy()
    moved[0] += STEP
    difference = (points.residual(parameters.state(moved, parameters.vector())) - points.residual(state)) / STEP
    assert np.abs(-points.jacobian(state)[:, 0] - difference).max() > TOLERANCE * np.abs(points.jacobian(state)).max()
