"""Fit a body to a sequence (D'Apuzzo et al. 1999, §3.3): clicks → pose → shape and pose → frame after frame → the whole sequence.

1. The clicked joints determine pose and bone lengths at the click frame (`inverse_kinematics`).
2. At that frame the cloud determines pose and radii (`click_frame`).
3. With that shape fixed, poses are tracked frame after frame, forwards and backwards (`pose_tracking`), limbs are followed on their ways
   (`limb_paths`), and hands are turned as they are seen (`turned_hands`).
4. One adjustment over the whole sequence: one shape, a pose per frame, coupled over time by tracked points and weak accelerations. Frames
   whose residuals stay suspicious restart once from between their neighbours.
5. Where the complete model is asked for, it is made from that body (`body.complete`), and step 4 is repeated with its radii.
6. The joints move in the body to where they usually lie and were clicked (`joint_places`).

A recording of more than `AT_ONCE` frames is adjusted stretch by stretch, so that memory does not grow with its length (`_in_stretches`).

Points, outlines and keypoints are each enough alone.

The metaball model has systematic error that may recur in every frame. `shared_frames` lets the prior of the shape weigh as much against the
points of so many frames as against those of one. By default it counts once: other poses determine radii, and the lengths between clicked
joints. The prior that bones are as long as other people's counts for all frames, for other poses do not show what was not clicked either
(`shape_priors`). A body of one ellipsoid a bone has far larger errors: there the whole prior counts for all frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ...body.complete import complete_shape
from ...body.motion import BRIDGED, FITTED, PARTIAL, SUSPECT, BodyFit, BodyMotion
from ...foundation.arrays import LazySequence
from ...foundation.progress import Monitor
from ..context import NO_SHAPE, FitContext
from ..inputs.cloud_points import VARIANCE_FLOOR_M2, CloudPoints, thinned
from ..inputs.fit_input import FitInput
from ..inputs.start_joints import NeedsClick
from ..observations import Observation
from ..observations.joints import StandingFeet
from ..segmentation import SegmentationCache
from ..settings import FitSettings
from ..smooth_radii import smooth_radii
from ..solve.problem import Estimate, Problem, Scales, linearise, variance_factors
from ..solve.solver import Solution, solve
from ..solve.time_priors import Acceleration, Coupling, MarginalPrior, marginal_prior
from ..start.taken_back import taken_back
from ..state import BodyState, ShapeParameters, free_bones
from .click_frame import ALTERNATION_STEPS, clicked_lengths, fit_click_frame
from .contradicted import contradicted_frames, contradicted_joints
from .inverse_kinematics import shared_over_time
from .limb_paths import follow_limbs
from .long_sequence import (
    AT_ONCE,
    NO_PRIORS,
    Convergence,
    Covariance,
    FrameResults,
    MarginalPriors,
    Recording,
    ShapeResult,
    StretchResult,
    frame_results,
    frame_sigma0,
    joined,
    near,
    outlying,
    outwards,
    sample,
)
from .pose_tracking import Checkpoints, PoseTracking, track_poses
from .set_up import acceleration_sigmas, fit_context, point_tracks, with_start
from .sigma_parts import known, sigma_parts
from .turned_hands import angles_of_hands, priors_at, turn_hands

__all__ = ["BodyFit", "BodyMotion", "FitInput", "FitSettings", "fit_context", "fit_sequence"]

ADJUST = "adjust the sequence"  # stages of the progress report
SIGMAS = "sigmas of the fit"
ERROR_REACH_M = 0.10  # along a limb: a measured arm and a measured walker differ from their metaballs over about as much
MUSCLE_SIGMA = 0.15  # relative, of the complete model's radii about those that have the simplified body's surface
SLIGHT_SIGMAS = 0.05  # rms over the parameters: steps that gain less do not bring joints nearer to the truth, but to the model's errors
PATCH = 5 / 6  # of `model_patch_m`: against accelerations points weigh more than against the prediction of one frame
FEW_POINTS = 0.35  # of the points that the body has in the other frames, or in the click frame


@dataclass(frozen=True, eq=False, kw_only=True)
class SequenceStart:
    """Where the adjustment over T frames starts: the tracked poses, and the body of the click frame."""

    motion: np.ndarray  # (T, D)
    observed: np.ndarray  # (T, D) where observations constrain it
    first: Solution  # of the click frame


def fit_sequence(
    given: FitInput, settings: FitSettings | None = None, monitor: Monitor | None = None, checkpoints: Checkpoints | None = None
) -> BodyFit:
    """Shape and motion of the person. Frames without points are bridged, and have that status. Time is linear in frames.

    With `checkpoints`, the state of pose tracking is stored from time to time, and each adjusted stretch; the fit resumes from them.

    Raises:
        InputError: the model or a degree of freedom is unknown, clicks contradict each other, it is not certain where the body starts
            without more clicks, the motion contradicts that start, or the limb has no points where the fit begins.
        Cancelled: the user asked to stop.
    """
    return fit_and_start(given, settings or FitSettings(), monitor or Monitor(), checkpoints)[0]


def fit_and_start(
    given: FitInput, settings: FitSettings, monitor: Monitor, checkpoints: Checkpoints | None = None
) -> tuple[BodyFit, SequenceStart]:
    """`fit_sequence`, and where a further adjustment of the same frames starts (`fit_from`)."""
    given = with_start(given, settings, monitor)
    fit, points = prepared(given, settings, monitor)
    first = fit_click_frame(fit, points[fit.click], monitor)
    tracking = PoseTracking(fit=fit, points=points, time_s=given.time_s, first=first, tracks=point_tracks(given, fit))
    motion, observed = track_poses(tracking, monitor, checkpoints)
    motion = turn_hands(tracking, follow_limbs(tracking, motion, monitor), monitor)
    if given.start is not None and (contradicted := taken_back(fit, given.start, points, motion, first.vector, monitor)):
        raise NeedsClick(contradicted)
    start = SequenceStart(motion=motion, observed=observed, first=first)
    return _adjusted_body(given, tracking, start, monitor, checkpoints), start


def fit_from(
    given: FitInput, start: SequenceStart, settings: FitSettings, monitor: Monitor, checkpoints: Checkpoints | None = None
) -> BodyFit:
    """Shape and motion of the same frames from other trajectories, points or outlines, without tracking the poses again.

    It starts from the tracked poses, and not from the first adjustment: that one ended where further steps follow the model's errors.
    """
    fit, points = prepared(given, settings, monitor)
    tracking = PoseTracking(fit=fit, points=points, time_s=given.time_s, first=start.first, tracks=point_tracks(given, fit))
    return _adjusted_body(given, tracking, start, monitor, checkpoints)


def prepared(given: FitInput, settings: FitSettings, monitor: Monitor) -> tuple[FitContext, Sequence[CloudPoints]]:
    """The context, and the thinned points of all frames."""
    fit = replace(fit_context(given, settings), monitor=monitor)
    points: Sequence[CloudPoints] = LazySequence(given.clouds, partial(thinned, voxel_m=settings.voxel_m))
    return fit, _read(points, monitor) if len(points) <= AT_ONCE else points


def _adjusted_body(
    given: FitInput, tracking: PoseTracking, start: SequenceStart, monitor: Monitor, checkpoints: Checkpoints | None
) -> BodyFit:
    """Step 4 and those after it."""
    fit, points, first, motion = tracking.fit, tracking.points, tracking.first, start.motion
    settings = replace(fit.settings, model_patch_m=PATCH * fit.settings.model_patch_m)
    fit = replace(fit.with_exact_outlines(points), settings=settings, turned=angles_of_hands(fit, motion))
    whole = Recording(
        fit=fit,
        frames=given.frames,
        points=points,
        time_s=given.time_s,
        sigma=acceleration_sigmas(fit, motion, start.observed, given.time_s),
        tracks=tracking.tracks,
        lengths=clicked_lengths(fit, near(points[fit.click], fit.parameters.state(motion[fit.click], first.vector)), first),
        feet=standing(fit, motion, first.vector, given.time_s),
    )
    begin = Estimate(motion=motion, vector=first.vector)
    return _at_once(whole, begin, monitor) if len(points) <= AT_ONCE else _in_stretches(whole, begin, monitor, checkpoints)


def _read(points: Sequence[CloudPoints], monitor: Monitor) -> list[CloudPoints]:
    read = []
    for i in range(len(points)):
        monitor.step("thin the clouds", i, len(points))
        read.append(points[i])
    return read


def _at_once(whole: Recording, start: Estimate, monitor: Monitor) -> BodyFit:
    """All frames in one adjustment."""
    frames = range(len(start.motion))
    part, problem, (*_, solution) = _adjusted(whole.stretch(frames, start.motion, start.vector), start, monitor)
    monitor.step(SIGMAS, 0, 3)
    factors = _factors(part, problem, solution)
    monitor.step(SIGMAS, 1, 3)
    covariance = _covariance(problem, solution, factors)
    monitor.step(SIGMAS, 2, 3)
    places = part.places(solution)
    place_m = part.place_sigmas(solution, places)
    part, solution = part.with_places(solution, places)
    results = frame_results(part, solution, covariance, frames)
    return _result(part, results, solution.vector, covariance[2], place_m, [Convergence.of(solution)])


def _adjusted(part: Recording, start: Estimate, monitor: Monitor) -> tuple[Recording, Problem, list[Solution]]:
    """Poses and shape together. With the complete model there is a second solution, and the returned recording has that model."""
    problem = whole_sequence(part)
    solution = _solve(part.fit, problem, start, monitor, ADJUST)
    solutions = [_restarted(part, solution, problem, monitor)]
    if part.fit.settings.balls == "complete":
        part = replace(part, fit=_completed(part.fit, solutions[0].vector))
        problem = whole_sequence(part)
        again = replace(solutions[0], vector=part.fit.parameters.vector())
        solutions.append(_solve(part.fit, problem, again, monitor, "refine the complete model"))
    return part, problem, solutions


def _solve(fit: FitContext, problem: Problem, start: Estimate, monitor: Monitor, stage: str) -> Solution:
    """Minimise the problem's cost over poses and shape: together, or in turns as published, each with the other fixed, until both end
    with their first step."""
    steps = fit.settings.sequence_steps
    if fit.settings.method == "joint" or not len(problem.free_shape) or not steps:
        return solve(problem, start, steps=steps, monitor=monitor, stage=stage, slight_sigmas=SLIGHT_SIGMAS)
    turns = replace(problem, fixed=np.arange(start.motion.shape[1])), replace(problem, free_shape=NO_SHAPE)
    iterations = 0
    for cycle in range(steps):
        shape = solve(turns[0], start, steps=ALTERNATION_STEPS, monitor=monitor.part(stage, 2 * cycle, 2 * steps))
        poses = solve(turns[1], shape, steps=ALTERNATION_STEPS, monitor=monitor.part(stage, 2 * cycle + 1, 2 * steps))
        start, iterations = poses, iterations + shape.iterations + poses.iterations
        settled = shape.converged and poses.converged and shape.iterations == poses.iterations == 1
        if settled:
            break
    return replace(poses, iterations=iterations, converged=settled)


def _in_stretches(whole: Recording, start: Estimate, monitor: Monitor, checkpoints: Checkpoints | None) -> BodyFit:
    """As `_at_once`, with memory for `AT_ONCE` frames and two margins only.

    First the shape, from blocks of frames all over the recording: the model's error is the same in every frame, so more frames would not
    determine it better. Then, with that shape fixed, the poses; their covariances include that of the shape.
    """
    shape = ShapeResult.loaded(checkpoints)
    if shape is None:
        shape = _shape_of_blocks(whole, start, monitor)
        shape.save(checkpoints)
    if whole.fit.settings.balls == "complete":
        whole = replace(whole, fit=_completed(whole.fit, shape.simplified))
    results, convergence = _poses(whole, start.motion, shape, monitor, checkpoints)
    if shape.places is not None:
        whole = replace(whole, fit=shape.places.placed(whole.fit))
    vector = shape.vector if shape.places is None else shape.places.vector
    return _result(whole, results, vector, shape.covariance, shape.place_m, [shape.convergence, *convergence])


def _shape_of_blocks(whole: Recording, start: Estimate, monitor: Monitor) -> ShapeResult:
    """The shape from some blocks of the frames."""
    frames = sample(len(start.motion), whole.fit.click)
    blocks = whole.stretch(frames, start.motion, start.vector)
    part, problem, solutions = _adjusted(blocks, replace(start, motion=start.motion[frames]), monitor)
    last = solutions[-1]
    covariance, places = _covariance(problem, last, _factors(part, problem, last))[2], part.places(last)
    return ShapeResult(
        simplified=solutions[0].vector,
        vector=last.vector,
        covariance=covariance,
        places=places,
        place_m=part.place_sigmas(last, places),
        convergence=Convergence.of(last),
    )


def _poses(
    whole: Recording, motion: np.ndarray, shape: ShapeResult, monitor: Monitor, checkpoints: Checkpoints | None
) -> tuple[FrameResults, list[Convergence]]:
    """The poses from a motion (T, D), with the shape fixed, stretch after stretch from the click frame on."""
    done, convergence = dict[int, FrameResults](), list[Convergence]()
    priors, plan = dict[int, MarginalPriors](), outwards(len(motion), whole.fit.click)
    for k, (own, around, direction) in enumerate(plan):
        stretch = StretchResult.loaded(checkpoints, own, around)
        if stretch is None:
            part = monitor.part("adjust the poses", k, len(plan))
            stretch = _stretch(whole, (own, around, direction), motion, shape, priors.get(direction, NO_PRIORS), part)
            stretch.save(checkpoints, own, around)
        done[own.start] = stretch.results  # without its priors, which take as much memory again
        convergence.append(stretch.convergence)
        priors.update(stretch.priors)
    return joined([done.pop(start) for start in sorted(done)]), convergence


def _stretch(
    whole: Recording, place: tuple[range, range, int], motion: np.ndarray, shape: ShapeResult, priors: MarginalPriors, monitor: Monitor
) -> StretchResult:
    """One of `outwards`, from a motion (T, D) of all frames, with the priors from the stretches before it."""
    own, around, direction = place
    part = whole.stretch(around, motion, shape.vector)
    problem = whole_sequence(part, priors.adjustment)
    pose_only = replace(problem, free_shape=NO_SHAPE)
    start = Estimate(motion=motion[around], vector=shape.vector)
    solution = solve(pose_only, start, steps=part.fit.settings.sequence_steps, monitor=monitor, slight_sigmas=SLIGHT_SIGMAS)
    solution = _restarted(part, solution, pose_only, monitor)
    local, factors = range(own.start - around.start, own.stop - around.start), _factors(part, pose_only, solution)
    covariance = _covariance(whole_sequence(part, priors.covariance), solution, factors, shape.covariance)
    next_ones = [d for d in ({1, -1} if direction == 0 else {direction}) if (own.stop < len(motion) if d > 0 else own.start > 0)]

    def prior(earlier: MarginalPrior | None, ahead: bool, factors: Scales | None = None) -> MarginalPrior:
        coupling = Coupling(acceleration=Acceleration(time_s=part.time_s, sigma=part.sigma), prior=earlier)
        return marginal_prior(problem, solution, local, coupling, ahead=ahead, factors=factors)

    placed, moved = part.with_places(solution, shape.places)
    return StretchResult(
        results=frame_results(placed, moved, covariance, local),
        convergence=Convergence.of(solution),
        priors={
            d: MarginalPriors(adjustment=prior(priors.adjustment, d > 0), covariance=prior(priors.covariance, d > 0, factors))
            for d in next_ones
        },
    )


def standing(fit: FitContext, motion: np.ndarray, vector: np.ndarray, time_s: np.ndarray) -> StandingFeet | None:
    """Which feet stand in a motion (T, D), if that is asked for."""
    if not fit.settings.floor:
        return None
    joints = np.stack([state.joints_m for state in fit.parameters.states(motion, vector)])
    return StandingFeet(joints, fit.model.skeleton.joint_names, time_s)


def _completed(fit: FitContext, vector: np.ndarray) -> FitContext:
    """The same context for the complete model of a simplified body (S,)."""
    shape = complete_shape(fit.parameters.shape(vector, np.full(len(vector), np.nan)))
    return replace(fit, parameters=ShapeParameters(shape, fit.settings.weights), settings=replace(fit.settings, radius_sigma=MUSCLE_SIGMA))


def whole_sequence(part: Recording, prior: MarginalPrior | None = None) -> Problem:
    """The adjustment of poses and shape, with the marginal prior from the frames of earlier stretches."""
    fit, points, feet = part.fit, part.points, part.feet
    cache = SegmentationCache()
    priors = [shared_over_time(priors_at(fit, t), part.time_s) for t in range(len(points))]

    def observe(t: int, state: BodyState) -> list[Observation]:
        return [
            *fit.with_fingers(t, points[t], state, cache=cache),
            *fit.joints(t),
            *fit.background.observe(t),
            *priors[t],
            *fit.collisions.observe(state),
            *(feet.observe(t) if feet is not None else []),
        ]

    coupling = Coupling(acceleration=Acceleration(time_s=part.time_s, sigma=part.sigma), prior=prior)
    weight = _shared_weight(points, fit.settings)
    return replace(
        fit.problem(observe, "shape", coupling),
        shape_observations=fit.shape_observations(part.lengths, weight),
        shape_weight=weight,
        observe_step=None if part.tracks is None else part.tracks.steps,
    )


def _shared_weight(points: Sequence[CloudPoints], settings: FitSettings) -> float:
    """The weight of the shape's priors against T frames: 1 where the points' noise dominates, T where the model's error does."""
    sigmas = np.concatenate([p.sigma_m for p in points])
    own = (float(np.median(sigmas)) if len(sigmas) else 0.0) ** 2 + VARIANCE_FLOOR_M2
    model, frames = settings.model_sigma_m**2, float(len(points))
    if settings.balls != "one" and len(sigmas):
        frames = min(frames, settings.shared_frames)
    return (own + frames * model) / (own + model)


def _restarted(part: Recording, solution: Solution, problem: Problem, monitor: Monitor) -> Solution:
    """The solution, or a better one in which frames with suspicious residuals were started from between the others."""
    fit, points, time_s = part.fit, part.points, part.time_s
    sigma0 = np.array([frame_sigma0(fit, t, p, solution) for t, p in enumerate(points)])
    bad = np.flatnonzero(outlying(sigma0))
    good = np.setdiff1d(np.flatnonzero(np.isfinite(sigma0)), bad)
    if not len(bad) or not len(good) or not fit.settings.sequence_steps:
        return solution
    motion = solution.motion.copy()
    motion[bad] = np.stack([np.interp(time_s[bad], time_s[good], column) for column in motion[good].T], axis=1)
    again = _solve(fit, problem, replace(solution, motion=motion), monitor, ADJUST)
    more = sum(
        fit.support(t, points[t], again.motion[t], again.vector) - fit.support(t, points[t], solution.motion[t], solution.vector)
        for t in bad.tolist()
    )
    return again if more > 0 else solution


def _result(
    whole: Recording,
    results: FrameResults,
    vector: np.ndarray,
    covariance: np.ndarray,
    place_m: np.ndarray,
    convergence: Sequence[Convergence],
) -> BodyFit:
    """The body of all frames, with the shape vector (S,) and its covariance (S, S), and the sigmas of the joints' places (J,)."""
    fit, skeleton = whole.fit, whole.fit.model.skeleton
    lengths, observed = fit.parameters.body(vector)[0], (results.evidence >= fit.few_points) | ~free_bones(fit.parameters)
    sigmas = sigma_parts(skeleton, lengths, results.values, results.joint_sigma_m, results.elsewhere_m2, place_m)
    vector, covariance = smooth_radii(fit.parameters, vector, covariance, fit.settings.evenness_sigma)
    motion = BodyMotion(
        frames=np.array(whole.frames),
        time_s=whole.time_s,
        dof_names=skeleton.dof_names,
        values=results.values,
        covariance=results.covariance,
        joint_names=skeleton.joint_names,
        joints_m=results.joints_m,
        joint_sigma_m=sigmas.total_m,
        joint_frame_sigma_m=sigmas.frame_m,
        known=known(skeleton, observed, contradicted_joints(fit.parameters, results.misplaced), sigmas.frame_m),
        status=frame_statuses(fit, results.evidence, results.sigma0),
        sigma0=results.sigma0,
    )
    return BodyFit(
        shape=fit.parameters.shape(vector, np.sqrt(np.diag(covariance))),
        motion=motion,
        iterations=max(one.iterations for one in convergence),
        converged=all(one.converged for one in convergence),
        points=results.points,
        outline_m=results.outline_m,
        contradicted=contradicted_frames(fit.parameters, np.array(whole.frames), results.misplaced),
    )


def _covariance(problem: Problem, solution: Solution, factors: Scales, shape: np.ndarray | None = None) -> Covariance:
    """Blocks of the covariance; that of the `shape` may be given."""
    pose, mixed, shape = linearise(problem, solution, factors).equations.covariance(shape)
    pose[:, problem.fixed] = pose[:, :, problem.fixed] = mixed[:, problem.fixed] = 0.0
    return pose, mixed, shape


def posterior(part: Recording, problem: Problem, solution: Solution, shape: np.ndarray) -> Covariance:
    """The covariance of poses that were adjusted alone, where that of the shape (S, S) is known; `problem` has the shape free."""
    return _covariance(problem, solution, _factors(part, replace(problem, free_shape=NO_SHAPE), solution), shape)


def _factors(part: Recording, problem: Problem, solution: Solution) -> Scales:
    """The variance factors of the observations."""
    found = variance_factors(problem, solution)
    own = [p.sigma_m for p in part.points if len(p.sigma_m)]
    wider = _correlated(part.fit.settings, float(np.median(np.concatenate(own))) if own else 0.0)
    return replace(
        found, points=wider * found.points, contours=wider * found.contours, hands=wider * found.hands, steps=wider * found.steps
    )


def _correlated(settings: FitSettings, own_m: float) -> float:
    """The variance factor of the model's error, which is shared within `ERROR_REACH_M`, and not only within the patches of the weights.

    A limb differs from its metaballs along much of its length, and in the frames after it just so.
    """
    own, model = own_m**2 + VARIANCE_FLOOR_M2, settings.model_sigma_m**2
    patch, reach = (max(1.0, (size / settings.voxel_m) ** 2) for size in (settings.model_patch_m, ERROR_REACH_M))
    return max(1.0, (own + reach * model) / (own + patch * model))


def frame_statuses(fit: FitContext, counts: np.ndarray, sigma0: np.ndarray) -> tuple[str, ...]:
    enough = counts[:, free_bones(fit.parameters)] >= fit.settings.min_points
    total = counts.sum(axis=1)
    few = total < FEW_POINTS * max(float(np.median(total)), float(total[fit.click]))
    suspect = few | outlying(sigma0)
    return tuple(BRIDGED if not e.any() else SUSPECT if s else PARTIAL if not e.all() else FITTED for e, s in zip(enough, suspect))
