"""Fit a body to a sequence (D'Apuzzo et al. 1999, §3.3): clicks → posture → shape and posture → frame after frame → the whole sequence.

1. The clicked joints give posture and bone lengths at the click frame (`inverse_kinematics`).
2. At that frame the cloud gives posture and radii, in turns as published or together; several starts, the best supported one is kept.
3. With that shape held, frame after frame forwards and backwards, each from the prediction 2θ_i − θ_{i−1}.
4. One adjustment over the whole sequence: the shape once, a posture per frame, tied over time by weak accelerations.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..body.model_file import BodyModel, read_model
from ..body.shape import default_shape
from ..errors import InputError
from ..geometry.rig import Rig
from ..progress import Monitor
from .acceleration import Acceleration
from .body_motion import BRIDGED, FITTED, PARTIAL, SUSPECT, BodyFit, BodyMotion
from .clicks import Clicks, read_clicks
from .cloud_points import Cloud, CloudPoints, thinned
from .inverse_kinematics import dof_priors, inverse_kinematics, other_postures
from .material_tracks import MaterialTracks, Trajectories
from .observations import EqualRadii, MotionPrior, Observation, ShapePrior, SurfacePoints
from .robust import robust_scale, robust_weights
from .segmentation import crop, segment
from .settings import FitSettings
from .problem import Problem, linearise, variance_factors
from .solver import Solution, solve
from .state import BodyState, ShapeParameters

__all__ = ["BodyFit", "BodyMotion", "FitSettings", "fit_sequence"]

REACH_M = 0.10  # points further than this from the predicted limb's surface are not looked at
SUPPORT_SIGMA_M = 0.005  # width of the weight by which starts are compared
ALTERNATIONS = 6
START_STEPS = 25
DEPTH_SHIFT_M = 0.04
LOST_SUPPORT = 0.6
"""A frame whose support falls below this share of its neighbour's is tried again from other starts."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Fit:
    """What stays the same throughout one fit."""

    model: BodyModel
    parameters: ShapeParameters
    settings: FitSettings
    clicks: Clicks
    click: int  # index of the click frame
    priors: list[Observation]
    prior_vector: np.ndarray

    def surface(self, points: CloudPoints, state: BodyState, wide: float = 1.0) -> list[Observation]:
        """The surface points near a state, as observations."""
        rows, bone = segment(points, state, self.model.surface, self.settings.gate_m * wide)
        own, model = points.sigma_m[rows] ** 2, self.settings.model_sigma_m**2
        share = max(1.0, (self.settings.model_patch_m / self.settings.voxel_m) ** 2)
        crowding = (own + share * model) / (own + model + 1e-12)
        return [SurfacePoints(xyz_m=points.xyz_m[rows], bone=bone, sigma_m=np.sqrt(own + model + 1e-12), crowding=crowding,
                              form=self.settings.residual).scaled(state)]

    def of_shape(self) -> list[Observation]:
        """What is believed about the shape."""
        n, s = self.parameters.n_lengths, self.settings
        sigma = np.full(len(self.prior_vector), s.radius_sigma)
        sigma[:n] = s.length_sigma
        return [ShapePrior(mean=self.prior_vector, sigma=sigma), EqualRadii(sigma=s.roundness_sigma)]

    def problem(self, observe: object, free: str | None, smoothness: Acceleration | None = None) -> Problem:
        """An adjustment with the settings of this fit."""
        shape = self.parameters.layout.set(free) if free else np.zeros(0, dtype=np.intp)
        return Problem(parameters=self.parameters, observe=observe, of_shape=self.of_shape(), free_shape=shape,  # type: ignore[arg-type]
                       smoothness=smoothness, robust=self.settings.robust, robust_width=self.settings.robust_width)

    def support(self, points: CloudPoints, motion: np.ndarray, vector: np.ndarray) -> float:
        """How many points the body explains: the sum of their weights at a fixed width."""
        state = self.parameters.state(motion, vector)
        observation = self.surface(points, state)[0]
        assert isinstance(observation, SurfacePoints)
        metres = observation.residual(state) * observation.sigma_m
        return float(robust_weights(metres / SUPPORT_SIGMA_M, "geman-mcclure", 3.0).sum())


def fit_sequence(rig: Rig, model_name: str, clouds: Sequence[Cloud], joints: Mapping[str, Mapping[str, Sequence[float]]],
                 click_frame: int, time_s: np.ndarray, trajectories: Trajectories | None = None, settings: FitSettings | None = None,
                 monitor: Monitor | None = None) -> BodyFit:
    """Shape and motion of the person from the clouds of a sequence and the joints clicked in one of its frames.

    `clouds` in the order of time, `time_s` (T,) their times, `joints[name][view] = (x, y)` full-frame pixels at frame `click_frame`.
    Frames without points are bridged and say so in their status.

    Raises:
        InputError: the model is unknown, clicks are missing or contradict each other, or the limb has no points at the click frame.
        Cancelled: the user asked to stop.
    """
    settings, monitor = settings or FitSettings(), monitor or Monitor()
    fit = _prepare(rig, model_name, clouds, joints, click_frame, settings)
    points = []
    for i, cloud in enumerate(clouds):
        monitor.step("thin clouds", i, len(clouds))
        points.append(thinned(cloud, settings.voxel_m))
    first = _fit_click_frame(fit, points[fit.click], monitor)
    motion, points = _follow(fit, points, np.asarray(time_s, dtype=np.float64), first, monitor)
    solution, problem = _adjust_all(fit, points, np.asarray(time_s, dtype=np.float64), motion, first.vector, trajectories, monitor)
    return _result(fit, points, np.asarray(time_s, dtype=np.float64), solution, problem)


def _prepare(rig: Rig, model_name: str, clouds: Sequence[Cloud], joints: Mapping[str, Mapping[str, Sequence[float]]],
             click_frame: int, settings: FitSettings) -> _Fit:
    model = read_model(model_name)
    frames = [int(cloud.frame) for cloud in clouds]
    if click_frame not in frames:
        raise InputError(f"The joints are clicked in frame {click_frame}, which was not measured; measure it, or click in another frame.")
    parameters = ShapeParameters(default_shape(model))
    clicks = read_clicks(rig, model.skeleton.joint_names, joints, settings.click_sigma_px)
    priors = dof_priors(model.skeleton, np.radians(settings.limit_sigma_deg), np.nanmean(clicks.xyz_m, axis=0))
    return _Fit(model=model, parameters=parameters, settings=settings, clicks=clicks, click=frames.index(click_frame), priors=priors,
                prior_vector=parameters.vector())


def _fit_click_frame(fit: _Fit, points: CloudPoints, monitor: Monitor) -> Solution:
    """Posture and shape at the click frame: the best supported of several starts about the clicked posture."""
    start = inverse_kinematics(fit.parameters, fit.clicks, fit.priors, fit.settings.length_sigma)
    view = np.mean([c.R_cam_world[2] for c in fit.clicks.observation.cameras], axis=0)
    base = fit.model.skeleton.layout.set("base")
    motions = [start.motion[0], *other_postures(fit.parameters, fit.clicks, start.motion[0])]
    for shift in (-DEPTH_SHIFT_M, DEPTH_SHIFT_M):
        motions.append(start.motion[0].copy())
        motions[-1][base] += shift * view
    best, best_support = None, -1.0
    for i, motion in enumerate(motions):
        monitor.step("fit the click frame", i, len(motions))
        solution = _fit_shape_and_posture(fit, points, motion, start.vector)
        support = fit.support(points, solution.motion[0], solution.vector)
        if support > best_support:
            best, best_support = solution, support
    if best is None or best_support < fit.settings.min_points:
        raise InputError(f"Frame {points.frame} has no measured points near the clicked joints; check the clicks and the rig, "
                         "or click in a frame where the limb was measured.")
    return best


def _fit_shape_and_posture(fit: _Fit, points: CloudPoints, motion: np.ndarray, vector: np.ndarray) -> Solution:
    near = crop(points, fit.parameters.state(motion, vector), 2 * REACH_M)

    def observe(wide: float) -> object:
        return lambda t, state: [*fit.surface(near, state, wide), fit.clicks.observation, *fit.priors]

    solution = solve(fit.problem(observe(1.5), None), motion[None], vector, steps=fit.settings.frame_steps)
    if fit.settings.method == "joint":
        for wide in (1.5, 1.0):
            solution = solve(fit.problem(observe(wide), "shape"), solution.motion, solution.vector, steps=START_STEPS, scales=solution.scales)
        return solution
    for _ in range(ALTERNATIONS):
        for free in ("radii", None):
            solution = solve(fit.problem(observe(1.0), free), solution.motion, solution.vector, steps=5, scales=solution.scales)
    return solution


def _follow(fit: _Fit, points: list[CloudPoints], time_s: np.ndarray, first: Solution,
            monitor: Monitor) -> tuple[np.ndarray, list[CloudPoints]]:
    """Motion (T, D) frame after frame in both directions from the click frame, and the points near it."""
    T = len(points)
    motion = np.empty((T, first.motion.shape[1]))
    motion[fit.click] = first.motion[0]
    points = list(points)
    done = 1
    for direction in (1, -1):
        support, seen = None, [fit.click]
        for t in range(fit.click + direction, T if direction > 0 else -1, direction):
            monitor.step("fit frame after frame", done, T)
            near = crop(points[t], fit.parameters.state(motion[t - direction], first.vector), 2 * REACH_M)
            motion[t], support, found = _next_frame(fit, near, _predictions(motion, time_s, seen, t), first, support)
            if found:
                seen.append(t)
            done += 1
    state = [fit.parameters.state(m, first.vector) for m in motion]
    return motion, [crop(p, s, REACH_M) for p, s in zip(points, state)]


def _predictions(motion: np.ndarray, time_s: np.ndarray, seen: list[int], t: int) -> list[np.ndarray]:
    """2θ_i − θ_{i−1} by time, from the last two frames that had points (a gap longer than a few frames stops the motion), and θ_i."""
    last = motion[seen[-1]]
    if len(seen) < 2 or abs(t - seen[-1]) > 5:
        return [last]
    rate = (last - motion[seen[-2]]) / (time_s[seen[-1]] - time_s[seen[-2]])
    return [last + rate * (time_s[t] - time_s[seen[-1]]), last]


def _next_frame(fit: _Fit, points: CloudPoints, predictions: list[np.ndarray], first: Solution,
                last_support: float | None) -> tuple[np.ndarray, float | None, bool]:
    s, skeleton = fit.settings, fit.model.skeleton
    sigma = np.full(len(skeleton.dofs), np.radians(s.prediction_sigma_deg))
    sigma[skeleton.layout.set("base")] = s.prediction_sigma_m
    best, best_support = predictions[0], 0.0
    for start in predictions:
        prior = MotionPrior(mean=start, sigma=sigma)
        problem = fit.problem(lambda t, state, prior=prior: [*fit.surface(points, state), prior, *fit.priors], None)
        solution = solve(problem, start[None], first.vector, steps=s.frame_steps, scales=first.scales)
        support = fit.support(points, solution.motion[0], first.vector)
        if support > best_support:
            best, best_support = solution.motion[0], support
        if last_support is None or best_support > LOST_SUPPORT * last_support:
            break
    if best_support < s.min_points:
        return predictions[0], last_support, False
    return best, best_support, True


def _adjust_all(fit: _Fit, points: list[CloudPoints], time_s: np.ndarray, motion: np.ndarray, vector: np.ndarray,
                trajectories: Trajectories | None, monitor: Monitor) -> tuple[Solution, Problem]:
    s, skeleton = fit.settings, fit.model.skeleton
    sigma = np.full(len(skeleton.dofs), np.radians(s.acceleration_deg_s2))
    sigma[skeleton.layout.set("base")] = s.acceleration_m_s2
    weight = min(float(len(points)), s.shared_frames)
    clicked = replace(fit.clicks.observation, sigma_px=s.click_sigma_px / weight**0.5)

    def observe(t: int, state: BodyState) -> list[Observation]:
        return [*fit.surface(points[t], state), *([clicked] if t == fit.click else []), *fit.priors]

    tracks = None
    if trajectories is not None and s.use_trajectories:
        tracks = MaterialTracks(trajectories, [p.frame for p in points], fit.model.surface, s)
    problem = replace(fit.problem(observe, "shape", Acceleration(time_s=time_s, sigma=sigma)), of_shape_weight=weight,
                      observe_step=None if tracks is None else tracks.steps)
    return solve(problem, motion, vector, steps=s.sequence_steps, monitor=monitor, stage="adjust the sequence"), problem


def _result(fit: _Fit, points: list[CloudPoints], time_s: np.ndarray, solution: Solution, problem: Problem) -> BodyFit:
    parameters, skeleton = fit.parameters, fit.model.skeleton
    lin = linearise(problem, solution.motion, solution.vector, solution.scales)
    understated = variance_factors(problem, lin, solution.scales)
    pose, mixed, shape = linearise(problem, solution.motion, solution.vector, solution.scales, understated).equations.covariance()
    T, D = solution.motion.shape
    joints, joint_sigma, sigma0 = np.empty((T, len(skeleton.joint_names), 3)), np.empty((T, len(skeleton.joint_names))), np.full(T, np.nan)
    counts = np.zeros((T, len(skeleton.bones)), dtype=np.int64)
    for t in range(T):
        state = parameters.state(solution.motion[t], solution.vector)
        joints[t], J = state.joint_jacobian
        K = np.block([[pose[t], mixed[t]], [mixed[t].T, shape]])
        joint_sigma[t] = np.sqrt(np.einsum("jia,ab,jib->j", J, K, J, optimize=True) / 3)
        observation = fit.surface(points[t], state)[0]
        assert isinstance(observation, SurfacePoints)
        counts[t] = np.bincount(observation.bone, minlength=len(skeleton.bones))
        if len(observation.bone):
            sigma0[t] = robust_scale(observation.residual(state))
    motion = BodyMotion(frames=np.array([p.frame for p in points]), time_s=time_s, dof_names=skeleton.dof_names, values=solution.motion,
                        covariance=pose, joint_names=skeleton.joint_names, joints_m=joints, joint_sigma_m=joint_sigma,
                        status=_statuses(fit, counts, sigma0), sigma0=sigma0)
    return BodyFit(shape=parameters.shape(solution.vector, np.sqrt(np.diag(shape))), motion=motion, iterations=solution.iterations,
                   converged=solution.converged, points=counts)


def _statuses(fit: _Fit, counts: np.ndarray, sigma0: np.ndarray) -> tuple[str, ...]:
    with_balls = np.unique(fit.parameters.template.metaballs.bone_index)
    enough = counts[:, with_balls] >= fit.settings.min_points
    usual = np.nanmedian(sigma0) if np.isfinite(sigma0).any() else 1.0
    return tuple(BRIDGED if not e.any() else SUSPECT if s > 3 * usual else FITTED if e.all() else PARTIAL
                 for e, s in zip(enough, sigma0))
