"""The way of each limb through the recording: many poses per frame, several ways at once, and the best one in the end.

    cost_k(t) = min_j [cost_j(t − 1) + min(|X_k − X̂_j|² / 2σ², LARGEST_JUMP)] − gain_k / GAIN                 (1)

k are poses of the limb in frame t: those of the ways so far, kept and continued, others near them, and poses all over the joints' range
(Halton 1960), improved where they explain most (`explained.limb_gains`). X are the ends of the limb's bones, X̂_j those predicted from way
j with damped velocity, σ grows with the time between the frames. The best `WAYS` poses that differ go on (beam search; Viterbi 1967). The
trunk stays as it was tracked: it is large and hardly ever lost. What is visible of a limb later thus decides where it went before. Where
the best way differs from the tracked poses, it replaces them only if its cost is lower by `LEAST_BETTER`. A limb is followed from the frame
where the fit begins, and stays there as it was found; one that is not certain there (`FitContext.unsure`) is followed from the first frame
to the last, and may begin anywhere.

Before that, a limb that had no measured points for some frames is turned evenly from the frame before to the frame after, and followed from
both, forwards and backwards, to where two ways meet best; what is better stays. A way that only goes forwards drifts while nothing is seen,
and so does tracking; from there the adjustment would pull along the frames in which the limb is seen again.
"""

from dataclasses import dataclass, replace

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..explained import Evidence, limb_gains
from ..limb import Limb, limbs_of, whole_limbs
from ..segmentation import segment
from .pose_tracking import PoseTracking

STAGE = "follow the limbs"
WAYS = 8
NEAR_WAYS = 4  # of the ways, around which poses are tried
AROUND, AROUND_RAD = 24, float(np.radians(22.0))  # poses around each
ANYWHERE, ANYWHERE_RAD = 400, np.pi
IMPROVED, IMPROVED_RAD, IMPROVEMENTS = 6, float(np.radians(12.0)), 24  # of the best poses, spread and number of those tried around each
DIFFERENT_M = 0.04  # between the ends of two poses that go on
GAIN = 10.0  # voxels that weigh as much as a probability ratio of e
SIGMA_M, ACCELERATION_M_S2 = 0.02, 40.0  # σ = SIGMA_M + ACCELERATION_M_S2 Δt²
HANDS = 0.01, 8.0  # … of hands, against their arms
LARGEST_JUMP = 14.0
VELOCITY_KEPT = 0.8
COARSE_M, FINE_M = 0.03, 0.02  # widths of the weights
REPLACED_M = 0.05  # a tracked pose whose limb ends are nearer to the way stays
LEAST_BETTER = 1.5  # a frame, by which the cost of a way must be lower than that of the tracked poses that it replaces

Way = list[tuple[int, np.ndarray, np.ndarray]]  # frames, with the angles (C,) of a limb and the ends (E, 3) of its bones


@dataclass(frozen=True, eq=False, kw_only=True)
class _Ways:
    """K ways of one limb up to a frame."""

    angles: np.ndarray  # (K, C)
    ends_m: np.ndarray  # (K, E, 3)
    velocity_m_s: np.ndarray  # (K, E, 3)
    rate: np.ndarray  # (K, C) of the angles
    cost: np.ndarray  # (K,)
    before: np.ndarray  # (K,) the way in the frame before that each continues


def follow_limbs(given: PoseTracking, motion: np.ndarray, monitor: Monitor) -> np.ndarray:
    """The motion (T, D) with the limbs on their best ways from the click frame; the same where no background is known.

    Raises:
        Cancelled: the user asked to stop.
    """
    given = replace(given, fit=replace(given.fit, silhouettes=given.fit.silhouettes.anew()))  # a resumed fit has others
    motion, fit = motion.copy(), given.fit
    if not fit.background.known or not fit.settings.search_limbs:
        return motion
    limbs, points = limbs_of(fit.parameters).values(), _points_of_bones(given, motion)
    for i, limb in enumerate(limbs):
        stretches = _stretches(points[:, limb.bones].sum(axis=1) >= fit.settings.min_points)
        for k, frames in enumerate(stretches):
            part = monitor.part(STAGE, i * len(stretches) + k, 2 * len(limbs) * len(stretches))
            _put(given, motion, limb, _even(given, motion, limb, frames), anchored=True)
            _put(given, motion, limb, _meeting(given, motion, limb, frames, part), anchored=True)
    begins = [(limb, _begin(fit, limb)) for limb in whole_limbs(fit.parameters)]
    runs = [(limb, begin, course) for limb, begin in begins for course in _courses(begin, len(motion)) if len(course) > 1]
    for i, (limb, begin, course) in enumerate(runs):
        part = monitor.part(STAGE, len(runs) + i, 2 * len(runs))
        _put(given, motion, limb, best_way(given, motion, limb, course, begin is None, part))
    return motion


def _put(given: PoseTracking, motion: np.ndarray, limb: Limb, way: Way, *, anchored: bool = False) -> None:
    """Put a limb on its way in a motion (T, D), where that is better."""
    for t, angles in _better(given, motion, limb, way, anchored=anchored).items():
        motion[t, limb.columns] = angles


def _better(given: PoseTracking, motion: np.ndarray, limb: Limb, way: Way, anchored: bool = False) -> dict[int, np.ndarray]:
    """The limb's angles (C,) by frame, where its way differs from a motion (T, D) and costs less, stretch after stretch.

    Where nothing is visible of a limb, its way follows accidental evidence, while tracking has predicted it. That a way is more even,
    however, is no accident where it is `anchored` in what is seen at both ends.
    """
    angles, tracked = {t: a for t, a, _ in way}, limb.ends(motion, given.first.vector)
    by_way = tracked.copy()
    for t, _, ends in way:
        by_way[t] = ends
    apart = [t for t in angles if np.linalg.norm(by_way[t] - tracked[t], axis=1).max() > REPLACED_M]
    found = dict[int, np.ndarray]()
    frames = np.array(sorted(apart), dtype=np.intp)
    for stretch in np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1):
        if not len(stretch):
            continue
        gain = sum(gain_by_way(given, int(t), motion[t], limb, angles[int(t)]) for t in stretch)
        around = np.arange(max(stretch[0] - 2, 0), min(stretch[-1] + 3, len(motion)))
        replaced = np.where(np.isin(around, stretch)[:, None, None], by_way[around], tracked[around])
        smoother = _unevenness(limb, tracked[around], given.time_s[around]) - _unevenness(limb, replaced, given.time_s[around])
        evener = anchored and smoother + min(gain, 0.0) / GAIN > LEAST_BETTER
        if evener or gain / GAIN + smoother > LEAST_BETTER * len(stretch):
            found.update({int(t): angles[int(t)] for t in stretch})
    return found


def _unevenness(limb: Limb, ends_m: np.ndarray, time_s: np.ndarray) -> float:
    """What (1) costs a limb whose ends (T, E, 3) move in this way, apart from what it explains."""
    cost, velocity = 0.0, np.zeros_like(ends_m[0])
    for before, now, step_s in zip(ends_m, ends_m[1:], np.diff(time_s)):
        away = float(unlikely(limb, now - before - VELOCITY_KEPT * step_s * velocity, float(step_s)))
        cost += min(away, LARGEST_JUMP)
        velocity = (now - before) / step_s if away <= LARGEST_JUMP else np.zeros_like(now)
    return cost


def unlikely(limb: Limb, apart_m: np.ndarray, step_s: float) -> np.ndarray:
    """|X − X̂|² / 2σ² of (1) (...,) for differences (..., E, 3) of a limb's ends after a time."""
    least, acceleration = (SIGMA_M, ACCELERATION_M_S2) if limb.hand is None else HANDS
    sigma = least + acceleration * step_s**2
    return np.asarray((apart_m**2).sum(axis=(-2, -1)) / (2 * sigma**2))


def gain_by_way(given: PoseTracking, t: int, pose: np.ndarray, limb: Limb, angles: np.ndarray) -> float:
    """How much more a limb explains with other angles (C,) than in a pose (D,) of frame index `t`, in voxels."""
    near = given.fit.seen(t, given.points[t]).near(limb, given.state(pose))
    poses = limb.poses(pose, np.stack([pose[limb.columns], angles]))
    before, by_way = limb_gains(near, limb, poses, given.first.vector, FINE_M)
    return float(by_way - before)


def _begin(fit: FitContext, limb: Limb) -> int | None:
    """The frame index from which a limb is followed: where the fit begins, or for a limb that is not certain there, where it was clicked
    next; None if it is certain nowhere."""
    names = [fit.model.skeleton.bones[bone].tail_joint for bone in limb.bones.tolist()]
    if not set(names) & set(fit.unsure):
        return fit.click
    rows = [fit.model.skeleton.joint_names.index(name) for name in names]
    clicked = [t for t, clicks in fit.clicked.items() if np.isin(clicks.joint, rows).any()]
    return min(clicked, key=lambda t: abs(t - fit.click), default=None)


def _courses(begin: int | None, frames: int) -> list[list[int]]:
    """The frames in the order in which a limb is followed: from where it begins, or from the first to the last."""
    return [list(range(frames))] if begin is None else [list(range(begin, frames)), list(range(begin, -1, -1))]


def _points_of_bones(given: PoseTracking, motion: np.ndarray) -> np.ndarray:
    """How many measured points each bone has in each frame (T, B) of a motion (T, D)."""
    fit = given.fit
    owners = (segment(points, given.state(pose), fit.model.surface, fit.settings.gate_m)[1] for points, pose in zip(given.points, motion))
    return np.array([np.bincount(bones, minlength=len(fit.model.skeleton.bones)) for bones in owners])


def _stretches(seen: np.ndarray) -> list[range]:
    """Stretches of frames that are not `seen` (T,), each with the seen frame before and the one after."""
    frames = np.flatnonzero(seen).tolist()
    return [range(a, b + 1) for a, b in zip(frames, frames[1:]) if b - a > 1]


def _even(given: PoseTracking, motion: np.ndarray, limb: Limb, frames: range) -> Way:
    """The way of a limb that turns evenly between the first and the last of some frames."""
    between, time_s = [*frames[1:-1]], given.time_s[frames]
    share = (time_s[1:-1] - time_s[0]) / (time_s[-1] - time_s[0])
    first, last = motion[[frames[0], frames[-1]]][:, limb.columns]
    poses = motion[between]
    poses[:, limb.columns] = first + share[:, None] * (last - first)
    return list(zip(between, poses[:, limb.columns], limb.ends(poses, given.first.vector)))


def _meeting(given: PoseTracking, motion: np.ndarray, limb: Limb, frames: range, monitor: Monitor) -> Way:
    """The way of a limb between the first and the last of some frames, where it stays: of those from both ends the two that meet best."""
    ahead, back = (_ways(given, motion, limb, [*course], False, monitor) for course in (frames[:-1], frames[:0:-1]))
    best, place = np.inf, (0, 0, 0)
    for n, (one, other) in enumerate(zip(ahead, back[::-1])):
        step_s = float(given.time_s[frames[n + 1]] - given.time_s[frames[n]])
        expected = one.ends_m + VELOCITY_KEPT * step_s * one.velocity_m_s
        away = unlikely(limb, other.ends_m[None] - expected[:, None], step_s)
        total = one.cost[:, None] + other.cost[None] + np.minimum(away, LARGEST_JUMP)
        if total.min() < best:
            best, place = float(total.min()), (n, *divmod(int(np.argmin(total)), total.shape[1]))
    n, i, j = place
    before = _traced(ahead[: n + 1], [*frames[: n + 1]], i)
    after = _traced(back[: len(frames) - 1 - n], [*frames[:n:-1]], j)
    return [*before, *after]


def best_way(given: PoseTracking, motion: np.ndarray, limb: Limb, frames: list[int], anywhere: bool, monitor: Monitor) -> Way:
    """A limb's best way: without the first frame, where it stays, or with it if it may begin anywhere."""
    ways = _ways(given, motion, limb, frames, anywhere, monitor)
    return _traced(ways, [frames[0], *frames] if anywhere else frames, int(np.argmin(ways[-1].cost)))


def _traced(ways: list[_Ways], frames: list[int], k: int) -> Way:
    """Way k of the last of some frames, without the first one."""
    found = Way()
    for t, way in zip(frames[:0:-1], ways[:0:-1]):
        found.append((t, way.angles[k], way.ends_m[k]))
        k = int(way.before[k])
    return found


def _ways(given: PoseTracking, motion: np.ndarray, limb: Limb, frames: list[int], anywhere: bool, monitor: Monitor) -> list[_Ways]:
    """The ways up to each frame, from the first one's pose, or from anywhere."""
    start, ends = motion[frames[0], limb.columns][None], limb.ends(motion[frames[0]][None], given.first.vector)
    none = np.zeros(1, dtype=np.intp)
    ways = [_Ways(angles=start, ends_m=ends, velocity_m_s=0 * ends, rate=0 * start, cost=np.zeros(1), before=none)]
    steps = [(frames[0], frames[0]), *zip(frames, frames[1:])] if anywhere else [*zip(frames, frames[1:])]
    for n, (s, t) in enumerate(steps):
        monitor.step(STAGE, n, len(frames))
        step_s = abs(float(given.time_s[t] - given.time_s[s]))
        near = given.fit.seen(t, given.points[t]).near(limb, given.state(motion[t]))
        ways.append(_continued(limb, ways[-1], motion[t], given.first.vector, near, step_s))
    return ways


def _continued(limb: Limb, ways: _Ways, pose: np.ndarray, vector: np.ndarray, near: Evidence, step_s: float) -> _Ways:
    """The ways one frame further, to the frame with the tracked pose (D,) and what is seen near the limb.  (1)"""
    ahead = np.clip(ways.angles + VELOCITY_KEPT * step_s * ways.rate, limb.low, limb.high)
    own = pose[limb.columns][None]
    around = [limb.samples(a, AROUND, AROUND_RAD) for a in ahead[np.argsort(ways.cost, kind="stable")[:NEAR_WAYS]]]
    going_on = np.concatenate([ways.angles, ahead, own, *around])
    anywhere, thinned = limb.samples(own[0], ANYWHERE, ANYWHERE_RAD), near.thinned()
    coarse = limb_gains(thinned, limb, limb.poses(pose, going_on), vector, COARSE_M)
    least = np.sort(coarse)[-IMPROVED]
    coarse = np.concatenate([coarse, limb_gains(thinned, limb, limb.poses(pose, anywhere), vector, COARSE_M, least)])
    best = np.concatenate([going_on, anywhere])[np.argsort(-coarse, kind="stable")[:IMPROVED]]
    tried = np.concatenate([going_on, best, *(limb.samples(a, IMPROVEMENTS, IMPROVED_RAD) for a in best)])
    poses = limb.poses(pose, tried)
    gain, ends = limb_gains(near, limb, poses, vector, FINE_M), limb.ends(poses, vector)
    anew = step_s == 0  # the first frame of an unsure limb: any pose is as probable before it is seen
    expected = ways.ends_m + VELOCITY_KEPT * step_s * ways.velocity_m_s
    away = unlikely(limb, ends[:, None] - expected[None], step_s)
    total = ways.cost[None] + np.minimum(away, LARGEST_JUMP) * (not anew)
    before = np.argmin(total, axis=1)
    cost = total[np.arange(len(tried)), before] - gain / GAIN
    kept: list[int] = []
    for k in np.argsort(cost, kind="stable").tolist():
        if all(np.linalg.norm(ends[k] - ends[j], axis=1).max() > DIFFERENT_M for j in kept):
            kept.append(k)
        if len(kept) == WAYS:
            break
    b = before[kept]
    jumped = (anew | (away[kept, b] > LARGEST_JUMP))[:, None]
    return _Ways(
        angles=tried[kept],
        ends_m=ends[kept],
        velocity_m_s=np.where(jumped[..., None], 0.0, (ends[kept] - ways.ends_m[b]) / max(step_s, 1e-9)),
        rate=np.where(jumped, 0.0, (tried[kept] - ways.angles[b]) / max(step_s, 1e-9)),
        cost=cost[kept] - cost[kept].min(),
        before=b,
    )
