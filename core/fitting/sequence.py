"""Fit a body to a sequence (D'Apuzzo et al. 1999, §3.3): clicks → posture → shape and posture → frame after frame → the whole sequence.

1. The clicked joints give posture and bone lengths at the click frame (`inverse_kinematics`).
2. At that frame the cloud gives posture and radii (`click_frame`).
3. With that shape held, frame after frame forwards and backwards (`frame_to_frame`).
4. One adjustment over the whole sequence: the shape once, a posture per frame, tied over time by tracked points and weak accelerations.

A body is not made of metaballs. What it differs, it differs in every frame, so forty frames tell no more of the shape than one does: in
step 4 what is known of the shape beforehand (radii from the model, bone lengths from the click frame) weighs as much against the points
as it would in a single frame (`shared_frames`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..body.model_file import read_model
from ..body.shape import default_shape, scaled_shape
from ..errors import InputError
from ..geometry.rig import Rig
from ..progress import Monitor
from .acceleration import Acceleration, typical_acceleration
from .body_motion import BRIDGED, FITTED, PARTIAL, SUSPECT, BodyFit, BodyMotion
from .click_frame import clicked_lengths, fit_click_frame
from .clicks import read_clicks
from .cloud_points import Cloud, CloudPoints, thinned
from .conditions import Conditions
from .frame_to_frame import follow
from .inverse_kinematics import clicked_stature, dof_priors, lasting
from .material_tracks import MaterialTracks, Trajectories
from .observations import Observation
from .problem import Problem, linearise, variance_factors
from .robust import robust_scale
from .segmentation import HeldSegments
from .settings import FitSettings
from .solver import Solution, solve
from .state import BodyState, ShapeParameters, free_bones

__all__ = ["BodyFit", "BodyMotion", "FitSettings", "fit_sequence"]

SUSPICIOUS = 3.0  # times the usual sigma0
FEW_POINTS = 0.35  # of the points that the body has in the other frames, or in the click frame


def fit_sequence(rig: Rig, model_name: str, clouds: Sequence[Cloud], joints: Mapping[str, Mapping[str, Sequence[float]]],
                 click_frame: int, time_s: np.ndarray, trajectories: Trajectories | None = None, settings: FitSettings | None = None,
                 monitor: Monitor | None = None) -> BodyFit:
    """Shape and motion of the person from the clouds of a sequence and the joints clicked in one of its frames.

    `clouds` in the order of time, `time_s` (T,) their times, `joints[name][view] = (x, y)` full-frame pixels at frame `click_frame`.
    Frames without points are bridged and say so in their status. Time is linear in frames.

    Raises:
        InputError: the model is unknown, clicks are missing or contradict each other, or the limb has no points at the click frame.
        Cancelled: the user asked to stop.
    """
    settings, monitor = settings or FitSettings(), monitor or Monitor()
    time_s = _checked_times(time_s, len(clouds))
    fit = _conditions(rig, model_name, [int(cloud.frame) for cloud in clouds], joints, click_frame, settings)
    points = []
    for i, cloud in enumerate(clouds):
        monitor.step("thin the clouds", i, len(clouds))
        points.append(thinned(cloud, settings.voxel_m))
    first = fit_click_frame(fit, points[fit.click], monitor)
    tracks = None
    if trajectories is not None and settings.use_trajectories:
        tracks = MaterialTracks(trajectories, [p.frame for p in points], fit.model.surface, settings)
    motion, points, known = follow(fit, points, time_s, first, tracks, monitor)
    sigma = typical_acceleration(motion, known, time_s, _loosest(fit))
    problem = _whole_sequence(fit, points, time_s, sigma, tracks, clicked_lengths(fit, points[fit.click], first))
    solution = solve(problem, motion, first.vector, steps=settings.sequence_steps, monitor=monitor, stage="adjust the sequence")
    return _result(fit, points, time_s, solution, problem)


def _checked_times(time_s: np.ndarray, frames: int) -> np.ndarray:
    times = np.asarray(time_s, dtype=np.float64)
    if times.shape != (frames,) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise InputError(f"The fit needs a growing time for each of the {frames} frames; check the frame rate and the frames of the take.")
    return times


def _conditions(rig: Rig, model_name: str, frames: list[int], joints: Mapping[str, Mapping[str, Sequence[float]]], click_frame: int,
                settings: FitSettings) -> Conditions:
    if click_frame not in frames:
        raise InputError(f"The joints are clicked in frame {click_frame}, which was not measured; measure it, or click in another frame.")
    model = read_model(model_name)
    clicks = read_clicks(rig, model.skeleton.joint_names, joints, settings.click_sigma_px)
    priors = dof_priors(model.skeleton, np.radians(settings.limit_sigma_deg), np.nanmean(clicks.xyz_m, axis=0))
    shape = default_shape(model)
    shape = scaled_shape(shape, clicked_stature(model.skeleton, shape.lengths_m, clicks))
    return Conditions(model=model, parameters=ShapeParameters(shape), settings=settings, clicks=clicks,
                      click=frames.index(click_frame), priors=priors)


def _loosest(fit: Conditions) -> np.ndarray:
    """The largest sigma (D,) of accelerations."""
    s, skeleton = fit.settings, fit.model.skeleton
    sigma = np.full(len(skeleton.dofs), np.radians(s.acceleration_deg_s2))
    sigma[skeleton.layout.set("base")] = s.acceleration_m_s2
    return sigma


def _whole_sequence(fit: Conditions, points: list[CloudPoints], time_s: np.ndarray, sigma: np.ndarray, tracks: MaterialTracks | None,
                    lengths: tuple[np.ndarray, np.ndarray]) -> Problem:
    s = fit.settings
    priors = lasting(fit.priors, time_s)

    held = HeldSegments()

    def observe(t: int, state: BodyState) -> list[Observation]:
        return [fit.surface(points[t], state, held=held), *([fit.clicks.observation] if t == fit.click else []), *priors]

    problem = fit.problem(observe, "shape", Acceleration(time_s=time_s, sigma=sigma))
    return replace(problem, of_shape=fit.of_shape(lengths), of_shape_weight=_shared_weight(points, s),
                   observe_step=None if tracks is None else tracks.steps)


def _shared_weight(points: list[CloudPoints], settings: FitSettings) -> float:
    """By how much T frames tell less of the shape than T times one frame: 1 for noise of the points alone, T for the model's error."""
    own = float(np.median(np.concatenate([p.sigma_m for p in points]))) ** 2 + 1e-12
    model, frames = settings.model_sigma_m**2, min(float(len(points)), settings.shared_frames)
    return (own + frames * model) / (own + model)


def _result(fit: Conditions, points: list[CloudPoints], time_s: np.ndarray, solution: Solution, problem: Problem) -> BodyFit:
    parameters, skeleton = fit.parameters, fit.model.skeleton
    pose, mixed, shape = _covariance(problem, solution)
    T, J = len(points), len(skeleton.joint_names)
    joints, joint_sigma, sigma0 = np.empty((T, J, 3)), np.empty((T, J)), np.full(T, np.nan)
    counts = np.zeros((T, len(skeleton.bones)), dtype=np.int64)
    for t in range(T):
        state = parameters.state(solution.motion[t], solution.vector)
        joints[t], A = state.joint_jacobian
        K = np.block([[pose[t], mixed[t]], [mixed[t].T, shape]])
        joint_sigma[t] = np.sqrt(np.einsum("jia,ab,jib->j", A, K, A, optimize=True) / 3)
        found = fit.surface(points[t], state)
        counts[t] = np.bincount(found.bone, minlength=len(skeleton.bones))
        if len(found.bone):
            sigma0[t] = robust_scale(found.residual(state))
    motion = BodyMotion(frames=np.array([p.frame for p in points]), time_s=time_s, dof_names=skeleton.dof_names, values=solution.motion,
                        covariance=pose, joint_names=skeleton.joint_names, joints_m=joints, joint_sigma_m=joint_sigma,
                        status=_statuses(fit, counts, sigma0), sigma0=sigma0)
    return BodyFit(shape=parameters.shape(solution.vector, np.sqrt(np.diag(shape))), motion=motion, iterations=solution.iterations,
                   converged=solution.converged, points=counts)


def _covariance(problem: Problem, solution: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blocks of the covariance: pose (T, D, D), pose with shape (T, D, S), shape (S, S)."""
    lin = linearise(problem, solution.motion, solution.vector, solution.scales)
    understated = variance_factors(problem, lin, solution.scales)
    return linearise(problem, solution.motion, solution.vector, solution.scales, understated).equations.covariance()


def _statuses(fit: Conditions, counts: np.ndarray, sigma0: np.ndarray) -> tuple[str, ...]:
    enough = counts[:, free_bones(fit.parameters)] >= fit.settings.min_points
    usual = np.nanmedian(sigma0) if np.isfinite(sigma0).any() else 1.0
    total = counts.sum(axis=1)
    few = total < FEW_POINTS * max(float(np.median(total)), float(total[fit.click]))
    strange = few | (np.nan_to_num(sigma0) > SUSPICIOUS * usual)
    return tuple(BRIDGED if not e.any() else PARTIAL if not e.all() else SUSPECT if s else FITTED for e, s in zip(enough, strange))
