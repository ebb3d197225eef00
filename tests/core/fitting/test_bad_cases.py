"""Input that is poor or wrong: a status or a sentence, never a silent wrong body."""

from types import SimpleNamespace

import numpy as np
import pytest

from tricap.core.body.metaballs import field_and_derivatives
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import bone_frames, joint_positions
from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.observations import PosePrior
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.solve.problem import Estimate, Problem
from tricap.core.fitting.solve.solver import _next_damping, solve
from tricap.core.fitting.stages.sequence import fit_context, fit_sequence, frame_statuses
from tricap.core.fitting.state import ShapeParameters, free_bones
from tricap.core.foundation.errors import InputError

from .limb_scene import front_rig, surface

SETTINGS = FitSettings(model_sigma_m=0.001, voxel_m=0.004)


def _given(scene, **changes) -> FitInput:
    values = dict(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks={0: scene.clicks}, time_s=scene.time_s)
    return FitInput(**{**values, **changes})


def _near(cloud, a: np.ndarray, b: np.ndarray) -> SimpleNamespace:
    """The points of a cloud that are near the segment from a to b."""
    axis = (b - a) / np.linalg.norm(b - a)
    along = (cloud.xyz_m - a) @ axis / np.linalg.norm(b - a)
    keep = (along > 0.05) & (along < 0.9)
    return SimpleNamespace(frame=cloud.frame, xyz_m=cloud.xyz_m[keep], normals=cloud.normals[keep], covariance_m2=cloud.covariance_m2[keep])


def test_one_frame_is_enough(make_scene) -> None:
    scene = make_scene(seed=1)
    fit = fit_sequence(_given(scene), SETTINGS)
    assert fit.motion.status == ("fitted",)
    assert np.linalg.norm(fit.motion.joints_m - scene.joints_m, axis=2).max() < 0.015


@pytest.mark.parametrize("limb", [0, 1])
def test_all_points_on_one_limb(make_scene, limb) -> None:
    scene = make_scene(frames=8, seed=2)
    for t, cloud in enumerate(scene.clouds):
        scene.clouds[t] = _near(cloud, scene.joints_m[t, limb], scene.joints_m[t, limb + 1])
    fit = fit_sequence(_given(scene, clouds=scene.clouds[:6], time_s=scene.time_s[:6]), SETTINGS)
    assert set(fit.motion.status) == {"partial"}
    assert (fit.points[:, 1 - limb] < SETTINGS.min_points).all()
    seen, unseen = (fit.motion.joint_sigma_m[-1, j] for j in ((0, 2) if limb == 0 else (2, 0)))
    assert unseen > 2 * seen


def test_a_straight_limb_stays_within_its_sigmas(make_scene) -> None:
    scene = make_scene(frames=4, seed=3)
    flexion, twist = (scene.shape.skeleton.layout[f"elbow.R {name}"] for name in ("flexion", "twist"))
    scene.motion[:, flexion] = np.radians(2.0)
    rng = np.random.default_rng(3)
    for t, motion in enumerate(scene.motion):
        bone = rng.integers(0, 2, 700)
        X, normal = surface(scene.shape, motion, rng.uniform(0.05, 0.95, 700), rng.uniform(0, 2 * np.pi, 700), bone)
        keep = normal[:, 1] < -0.3
        X = X[keep] + 0.002 * rng.normal(size=(keep.sum(), 1)) * normal[keep]
        covariance = np.repeat(np.eye(3)[None] * 4e-6, len(X), axis=0)
        scene.clouds[t] = SimpleNamespace(frame=t, xyz_m=X, normals=normal[keep], covariance_m2=covariance)
    names = scene.shape.skeleton.joint_names
    clicks = {name: {c.name: c.project(X) for c in scene.rig.cameras} for name, X in zip(names, scene.joints_m[0])}
    fit = fit_sequence(_given(scene, clicks={0: clicks}), SETTINGS)
    assert set(fit.motion.status) == {"fitted"}
    assert np.degrees(np.abs(fit.motion.values[:, flexion] - scene.motion[:, flexion])).max() < 4.0
    assert np.degrees(fit.motion.sigma[:, twist].min()) > 10  # a straight round limb does not show its twist
    assert np.linalg.norm(fit.motion.joints_m - scene.joints_m, axis=2).mean() < 0.01


def test_a_second_person_next_to_the_first_does_not_matter(make_scene) -> None:
    scene = make_scene(frames=3, seed=4)
    alone = fit_sequence(_given(scene), SETTINGS)
    for t, c in enumerate(scene.clouds):
        other = c.xyz_m + np.array([0.6, 0.1, 0.0])
        scene.clouds[t] = SimpleNamespace(
            frame=t,
            xyz_m=np.vstack([c.xyz_m, other]),
            normals=np.vstack([c.normals, c.normals]),
            covariance_m2=np.concatenate([c.covariance_m2, c.covariance_m2]),
        )
    both = fit_sequence(_given(scene), SETTINGS)
    assert np.abs(both.motion.joints_m - alone.motion.joints_m).max() < 1e-3


def test_clicks_in_a_frame_that_was_not_measured_are_refused(make_scene) -> None:
    scene = make_scene(frames=2, seed=5)
    with pytest.raises(InputError, match="frame 7, which was not measured"):
        _given(scene, clicks={0: scene.clicks, 7: scene.clicks})
    with pytest.raises(InputError, match="growing time"):
        _given(scene, time_s=np.array([0.0, np.nan]))


@pytest.mark.slow
def test_the_upper_body_is_fitted() -> None:
    shape, rig, rng = default_shape(read_model("upper_body")), front_rig(), np.random.default_rng(6)
    skeleton = shape.skeleton
    motion = np.zeros((4, len(skeleton.dofs)))
    for t in range(4):
        for name, value in {
            "shoulder.R flexion": 20 + 3 * t,
            "elbow.R flexion": 40 + 4 * t,
            "shoulder.L flexion": 10,
            "elbow.L flexion": 30,
            "spine flexion": 4 + t,
            "head rotation": 5 * t,
        }.items():
            motion[t, skeleton.layout[name]] = np.radians(value)
    motion[:, 2] = -0.3
    clouds = [_front(shape, m, t, rng) for t, m in enumerate(motion)]
    true = np.stack(list(joint_positions(skeleton, shape.lengths_m, motion).values()), axis=1)
    clicks = {name: {c.name: c.project(X) + rng.uniform(-2, 2, 2) for c in rig.cameras} for name, X in zip(skeleton.joint_names, true[0])}
    fit = fit_sequence(FitInput(rig=rig, model="upper_body", clouds=clouds, clicks={0: clicks}, time_s=np.arange(4) / 25), FitSettings())
    limbs = [i for i, name in enumerate(skeleton.joint_names) if name.split(".")[0] in ("shoulder", "elbow", "wrist")]
    assert np.linalg.norm(fit.motion.joints_m - true, axis=2)[:, limbs].mean() < 0.02
    change = np.degrees(np.diff(fit.motion.values - motion, axis=0)[:, [skeleton.layout[f"elbow.{s} flexion"] for s in "LR"]])
    assert np.abs(change).max() < 3.0


def _front(shape, motion: np.ndarray, frame: int, rng: np.random.Generator) -> SimpleNamespace:
    """Points of the front of the surface of all limbs together, where no other limb covers them."""
    bone = rng.choice(np.unique(shape.metaballs.bone_index), 6000)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    along, angle = rng.uniform(0, 1, len(bone)), rng.uniform(0, 2 * np.pi, len(bone))
    axis = head[bone] + (along * shape.lengths_m[bone])[:, None] * R[bone, :, 1]
    ray = np.cos(angle)[:, None] * R[bone, :, 0] + np.sin(angle)[:, None] * R[bone, :, 2]
    active = shape.skeleton.neighbours[bone][:, shape.metaballs.bone_index]
    low, high = np.zeros(len(bone)), np.full(len(bone), 0.3)
    for _ in range(14):
        middle = (low + high) / 2
        F, gradient, *_ = field_and_derivatives(shape.metaballs, shape.lengths_m, R, head, axis + middle[:, None] * ray, active)
        low, high = np.where(F > 0.5, middle, low), np.where(F > 0.5, high, middle)
    normal = -gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    keep = normal[:, 1] < -0.3
    X = (axis + low[:, None] * ray)[keep] + 0.001 * rng.normal(size=(keep.sum(), 1)) * normal[keep]
    return SimpleNamespace(frame=frame, xyz_m=X, normals=normal[keep], covariance_m2=np.repeat(np.eye(3)[None] * 1e-6, len(X), 0))


@pytest.mark.parametrize(("mean", "known", "converged"), [(0.1, 1.0, True), (np.nan, 1.0, False), (0.1, 0.0, False)])
def test_only_a_finite_minimum_is_called_converged(mean: float, known: float, converged: bool) -> None:
    parameters = ShapeParameters(default_shape(read_model("arm.R")))
    D = len(parameters.skeleton.dofs)
    sigma = np.full(D, 1.0)
    sigma[-1] = 1.0 if known else np.inf  # nothing is known of one angle: no damping makes the equations regular
    problem = Problem(parameters=parameters, observe=lambda t, state: [PosePrior(mean=np.full(D, mean), sigma=sigma)])
    solution = solve(problem, Estimate(motion=np.zeros((1, D)), vector=parameters.vector()), steps=20)
    assert solution.converged is converged
    if converged:
        again = solve(problem, Estimate(motion=solution.motion, vector=solution.vector), steps=20)  # from the minimum no step goes down
        assert again.converged and np.allclose(again.motion, mean)


def test_a_partial_frame_can_be_suspect(make_scene) -> None:
    scene = make_scene(frames=4, seed=2)
    fit = fit_context(_given(scene), SETTINGS)
    counts = np.where(free_bones(fit.parameters), 200, 0) * np.ones((5, 1), dtype=int)
    counts[1, np.flatnonzero(free_bones(fit.parameters))[1]] = 0
    counts[3:] = counts[1]
    counts[4] = 0
    sigma0 = np.array([1.0, 1.1, 1.0, 5.0, np.nan])
    assert frame_statuses(fit, counts, sigma0) == ("fitted", "partial", "fitted", "suspect", "bridged")


def test_a_step_that_gains_less_than_predicted_makes_the_next_one_shorter() -> None:
    assert _next_damping(1e-3, gain=1.0, predicted=10.0) == pytest.approx(1e-2)
    assert _next_damping(1e-3, gain=4.0, predicted=10.0) == pytest.approx(1e-3)
    assert _next_damping(1e-3, gain=9.0, predicted=10.0) == pytest.approx(1e-4)
    assert _next_damping(1e-9, gain=9.0, predicted=10.0) == pytest.approx(1e-9)


@pytest.mark.parametrize(
    "gains, damping, iterations",
    [
        ((100.0, 1.0, 1.0, 100.0), 1e-6, 3),
        ((100.0, 1.0, 100.0, 1.0, 1.0, 100.0), 1e-6, 5),  # points changed limbs in between
        ((100.0, 1.0, 1.0, 100.0, 1.0), 1.0, 5),  # small because they are damped
    ],
)
def test_two_slight_steps_in_a_row_end_an_adjustment(monkeypatch, gains, damping, iterations) -> None:
    model = read_model("arm.R")
    parameters = ShapeParameters(default_shape(model))
    D = len(model.skeleton.dofs)
    left = list(gains)

    def step(problem, lin, now, *_):
        return (now.motion + 0.1, now.vector, lin.cost - left.pop(0)), damping

    lin = SimpleNamespace(cost=1000.0, scales=lambda before: before)
    monkeypatch.setattr("tricap.core.fitting.solve.solver.linearise", lambda problem, now, given: lin)
    monkeypatch.setattr("tricap.core.fitting.solve.solver._accepted_step", step)
    problem = Problem(parameters=parameters, observe=lambda t, state: [])
    start = Estimate(motion=np.zeros((1, D)), vector=parameters.vector())
    solution = solve(problem, start, steps=len(gains), slight_sigmas=np.sqrt(2.0 / D))
    assert solution.iterations == iterations
    assert solution.converged == (damping < 1)
