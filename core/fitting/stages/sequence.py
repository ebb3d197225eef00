"""Fit a body to a sequence (D'Apuzzo et al. 1999, §3.3): clicks → posture → shape and posture → frame after frame → the whole sequence.

1. The clicked joints give posture and bone lengths at the click frame (`inverse_kinematics`).
2. At that frame the cloud gives posture and radii (`click_frame`).
3. With that shape held, frame after frame forwards and backwards (`frame_to_frame`).
4. One adjustment over the whole sequence: the shape once, a posture per frame, tied over time by tracked points and weak accelerations.
   Frames whose residuals stay suspicious begin once more from between their neighbours.
5. Where the complete model is asked for: it is made from that body (`body.complete`), and step 4 is done again with its radii.

A recording of more than `AT_ONCE` frames is adjusted stretch by stretch, so that memory does not grow with its length (`_in_stretches`).

Points, outlines and keypoints are each enough alone.

A body is not made of metaballs, and what it differs it may differ in every frame. `shared_frames` lets what is believed of the shape
beforehand weigh as much against the points of so many frames as against those of one. By default it counts once: other postures tell of
radii, and of the lengths between clicked joints. That bones are as long as other people's counts for all frames, for what nobody clicked is
not seen in other postures either (`bone_lengths`). One ellipsoid a bone differs far from a body: there all of it counts for all frames.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ...body.complete import complete_shape
from ...body.model_file import read_model, with_limits
from ...body.motion import BRIDGED, FITTED, PARTIAL, SUSPECT, BodyFit, BodyMotion
from ...body.shape import default_shape, one_ball_shape, scaled_shape
from ...foundation.arrays import LazySequence
from ...foundation.progress import Monitor
from ..context import NO_SHAPE, FitContext
from ..inputs.background import BackgroundRegions
from ..inputs.clicks import enough, read_clicks
from ..inputs.cloud_points import CloudPoints, thinned
from ..inputs.fit_input import FitInput
from ..inputs.keypoints import JointTracks
from ..inputs.material_tracks import MaterialTracks
from ..inputs.silhouettes import Silhouettes
from ..inputs.standing_feet import StandingFeet
from ..observations import Observation
from ..observations.self_collision import CollisionPairs
from ..robust import robust_scale
from ..segmentation import SegmentationCache
from ..settings import FitSettings
from ..smooth_radii import smooth_radii
from ..solve.problem import Problem, Scales, linearise, variance_factors
from ..solve.solver import Solution, solve
from ..solve.time_priors import Acceleration, Coupling, MarginalPrior, marginal_prior, typical_acceleration
from ..state import BodyState, ShapeParameters, free_bones
from .click_frame import clicked_lengths, fit_click_frame
from .inverse_kinematics import clicked_stature, dof_priors, shared_over_time
from .long_sequence import (
    AT_ONCE,
    NOTHING_BEHIND,
    Convergence,
    FrameResults,
    MarginalPriors,
    Recording,
    ShapeResult,
    StretchResult,
    joined,
    near,
    outwards,
    sample,
)
from .pose_tracking import Checkpoints, follow

__all__ = ["BodyFit", "BodyMotion", "FitInput", "FitSettings", "fit_sequence"]

SIGMAS = "sigmas of the fit"  # a stage, for people
SUSPICIOUS = 3.0  # times the usual sigma0
ERRORS_REACH_M = 0.10  # along a limb: a measured arm and a measured walker differ from their metaballs over about as much
MUSCLE_SIGMA = 0.15  # relative, of the complete model's radii about those that give the simplified body's surface
FEW_POINTS = 0.35  # of the points that the body has in the other frames, or in the click frame


def fit_sequence(
    given: FitInput, settings: FitSettings | None = None, monitor: Monitor | None = None, kept: Checkpoints | None = None
) -> BodyFit:
    """Shape and motion of the person. Frames without points are bridged and say so in their status. Time is linear in frames.

    With `kept`, the work frame after frame is kept there from time to time, and so is each stretch that is done; both are gone on with.

    Raises:
        InputError: the model or a degree of freedom is unknown, clicks are missing or contradict each other, or the limb has no points
            where the fit begins.
        Cancelled: the user asked to stop.
    """
    settings, monitor = settings or FitSettings(), monitor or Monitor()
    fit = replace(conditions(given, settings), monitor=monitor)
    points: Sequence[CloudPoints] = LazySequence(given.clouds, partial(thinned, voxel_m=settings.voxel_m))
    if len(points) <= AT_ONCE:
        points = _read(points, monitor)
    first = fit_click_frame(fit, points[fit.click], monitor)
    tracks = None
    if given.trajectories is not None and settings.use_trajectories:
        tracks = MaterialTracks(given.trajectories, given.frames, fit.model.surface, settings)
    motion, known = follow(fit, points, given.time_s, first, tracks, monitor, kept)
    sigma = typical_acceleration(motion, known, given.time_s, _loosest(fit))
    every = Recording(
        fit=fit,
        frames=given.frames,
        points=points,
        time_s=given.time_s,
        sigma=sigma,
        tracks=tracks,
        lengths=clicked_lengths(fit, near(points[fit.click], fit.parameters.state(motion[fit.click], first.vector)), first),
        feet=_standing(fit, motion, first.vector, given.time_s),
    )
    if len(points) <= AT_ONCE:
        return _at_once(every, motion, first.vector, monitor)
    return _in_stretches(every, motion, first.vector, monitor, kept)


def _read(points: Sequence[CloudPoints], monitor: Monitor) -> list[CloudPoints]:
    read = []
    for i in range(len(points)):
        monitor.step("thin the clouds", i, len(points))
        read.append(points[i])
    return read


def _at_once(every: Recording, motion: np.ndarray, vector: np.ndarray, monitor: Monitor) -> BodyFit:
    """All frames in one adjustment, from a motion (T, D) and a shape vector (S,)."""
    frames = range(len(motion))
    part, problem, (*_, solution) = _adjusted(every.stretch(frames, motion, vector), motion, vector, monitor)
    monitor.step(SIGMAS, 0, 3)
    factors = _factors(part, problem, solution)
    monitor.step(SIGMAS, 1, 3)
    covariance = _covariance(problem, solution, factors)
    monitor.step(SIGMAS, 2, 3)
    return _result(part, _looked(part, solution, covariance, frames), solution.vector, covariance[2], [Convergence.of(solution)])


def _adjusted(part: Recording, motion: np.ndarray, vector: np.ndarray, monitor: Monitor) -> tuple[Recording, Problem, list[Solution]]:
    """Postures and shape together; where the complete model was asked for, a second solution, and the recording comes back with it."""
    steps = part.fit.settings.sequence_steps
    problem = _whole_sequence(part)
    solution = solve(problem, motion, vector, steps=steps, monitor=monitor, stage="adjust the sequence")
    solutions = [_restarted(part.fit, part.points, part.time_s, solution, problem, monitor)]
    if part.fit.settings.balls == "complete":
        part = replace(part, fit=_completed(part.fit, solutions[0].vector))
        problem = _whole_sequence(part)
        solutions.append(
            solve(
                problem,
                solutions[0].motion,
                part.fit.parameters.vector(),
                steps=steps,
                scales=solutions[0].scales,
                monitor=monitor,
                stage="refine the complete model",
            )
        )
    return part, problem, solutions


def _in_stretches(every: Recording, motion: np.ndarray, vector: np.ndarray, monitor: Monitor, kept: Checkpoints | None) -> BodyFit:
    """As `_at_once`, with memory for `AT_ONCE` frames and two margins only.

    First the shape, from blocks of frames all over the recording: since a body differs from its model in every frame alike, more would not
    tell more of it. Then, with that shape held, the postures. Their covariances count what is not known of the shape.
    """
    found = ShapeResult.loaded(kept)
    if found is None:
        found = _shape_of_blocks(every, motion, vector, monitor)
        found.save(kept)
    if every.fit.settings.balls == "complete":
        every = replace(every, fit=_completed(every.fit, found.simplified))
    looked, ends = _postures(every, motion, found, monitor, kept)
    return _result(every, looked, found.vector, found.covariance, [found.ended, *ends])


def _shape_of_blocks(every: Recording, motion: np.ndarray, vector: np.ndarray, monitor: Monitor) -> ShapeResult:
    """The shape from some blocks of a motion (T, D)."""
    frames = sample(len(motion), every.fit.click)
    part, problem, solutions = _adjusted(every.stretch(frames, motion, vector), motion[frames], vector, monitor)
    last = solutions[-1]
    covariance = _covariance(problem, last, _factors(part, problem, last))[2]
    return ShapeResult(simplified=solutions[0].vector, vector=last.vector, covariance=covariance, ended=Convergence.of(last))


def _postures(
    every: Recording, motion: np.ndarray, shape: ShapeResult, monitor: Monitor, kept: Checkpoints | None
) -> tuple[FrameResults, list[Convergence]]:
    """The postures from a motion (T, D), with the shape held, stretch after stretch from the click frame on."""
    done, ends = dict[int, FrameResults](), list[Convergence]()
    behind, plan = dict[int, MarginalPriors](), outwards(len(motion), every.fit.click)
    for k, (own, around, direction) in enumerate(plan):
        stretch = StretchResult.loaded(kept, own, around)
        if stretch is None:
            told = monitor.part("adjust the postures", k, len(plan))
            stretch = _stretch(every, (own, around, direction), motion, shape, behind.get(direction, NOTHING_BEHIND), told)
            stretch.save(kept, own, around)
        done[own.start] = stretch.looked  # and no longer what it handed over, which takes as much again
        ends.append(stretch.ended)
        behind.update(stretch.behind)
    return joined([done.pop(start) for start in sorted(done)]), ends


def _stretch(
    every: Recording, place: tuple[range, range, int], motion: np.ndarray, shape: ShapeResult, behind: MarginalPriors, monitor: Monitor
) -> StretchResult:
    """One of `outwards`, from a motion (T, D) of all frames, with what the stretches behind handed over."""
    own, around, direction = place
    part = every.stretch(around, motion, shape.vector)
    problem = _whole_sequence(part, behind.known)
    held = replace(problem, free_shape=NO_SHAPE)
    solution = solve(held, motion[around], shape.vector, steps=part.fit.settings.sequence_steps, monitor=monitor)
    solution = _restarted(part.fit, part.points, part.time_s, solution, held, monitor)
    local, factors = range(own.start - around.start, own.stop - around.start), _factors(part, held, solution)
    covariance = _covariance(_whole_sequence(part, behind.honest), solution, factors, shape.covariance)
    told = partial(marginal_prior, problem, solution, local, time_s=part.time_s, sigma=part.sigma)
    ways = [way for way in ({1, -1} if direction == 0 else {direction}) if (own.stop < len(motion) if way > 0 else own.start > 0)]
    return StretchResult(
        looked=_looked(part, solution, covariance, local),
        ended=Convergence.of(solution),
        behind={
            way: MarginalPriors(
                known=told(beside=behind.known, ahead=way > 0), honest=told(beside=behind.honest, ahead=way > 0, understated=factors)
            )
            for way in ways
        },
    )


def _standing(fit: FitContext, motion: np.ndarray, vector: np.ndarray, time_s: np.ndarray) -> StandingFeet | None:
    """Which feet stand in a motion (T, D), if that is asked for."""
    if not fit.settings.floor:
        return None
    joints = np.stack([state.joints_m for state in fit.parameters.states(motion, vector)])
    return StandingFeet(joints, fit.model.skeleton.joint_names, time_s)


def _completed(fit: FitContext, vector: np.ndarray) -> FitContext:
    """The same conditions for the complete model of the body that was found (S,)."""
    shape = complete_shape(fit.parameters.shape(vector, np.full(len(vector), np.nan)))
    return replace(fit, parameters=ShapeParameters(shape, fit.settings.weights), settings=replace(fit.settings, radius_sigma=MUSCLE_SIGMA))


def conditions(given: FitInput, settings: FitSettings) -> FitContext:
    """What stays the same throughout the fit.

    Raises:
        InputError: see `fit_sequence`.
    """
    model = with_limits(read_model(given.model), given.limits, given.locked)
    names, frames = model.skeleton.joint_names, given.frames
    tracks, clicked, places = JointTracks(given, names), {}, {}
    for frame, joints in given.clicks.items():
        clicked[frames.index(frame)], places[frames.index(frame)] = read_clicks(given.rig, names, joints, settings.click_sigma_px)
    wanted = given.click_frame if given.click_frame in given.clicks else None
    begin = _best_known(places, tracks) if wanted is None else frames.index(wanted)
    known = tracks.located(begin)
    known = np.where(np.isfinite(places[begin]), places[begin], known) if begin in places else known
    clicks = enough(known, names, [*([clicked[begin]] if begin in clicked else []), *tracks.observe(begin)])
    priors = dof_priors(model.skeleton, np.radians(settings.limit_sigma_deg), np.nanmean(clicks.xyz_m, axis=0))
    shape = one_ball_shape(default_shape(model)) if settings.balls == "one" else default_shape(model)
    stature, stature_sigma = clicked_stature(ShapeParameters(shape), clicks, priors)
    shape = scaled_shape(shape, stature)
    parameters = ShapeParameters(shape, settings.weights)
    return FitContext(
        cameras=given.rig.cameras,
        model=model,
        parameters=parameters,
        settings=settings,
        clicks=clicks,
        click=begin,
        priors=priors,
        clicked=clicked,
        places=places,
        tracks=tracks,
        stature_sigma=stature_sigma,
        frames=1 if settings.balls == "one" else min(len(given.clouds), AT_ONCE),
        located=np.any([np.isfinite(xyz).all(axis=1) for xyz in (*places.values(), clicks.xyz_m)], axis=0),
        silhouettes=Silhouettes(given, model.surface, settings),
        empty=BackgroundRegions(given, parameters, settings),
        limbs=CollisionPairs(model.skeleton, shape.metaballs.bone_index),
    )


def _best_known(places: Mapping[int, np.ndarray], tracks: JointTracks) -> int:
    """The frame index with most clicked joints; without clicks, the one with most keypoints."""
    return max(places, key=lambda t: int(np.isfinite(places[t]).sum())) if places else tracks.best_frame()


def _loosest(fit: FitContext) -> np.ndarray:
    """The largest sigma (D,) of accelerations."""
    s, skeleton = fit.settings, fit.model.skeleton
    sigma = np.full(len(skeleton.dofs), np.radians(s.acceleration_deg_s2))
    sigma[skeleton.layout.group("base")] = s.acceleration_m_s2
    return sigma


def _whole_sequence(every: Recording, beside: MarginalPrior | None = None) -> Problem:
    """The adjustment of postures and shape, with what frames beside these say."""
    fit, points, feet = every.fit, every.points, every.feet
    priors = shared_over_time(fit.priors, every.time_s)

    held = SegmentationCache()

    def observe(t: int, state: BodyState) -> list[Observation]:
        return [
            *fit.surface_observations(t, points[t], state, held=held),
            *fit.joints(t),
            *fit.empty.observe(t),
            *priors,
            *fit.limbs.observe(state),
            *(feet.observe(t) if feet is not None else []),
        ]

    problem = fit.problem(observe, "shape", Acceleration(time_s=every.time_s, sigma=every.sigma))
    if beside is not None:
        problem = replace(problem, smoothness=Coupling(acceleration=Acceleration(time_s=every.time_s, sigma=every.sigma), beside=beside))
    return replace(
        problem,
        shape_observations=fit.shape_observations(every.lengths),
        shape_weight=_shared_weight(points, fit.settings),
        observe_step=None if every.tracks is None else every.tracks.steps,
    )


def _shared_weight(points: Sequence[CloudPoints], settings: FitSettings) -> float:
    """By how much T frames tell less of the shape than T times one frame: 1 for noise of the points alone, T for the model's error."""
    sigmas = np.concatenate([p.sigma_m for p in points])
    own = (float(np.median(sigmas)) if len(sigmas) else 0.0) ** 2 + 1e-12
    model, frames = settings.model_sigma_m**2, float(len(points))
    if settings.balls != "one":
        frames = min(frames, settings.shared_frames)
    return (own + frames * model) / (own + model)


def _restarted(
    fit: FitContext, points: Sequence[CloudPoints], time_s: np.ndarray, solution: Solution, problem: Problem, monitor: Monitor
) -> Solution:
    """The solution, or that from where frames with suspicious residuals stand between the others, if it explains more of those frames."""
    sigma0 = np.array([_sigma0(fit, t, p, solution) for t, p in enumerate(points)])
    strange = np.flatnonzero(_outlying(sigma0))
    good = np.setdiff1d(np.flatnonzero(np.isfinite(sigma0)), strange)
    if not len(strange) or not len(good) or not fit.settings.sequence_steps:
        return solution
    start = solution.motion.copy()
    start[strange] = np.stack([np.interp(time_s[strange], time_s[good], column) for column in start[good].T], axis=1)
    again = solve(
        problem,
        start,
        solution.vector,
        steps=fit.settings.sequence_steps,
        scales=solution.scales,
        monitor=monitor,
        stage="adjust the sequence",
    )
    more = sum(
        fit.support(t, points[t], again.motion[t], again.vector) - fit.support(t, points[t], solution.motion[t], solution.vector)
        for t in strange.tolist()
    )
    return again if more > 0 else solution


def _sigma0(fit: FitContext, t: int, points: CloudPoints, solution: Solution) -> float:
    """The robust scale of a frame's points, without points that of its outlines; NaN without either."""
    state = fit.parameters.state(solution.motion[t], solution.vector)
    residuals = [r for o in fit.surface_observations(t, points, state) if len(r := o.residual(state))]
    return robust_scale(residuals[0]) if residuals else np.nan


def _outlying(sigma0: np.ndarray) -> np.ndarray:
    """Which frames (T,) have suspicious residuals."""
    usual = np.nanmedian(sigma0) if np.isfinite(sigma0).any() else 1.0
    return np.asarray(np.nan_to_num(sigma0) > SUSPICIOUS * usual)


def _looked(part: Recording, solution: Solution, covariance: tuple[np.ndarray, np.ndarray, np.ndarray], frames: range) -> FrameResults:
    """What is told of some of the frames that were adjusted."""
    fit, points, (pose, mixed, shape) = part.fit, part.points, covariance
    skeleton = fit.model.skeleton
    n, J, B = len(frames), len(skeleton.joint_names), len(skeleton.bones)
    joints, joint_sigma = np.empty((n, J, 3)), np.empty((n, J))
    sigma0 = np.array([_sigma0(fit, t, points[t], solution) for t in frames])
    counts, outline = np.zeros((2, n, B), dtype=np.int64), [np.zeros(0)]
    for i, t in enumerate(frames):
        fit.monitor.check()
        state = fit.parameters.state(solution.motion[t], solution.vector)
        joints[i], A = state.joint_jacobian
        K = np.block([[pose[t], mixed[t]], [mixed[t].T, shape]])
        joint_sigma[i] = np.sqrt(np.einsum("jia,ab,jib->j", A, K, A, optimize=True) / 3)
        counts[0, i] = np.bincount(fit.surface(points[t], state).bone, minlength=B)
        counts[1, i] = fit.evidence(t, points[t], state)
        outline += [np.abs(rays.residual(state)) * rays.sigma_m for rays in fit.silhouettes.observe(t, state)]
    return FrameResults(
        values=solution.motion[frames],
        covariance=pose[frames],
        joints_m=joints,
        joint_sigma_m=joint_sigma,
        sigma0=sigma0,
        points=counts[0],
        evidence=counts[1],
        outline_m=np.concatenate(outline),
    )


def _result(every: Recording, looked: FrameResults, vector: np.ndarray, covariance: np.ndarray, ends: Sequence[Convergence]) -> BodyFit:
    """The body of all frames, with the shape vector (S,) of a covariance (S, S), and how the adjustments ended."""
    fit, skeleton = every.fit, every.fit.model.skeleton
    vector, covariance = smooth_radii(fit.parameters, vector, covariance, fit.settings.evenness_sigma)
    motion = BodyMotion(
        frames=np.array(every.frames),
        time_s=every.time_s,
        dof_names=skeleton.dof_names,
        values=looked.values,
        covariance=looked.covariance,
        joint_names=skeleton.joint_names,
        joints_m=looked.joints_m,
        joint_sigma_m=looked.joint_sigma_m,
        status=_statuses(fit, looked.evidence, looked.sigma0),
        sigma0=looked.sigma0,
    )
    return BodyFit(
        shape=fit.parameters.shape(vector, np.sqrt(np.diag(covariance))),
        motion=motion,
        iterations=max(end.iterations for end in ends),
        converged=all(end.converged for end in ends),
        points=looked.points,
        outline_m=looked.outline_m,
    )


def _covariance(
    problem: Problem, solution: Solution, understated: Scales, shape: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blocks of the covariance: pose (T, D, D), pose with shape (T, D, S), shape (S, S); the last may be given."""
    lin = linearise(problem, solution.motion, solution.vector, solution.scales, understated)
    pose, mixed, shape = lin.equations.covariance(shape)
    pose[:, problem.held] = pose[:, :, problem.held] = mixed[:, problem.held] = 0.0
    return pose, mixed, shape


def _factors(part: Recording, problem: Problem, solution: Solution) -> Scales:
    """By how much the variances of what was seen are understated."""
    found = variance_factors(problem, linearise(problem, solution.motion, solution.vector, solution.scales), solution.scales)
    own = [p.sigma_m for p in part.points if len(p.sigma_m)]
    wider = _wider(part.fit.settings, float(np.median(np.concatenate(own))) if own else 0.0)
    return replace(found, points=wider * found.points, contours=wider * found.contours, steps=wider * found.steps)


def _wider(settings: FitSettings, own_m: float) -> float:
    """By how much variances grow when the model's error is shared within `ERRORS_REACH_M`, and not only within the patches of the weights.

    What a limb differs from its metaballs it differs along much of it, and the frames after show the same.
    """
    own, model = own_m**2 + 1e-12, settings.model_sigma_m**2
    near, far = (max(1.0, (reach / settings.voxel_m) ** 2) for reach in (settings.model_patch_m, ERRORS_REACH_M))
    return max(1.0, (own + far * model) / (own + near * model))


def _statuses(fit: FitContext, counts: np.ndarray, sigma0: np.ndarray) -> tuple[str, ...]:
    enough = counts[:, free_bones(fit.parameters)] >= fit.settings.min_points
    total = counts.sum(axis=1)
    few = total < FEW_POINTS * max(float(np.median(total)), float(total[fit.click]))
    strange = few | _outlying(sigma0)
    return tuple(BRIDGED if not e.any() else SUSPECT if s else PARTIAL if not e.all() else FITTED for e, s in zip(enough, strange))
