"""Frame after frame, forwards and backwards from the click frame, with the shape held (D'Apuzzo et al. 1999, §3.3).

Each frame starts from the prediction 2θ_i − θ_{i−1}, which is also a weak observation; tracked points tie it to its neighbour. A frame
that explains far less than its neighbour is tried again from the neighbour's posture; one without points, outlines, clicks and keypoints
keeps the prediction, and the next is tried from both. A frame with clicks of its own is tried from where they lead, too, and if that is
better, so are the frames before it. A limb that nothing shows (hidden behind another) comes to rest in its prediction,
and is looked for in a wider and wider gate, so that it is found where it comes out.

How far following the body frame after frame has come: all that the next frame depends on, to be kept so that a killed fit goes on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..inputs.cloud_points import CloudPoints
from ..inputs.material_tracks import MaterialTracks
from ..observations import Observation, PosePrior, StepsFromFixed
from ..segmentation import SegmentationCache, crop
from ..solve.solver import Solution, solve
from ..state import BodyState, free_bones
from .hidden_limbs import reacquired_poses
from .inverse_kinematics import pose_as_clicked, shared_over_time

CHECKPOINT_EVERY = 25  # frames: some seconds of work


class Checkpoints(Protocol):
    """Where a fit keeps its work, each part by its name, under a key of all that it depends on."""

    def load(self, name: str) -> Mapping[str, np.ndarray] | None:
        """What was kept under a name, if anything was."""

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep this under a name, instead of what was."""


@dataclass(kw_only=True)
class PoseTrackingState:
    """What is known of T frames with D degrees of freedom and B bones, when `done` of them are done."""

    motion: np.ndarray  # (T, D)
    known: np.ndarray  # (T, D) where each DOF was seen
    unseen: np.ndarray  # (B,) for how many frames each bone was not
    seen: list[int]  # frames of this direction that were found
    support: float | None = None  # of the last of them
    done: int = 1

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays to be kept; unknown support is NaN."""
        support = np.nan if self.support is None else self.support
        return {
            "motion": self.motion,
            "known": self.known,
            "unseen": self.unseen,
            "seen": np.array(self.seen, dtype=np.int64),
            "support": np.array([support]),
            "done": np.array([self.done]),
        }

    def goes_on(self, kept: Mapping[str, np.ndarray] | None) -> "PoseTrackingState":
        """What was kept, if it is of these frames, else this."""
        mine, other = ({n: a.shape for n, a in table.items() if n != "seen"} for table in (self.arrays(), kept or {}))
        if kept is None or mine != other:
            return self
        support = float(kept["support"][0])
        return PoseTrackingState(
            motion=kept["motion"].copy(),
            known=kept["known"].copy(),
            unseen=kept["unseen"].copy(),
            seen=kept["seen"].tolist(),
            support=None if np.isnan(support) else support,
            done=int(kept["done"][0]),
        )


LOST_SUPPORT = 0.6  # a frame with a smaller share of its neighbour's support is tried again
COASTING = 5  # after so many frames without points the prediction stands still
REACH_M = 0.20  # of the points looked at in one frame
MOST_POINTS = 1000  # of a frame: enough for a start of the adjustment over the sequence
SLOWING = 0.7  # per frame, of what is not seen
STAGE = "fit frame after frame"
WIDENING, WIDEST = 0.25, 4.0  # of the gate of a limb that is not seen: per frame, and at most


def follow(
    fit: FitContext,
    points: Sequence[CloudPoints],
    time_s: np.ndarray,
    first: Solution,
    tracks: MaterialTracks | None,
    monitor: Monitor,
    kept: Checkpoints | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Motion (T, D) of all frames, and where each DOF (T, D) was seen."""
    fit, T = replace(fit, priors=shared_over_time(fit.priors, time_s)), len(points)  # the frame before has said them already
    motion = np.full((T, first.motion.shape[1]), np.nan)
    motion[fit.click] = first.motion[0]
    at_click = _unseen(fit, fit.click, points[fit.click], first.motion[0], first.vector, np.zeros(len(fit.model.skeleton.bones)))
    way = PoseTrackingState(motion=motion, known=np.ones(motion.shape, dtype=bool), unseen=at_click, seen=[fit.click])
    way = way.goes_on(kept.load("way") if kept else None)
    ahead, back = [(t, 1) for t in range(fit.click + 1, T)], [(t, -1) for t in range(fit.click - 1, -1, -1)]
    for t, direction in [*ahead, *back][way.done - 1 :]:
        part = monitor.part(STAGE, way.done, T)
        part.step(STAGE, 0, 1)
        if t == fit.click + direction:
            way.support, way.seen, way.unseen = None, [fit.click], at_click
        _step(fit, way, t, direction, points, time_s, first, tracks, part)
        way.done += 1
        if kept is not None and way.done % CHECKPOINT_EVERY == 0:
            kept.save("way", way.arrays())
    if tracks is not None:
        tracks.forget()  # a fit that went on from a checkpoint knows less of them
    return way.motion, way.known


def _step(
    fit: FitContext,
    way: PoseTrackingState,
    t: int,
    direction: int,
    all_points: Sequence[CloudPoints],
    time_s: np.ndarray,
    first: Solution,
    tracks: MaterialTracks | None,
    monitor: Monitor,
) -> None:
    """The posture of frame t from that of the frame before; those before it too, where a click in t tells that they were wrong."""
    motion, seen, points = way.motion, way.seen, all_points[t]
    before = fit.parameters.state(motion[t - direction], first.vector)
    moved = _from_neighbour(tracks, t, before, direction) if seen[-1] == t - direction else []
    near = _some(crop(points, before, _reach(fit, before)))
    predictions = _predictions(motion, time_s, seen, t, np.where(_came_out(way.known, seen), 0.0, _slowing(fit, way.unseen)))
    wide = 1 + np.minimum(WIDENING * way.unseen, WIDEST - 1)
    motion[t], found = _next_posture(fit, t, near, moved, predictions, first, way.support, wide, monitor)
    if t in fit.places:
        _mend(fit, way, t, direction, all_points, first, monitor)
    way.known[t] = False
    if found is not None:
        way.support = found
        seen.append(t)
        way.unseen = _unseen(fit, t, near, motion[t], first.vector, way.unseen)
        way.known[t] = _slowing(fit, way.unseen) == 1


def _mend(
    fit: FitContext, way: PoseTrackingState, clicked: int, direction: int, points: Sequence[CloudPoints], first: Solution, monitor: Monitor
) -> None:
    """From a clicked frame back over those before it, as long as what comes from there is better than what was found."""
    motion, wide = way.motion, np.ones(len(fit.model.skeleton.bones))
    for t in range(clicked - direction, fit.click, -direction):
        if t in fit.places:
            return
        after = fit.parameters.state(motion[t + direction], first.vector)
        near = _some(crop(points[t], after, _reach(fit, after)))
        posture, _ = _next_posture(fit, t, near, [], [motion[t + direction]], first, None, wide, monitor)
        if fit.score(t, near, posture, first.vector) <= fit.score(t, near, motion[t], first.vector) + fit.settings.min_points / 4:
            return
        motion[t] = posture


def _reach(fit: FitContext, state: BodyState) -> np.ndarray:
    """How far from each bone (B,) points are looked at: about a limb, as far as what hangs on it may have swung."""
    hanging = state.skeleton.ancestors.T @ state.lengths_m
    return np.where(free_bones(fit.parameters) & (state.skeleton.parents >= 0), np.maximum(hanging, REACH_M), REACH_M)


def _some(points: CloudPoints) -> CloudPoints:
    """Not more than `MOST_POINTS`, evenly from the order of the voxels."""
    return points.take(np.arange(0, len(points.xyz_m), 1 + (len(points.xyz_m) - 1) // MOST_POINTS)) if len(points.xyz_m) else points


def _unseen(fit: FitContext, t: int, points: CloudPoints, motion: np.ndarray, vector: np.ndarray, before: np.ndarray) -> np.ndarray:
    """For how many frames each bone (B,) was not seen well enough; 0 for those whose posture the model believes firmly."""
    few = fit.evidence(t, points, fit.parameters.state(motion, vector)) < fit.settings.min_points / 2
    return np.where(few & free_bones(fit.parameters), before + 1, 0)


def _slowing(fit: FitContext, unseen: np.ndarray) -> np.ndarray:
    """Factor (D,) of the predicted change of every DOF: less than 1 where none of the bones that it moves is seen."""
    moved, free = fit.model.skeleton.moved_by, free_bones(fit.parameters)
    seen = ((unseen == 0) & free)[:, None] & moved
    return np.where(seen.any(axis=0) | ~(free[:, None] & moved).any(axis=0), 1.0, SLOWING)


def _came_out(known: np.ndarray, seen: list[int]) -> np.ndarray:
    """Which DOFs (D,) were seen in the last frame but not in the one before: the change says how wrong the prediction was, not how fast."""
    return known[seen[-1]] & ~known[seen[-2]] if len(seen) > 1 else np.zeros(known.shape[1], dtype=bool)


def _predictions(motion: np.ndarray, time_s: np.ndarray, seen: list[int], t: int, slowing: np.ndarray) -> list[np.ndarray]:
    last = motion[seen[-1]]
    if len(seen) < 2 or abs(t - seen[-1]) > COASTING:
        return [last]
    rate = slowing * (last - motion[seen[-2]]) / (time_s[seen[-1]] - time_s[seen[-2]])
    return [last + rate * (time_s[t] - time_s[seen[-1]]), last]


def _from_neighbour(tracks: MaterialTracks | None, t: int, before: BodyState, direction: int) -> list[StepsFromFixed]:
    """What tracked points say about frame t, when the neighbour's body is held."""
    if tracks is None:
        return []
    steps = tracks.steps(t - 1, before, None) if direction > 0 else tracks.steps(t, None, before)
    return [] if steps is None else [StepsFromFixed(steps=steps, other=before, backwards=direction < 0)]


def _next_posture(
    fit: FitContext,
    i: int,
    points: CloudPoints,
    moved: list[StepsFromFixed],
    predictions: list[np.ndarray],
    first: Solution,
    last_support: float | None,
    wide: np.ndarray,
    monitor: Monitor,
) -> tuple[np.ndarray, float | None]:
    """The posture (D,) of frame index `i` and its support; None if the frame shows too little, and the posture is the prediction."""
    s, skeleton = fit.settings, fit.model.skeleton
    sigma = np.full(len(skeleton.dofs), np.radians(s.prediction_sigma_deg))
    sigma[skeleton.layout.group("base")] = s.prediction_sigma_m
    best, best_support, best_score = predictions[0], -1.0, -np.inf

    def adjusted(start: np.ndarray) -> tuple[np.ndarray, float, float]:
        prior, held = PosePrior(mean=start, sigma=sigma), SegmentationCache()

        def observe(t: int, state: BodyState, prior: PosePrior = prior, held: SegmentationCache = held) -> list[Observation]:
            return [
                *fit.surface_observations(i, points, state, wide, held),
                *fit.joints(i),
                *fit.empty.observe(i),
                *moved,
                prior,
                *fit.pose_observations(state),
            ]

        solution = solve(fit.problem(observe), start[None], first.vector, steps=s.frame_steps, scales=first.scales, monitor=monitor)
        found = solution.motion[0], first.vector
        return found[0], fit.support(i, points, *found), fit.score(i, points, *found)

    for start in predictions:
        posture, support, score = adjusted(start)
        if score > best_score:
            best, best_support, best_score = posture, support, score
        if last_support is None or best_support > LOST_SUPPORT * last_support:
            break
    if i in fit.places:
        posture, support, score = adjusted(pose_as_clicked(fit.parameters, fit.places[i], best, first.vector))
        if score > best_score:
            best, best_support, best_score = posture, support, score
    for start in reacquired_poses(fit, points, best, first.vector, monitor):
        posture, support, score = adjusted(start)
        if score > best_score + s.min_points / 4:
            best, best_support, best_score = posture, support, score
    return (best, best_support) if best_support >= s.min_points or fit.joints(i) else (predictions[0], None)
