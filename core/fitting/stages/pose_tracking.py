"""Pose tracking: frame after frame, forwards and backwards from the click frame, with a fixed shape (D'Apuzzo et al. 1999, §3.3).

    θ_t⁰ = θ_i + d (θ_i − θ_j) (τ_t − τ_i) / (τ_i − τ_j)                                                  (1)

predicts the pose of frame t from the last two tracked frames i and j at the times τ (constant velocity: 2θ_i − θ_j for equal times); the
prediction is the start of the adjustment and a weak prior. Tracked points tie the frame to its neighbour. The first frame has no velocity:
it is started from the click frame's pose, and from that moved as the middle of the cloud moved. Where the prediction explains far less than
the neighbour's pose did, the frame is also started from the neighbour's pose; without points, outlines, clicks and keypoints it gets the
prediction. A frame with clicks is also started from the clicked pose, and if that is better, it corrects the frames before it, too. The
predicted velocity of an occluded limb is damped by d, and its gate widens with every frame, until the limb reappears.

`PoseTrackingState` is all that the next frame depends on; it is stored so that an interrupted fit resumes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..inputs.cloud_points import CloudPoints
from ..inputs.material_tracks import PointTracks
from ..observations import Observation, PosePrior, StepsFromFixed
from ..segmentation import SegmentationCache, crop
from ..solve.problem import Estimate
from ..solve.solver import Solution, solve
from ..state import BodyState, free_bones
from .hidden_limbs import reacquired_poses
from .inverse_kinematics import pose_as_clicked, shared_over_time

CHECKPOINT_EVERY = 25  # frames: some seconds of work
LARGEST_LOSS = 5.0  # of the support, by which another place of a limb may explain fewer points: outlines alone show too little
LOST_SUPPORT = 0.6  # a frame with a smaller share of its neighbour's support is also started from its neighbour's pose
LONGEST_PREDICTION = 5  # frames without a tracked pose; after more the prediction is the last pose
REACH_M = 0.20  # of the points that take part in one frame
MOST_POINTS = 1000  # of a frame: enough for a start of the adjustment over the sequence
DAMPING = 0.7  # d of (1), of DOFs that nothing constrains, per frame
GATE_GROWTH, LARGEST_GATE = 0.25, 4.0  # of the gate of an occluded limb: per frame, and the largest factor
STAGE = "fit frame after frame"
CHECKPOINT = "pose_tracking"


class Checkpoints(Protocol):
    """Where a fit stores its intermediate results, each under a name; they are valid for one input and one set of settings."""

    def load(self, name: str) -> Mapping[str, np.ndarray] | None:
        """The arrays under a name, if there are any."""

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Store arrays under a name, replacing earlier ones."""


@dataclass(kw_only=True)
class PoseTrackingState:
    """T frames with D degrees of freedom and B bones, of which `done` frames are done."""

    motion: np.ndarray  # (T, D)
    observed: np.ndarray  # (T, D) where observations constrain each DOF
    unobserved_for: np.ndarray  # (B,) for how many frames each bone has had too few points
    tracked: list[int]  # frames in this direction whose pose was found
    support: float | None = None  # of the last of them
    done: int = 1

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays, for a checkpoint; a missing support is NaN."""
        support = np.nan if self.support is None else self.support
        return {
            "motion": self.motion,
            "observed": self.observed,
            "unobserved_for": self.unobserved_for,
            "tracked": np.array(self.tracked, dtype=np.int64),
            "support": np.array([support]),
            "done": np.array([self.done]),
        }

    def resumed(self, checkpoint: Mapping[str, np.ndarray] | None) -> "PoseTrackingState":
        """The state in a checkpoint, if it is of these frames, else this one."""
        own, other = ({n: a.shape for n, a in table.items() if n != "tracked"} for table in (self.arrays(), checkpoint or {}))
        if checkpoint is None or own != other:
            return self
        support = float(checkpoint["support"][0])
        return PoseTrackingState(
            motion=checkpoint["motion"].copy(),
            observed=checkpoint["observed"].copy(),
            unobserved_for=checkpoint["unobserved_for"].copy(),
            tracked=checkpoint["tracked"].tolist(),
            support=None if np.isnan(support) else support,
            done=int(checkpoint["done"][0]),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseTracking:
    """What pose tracking works from: T frames, and the body of the click frame."""

    fit: FitContext
    points: Sequence[CloudPoints]  # T
    time_s: np.ndarray  # (T,)
    first: Solution  # of the click frame
    tracks: PointTracks | None

    def state(self, pose: np.ndarray) -> BodyState:
        """The body in a pose (D,)."""
        return self.fit.parameters.state(pose, self.first.vector)

    def score(self, t: int, points: CloudPoints, pose: np.ndarray) -> float:
        """`FitContext.score` of a pose (D,)."""
        return self.fit.score(t, points, pose, self.first.vector)


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetPose:
    """Frame `index`, whose pose is wanted: its observations, and where the search starts."""

    index: int
    points: CloudPoints
    starts: list[np.ndarray]  # (D,) each, the prediction first
    from_neighbour: list[StepsFromFixed]  # tracked points, with the neighbour's body fixed
    neighbour_support: float | None
    gate_scale: np.ndarray  # (B,)


def track_poses(given: PoseTracking, monitor: Monitor, checkpoints: Checkpoints | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Motion (T, D) of all frames, and where observations constrain each DOF (T, D)."""
    given = replace(given, fit=replace(given.fit, priors=shared_over_time(given.fit.priors, given.time_s)))
    fit, T = given.fit, len(given.points)
    motion = np.full((T, given.first.motion.shape[1]), np.nan)
    motion[fit.click] = given.first.motion[0]
    at_click = _unobserved_for(given, fit.click, given.points[fit.click], motion[fit.click], np.zeros(len(fit.model.skeleton.bones)))
    state = PoseTrackingState(motion=motion, observed=np.ones(motion.shape, dtype=bool), unobserved_for=at_click, tracked=[fit.click])
    state = state.resumed(checkpoints.load(CHECKPOINT) if checkpoints else None)
    ahead, back = [(t, 1) for t in range(fit.click + 1, T)], [(t, -1) for t in range(fit.click - 1, -1, -1)]
    for t, direction in [*ahead, *back][state.done - 1 :]:
        part = monitor.part(STAGE, state.done, T)
        part.step(STAGE, 0, 1)
        if t == fit.click + direction:
            state.support, state.tracked, state.unobserved_for = None, [fit.click], at_click
        _track(given, state, t, direction, part)
        state.done += 1
        if checkpoints is not None and state.done % CHECKPOINT_EVERY == 0:
            checkpoints.save(CHECKPOINT, state.arrays())
    if given.tracks is not None:
        given.tracks.forget()  # a resumed fit has fewer of the segmentations
    return state.motion, state.observed


def _track(given: PoseTracking, state: PoseTrackingState, t: int, direction: int, monitor: Monitor) -> None:
    """Find the pose of frame t from that of the frame before; correct the frames before it where a click in t shows a better pose."""
    fit, motion, tracked = given.fit, state.motion, state.tracked
    before = given.state(motion[t - direction])
    near = _near(given, t, before)
    damping = np.where(_reappeared(state.observed, tracked), 0.0, _damping(fit, state.unobserved_for))
    target = TargetPose(
        index=t,
        points=near,
        starts=_predictions(motion, given.time_s, tracked, t, damping)
        if len(tracked) > 1
        else _without_velocity(given, motion, tracked[-1], near),
        from_neighbour=_from_neighbour(given.tracks, t, before, direction) if tracked[-1] == t - direction else [],
        neighbour_support=state.support,
        gate_scale=1 + np.minimum(GATE_GROWTH * state.unobserved_for, LARGEST_GATE - 1),
    )
    motion[t], support = _pose(given, target, monitor)
    if t in fit.places:
        _correct_backwards(given, motion, t, direction, monitor)
    state.observed[t] = False
    if support is not None:
        state.support = support
        tracked.append(t)
        state.unobserved_for = _unobserved_for(given, t, near, motion[t], state.unobserved_for)
        state.observed[t] = _damping(fit, state.unobserved_for) == 1


def _correct_backwards(given: PoseTracking, motion: np.ndarray, clicked: int, direction: int, monitor: Monitor) -> None:
    """From a clicked frame back over those before it, as long as the pose found from there is better."""
    fit = given.fit
    for t in range(clicked - direction, fit.click, -direction):
        if t in fit.places:
            return
        target = _alone(given, t, motion[t + direction])
        pose, _ = _pose(given, target, monitor)
        if given.score(t, target.points, pose) <= given.score(t, target.points, motion[t]) + fit.least_gain:
            return
        motion[t] = pose


def _near(given: PoseTracking, t: int, state: BodyState) -> CloudPoints:
    """The points of frame t that take part where the body is about in a state."""
    return _subsampled(crop(given.points[t], state, _reach(given.fit, state)))


def _without_velocity(given: PoseTracking, motion: np.ndarray, last: int, points: CloudPoints) -> list[np.ndarray]:
    """The pose of frame `last`, and the same moved as the middle of the body's points."""
    own, moved = _near(given, last, given.state(motion[last])).xyz_m, motion[last].copy()
    if not len(own) or not len(points.xyz_m):
        return [motion[last]]
    moved[given.fit.model.skeleton.layout.group("base")] += np.median(points.xyz_m, axis=0) - np.median(own, axis=0)
    return [motion[last], moved]


def _reach(fit: FitContext, state: BodyState) -> np.ndarray:
    """How far from each bone (B,) points take part: for a limb as far as its outer bones may have swung."""
    outer = state.skeleton.ancestors.T @ state.lengths_m
    return np.where(free_bones(fit.parameters) & (state.skeleton.parents >= 0), np.maximum(outer, REACH_M), REACH_M)


def _subsampled(points: CloudPoints) -> CloudPoints:
    """Not more than `MOST_POINTS`, evenly from the order of the voxels."""
    return points.take(np.arange(0, len(points.xyz_m), 1 + (len(points.xyz_m) - 1) // MOST_POINTS)) if len(points.xyz_m) else points


def _unobserved_for(given: PoseTracking, t: int, points: CloudPoints, pose: np.ndarray, before: np.ndarray) -> np.ndarray:
    """For how many frames each bone (B,) has had too few points; 0 for those with a firm prior of their pose."""
    few = given.fit.evidence(t, points, given.state(pose)) < given.fit.few_points
    return np.where(few & free_bones(given.fit.parameters), before + 1, 0)


def _damping(fit: FitContext, unobserved_for: np.ndarray) -> np.ndarray:
    """d (D,) of (1): less than 1 where none of the bones that a DOF moves is observed."""
    moved, free = fit.model.skeleton.moved_by, free_bones(fit.parameters)
    observed = ((unobserved_for == 0) & free)[:, None] & moved
    return np.where(observed.any(axis=0) | ~(free[:, None] & moved).any(axis=0), 1.0, DAMPING)


def _reappeared(observed: np.ndarray, tracked: list[int]) -> np.ndarray:
    """Which DOFs (D,) were observed in the last frame but not in the one before: their change is the prediction's error, no velocity."""
    return observed[tracked[-1]] & ~observed[tracked[-2]] if len(tracked) > 1 else np.zeros(observed.shape[1], dtype=bool)


def _predictions(motion: np.ndarray, time_s: np.ndarray, tracked: list[int], t: int, damping: np.ndarray) -> list[np.ndarray]:
    """The prediction of frame t, and the last pose."""
    last = motion[tracked[-1]]
    if len(tracked) < 2 or abs(t - tracked[-1]) > LONGEST_PREDICTION:
        return [last]
    rate = damping * (last - motion[tracked[-2]]) / (time_s[tracked[-1]] - time_s[tracked[-2]])
    return [last + rate * (time_s[t] - time_s[tracked[-1]]), last]  # (1)


def _from_neighbour(tracks: PointTracks | None, t: int, before: BodyState, direction: int) -> list[StepsFromFixed]:
    """The observations of frame t by tracked points, with the neighbour's body fixed."""
    if tracks is None:
        return []
    found = tracks.from_fixed(t - 1 if direction > 0 else t, before, direction < 0)
    return [] if found is None else [found]


def _pose(given: PoseTracking, target: TargetPose, monitor: Monitor) -> tuple[np.ndarray, float | None]:
    """The pose (D,) of a frame and its support; the prediction and None if the frame has too few observations."""
    fit, i = given.fit, target.index
    best, best_support, best_score = target.starts[0], -1.0, -np.inf
    for start in target.starts:
        pose, support, score = _adjusted(given, target, start, monitor)
        if score > best_score + fit.least_gain:
            best, best_support, best_score = pose, support, score
        if target.neighbour_support is not None and best_support > LOST_SUPPORT * target.neighbour_support:
            break
    if i in fit.places:
        clicked = pose_as_clicked(fit.parameters, fit.places[i], best, given.first.vector)
        pose, support, score = _adjusted(given, target, clicked, monitor)
        if score > best_score:
            best, best_support, best_score = pose, support, score
    for start in reacquired_poses(fit, i, target.points, best, given.first.vector, monitor):
        pose, support, score = _adjusted(given, target, start, monitor)
        if score > best_score + fit.least_gain and support > best_support - LARGEST_LOSS:
            best, best_support, best_score = pose, support, score
    followed = sum(steps.size for steps in target.from_neighbour) if fit.in_views is not None else 0
    seen = max(best_support, followed) >= fit.settings.min_points or fit.joints(i)
    return (best, best_support) if seen else (target.starts[0], None)


def _adjusted(given: PoseTracking, target: TargetPose, start: np.ndarray, monitor: Monitor) -> tuple[np.ndarray, float, float]:
    """The pose (D,) adjusted from a start (D,), its support and its score."""
    fit, i, points, vector = given.fit, target.index, target.points, given.first.vector
    prior, cache = PosePrior(mean=start, sigma=_prediction_sigma(fit)), SegmentationCache()

    def observe(t: int, state: BodyState) -> list[Observation]:
        return [
            *fit.surface_observations(i, points, state, target.gate_scale, cache),
            *fit.joints(i),
            *fit.background.observe(i),
            *target.from_neighbour,
            prior,
            *fit.pose_observations(state),
        ]

    begin = Estimate(motion=start[None], vector=vector, scales=given.first.scales)
    pose = solve(fit.problem(observe), begin, steps=fit.settings.frame_steps, monitor=monitor).motion[0]
    support = fit.support(i, points, pose, vector)
    return pose, support, fit.score(i, points, pose, vector, support)


def _alone(given: PoseTracking, t: int, start: np.ndarray) -> TargetPose:
    """Frame t without its neighbours, with the points that are near in a pose (D,)."""
    fit, state = given.fit, given.state(start)
    near = _subsampled(crop(given.points[t], state, _reach(fit, state)))
    ones = np.ones(len(fit.model.skeleton.bones))
    return TargetPose(index=t, points=near, starts=[start], from_neighbour=[], neighbour_support=None, gate_scale=ones)


def _prediction_sigma(fit: FitContext) -> np.ndarray:
    """(D,) of (1)."""
    sigma = np.full(len(fit.model.skeleton.dofs), np.radians(fit.settings.prediction_sigma_deg))
    sigma[fit.model.skeleton.layout.group("base")] = fit.settings.prediction_sigma_m
    return sigma
