"""The start of a fit without clicks: which frame, which pose, which side, and how sure that is.

The frames in which most is seen of the person, and in which the limbs are furthest from the body, are searched (`search`). The best
hypotheses are adjusted (`refine`), lost limbs are looked for, and the best explanation gets rivals: the same limbs of a person who faces
the other way, or with the legs exchanged, or one limb elsewhere. All explanations of one frame compete:

    p_k = exp(S_k / τ) / Σ_j exp(S_j / τ)                                                                  (1)

S is the number of voxels that an explanation accounts for; S/τ also contains log odds for walking forwards, because people seldom walk
backwards. Explanations whose joints agree within `SAME_M` are one. Nobody turns round within a moment: which way the person faces in the
other frames counts, too. Where the best explanation is less probable than `fitting.least_start_probability`, a click is asked for: on the
joint whose places in the explanations differ most. Clicked joints are observations in all steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..inputs.cloud_points import CloudPoints
from ..inputs.start_joints import StartJoints
from .pose_dictionary import known_poses
from .refine import STAGE, Explanation, exchanged, limb_rivals, of_hypothesis, thinned_points, with_lengths, with_limbs
from .search import hypotheses, is_inside

LOOKED_AT, SEARCHED = 24, 2  # frames of which the easiest are chosen, and how many are searched
APART = 0.25  # of the recording, between the frames that are searched
TRIED, DIFFERENT_M, AMONG = 6, 0.2, 600  # hypotheses that are adjusted: these differ, and are among so many of the best
COMPLETED = 3  # of them, whose limbs are looked for
SAME_M = 0.2  # between the joints of explanations that are one
TAU = 40.0  # voxels for a probability ratio of e
FORWARD, MOST_FORWARD = 3.0, 1.0  # log odds per m/s of walking forwards, and at most
TURN_S, MOST_AGREEMENT = 1.0, 5.0  # between frames in which a person faces about the same way; the most log odds from another frame
WALK_S = 0.3  # before and after a frame, for the velocity
LEAST_POINTS = 100  # of a frame, for a start
UNLIKELY = 0.01  # a less probable rival is not named
JUDGED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")  # joints by which explanations are compared
EXCHANGES = {
    "front and back": ("hip", "knee", "ankle", "clavicle", "shoulder", "elbow", "wrist", "knuckles"),
    "the left and the right leg": ("knee", "ankle"),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class _Frame:
    """All explanations of one frame, the best first, and the probability of each."""

    explanations: Sequence[Explanation]
    probability: np.ndarray


def find_start(
    fit: FitContext,
    points_of: Callable[[int], CloudPoints],
    frames: Sequence[int],
    time_s: np.ndarray,
    monitor: Monitor,
    without: tuple[str, ...] = (),
) -> StartJoints | None:
    """The joints where the fit begins; None where no frame has enough points.

    `fit`: a body of the whole person, without the joints of clicks as a start. `points_of(t)`: the points of frame index
    t. `without`: recordings of the pose dictionary that are left out.

    Raises:
        Cancelled: the user asked to stop.
    """
    chosen = easiest_frames(fit, points_of, len(frames), monitor)
    if not chosen:
        return None
    known = known_poses(fit.model.skeleton, without)
    walk = _velocities(points_of, chosen, time_s)
    judged = [_explained(fit, t, points_of(t), known, walk[i], monitor.part(STAGE, i, len(chosen) + 1)) for i, t in enumerate(chosen)]
    best = max(_agreed(judged, fit.model.skeleton.joint_names, time_s), key=lambda one: float(one.probability[0]))
    first = best.explanations[0]
    final, stature = with_lengths(fit, thinned_points(points_of(first.t)), first, monitor.part(STAGE, len(chosen), len(chosen) + 1))
    names = fit.model.skeleton.joint_names
    return StartJoints(
        frame=frames[first.t],
        xyz_m=dict(zip(names, final.joints_m)),
        stature=stature,
        model=fit.model.name,
        probability=float(best.probability[0]),
        rivals=_named(best, names),
        ask=_decisive(best, names),
    )


def easiest_frames(fit: FitContext, points_of: Callable[[int], CloudPoints], count: int, monitor: Monitor) -> list[int]:
    """The frame indices to search: those with clicks, or else the easiest ones apart from each other.

    Only frames with enough points, in which the image shows the whole person.
    """
    some = sorted(fit.clicked) or np.unique(np.linspace(0, count - 1, min(LOOKED_AT, count)).round().astype(int)).tolist()
    ease = dict[int, float]()
    for i, t in enumerate(some):
        monitor.step(STAGE, i, 10 * len(some))
        points = points_of(t)
        if len(points.xyz_m) >= LEAST_POINTS:
            ease[t] = _ease(fit, t, points)
    chosen: list[int] = []
    for t in sorted(ease, key=lambda t: -ease[t]):
        apart = all(abs(t - other) >= APART * count for other in chosen)
        if len(chosen) < SEARCHED and apart and is_inside(fit.seen(t, points_of(t))):
            chosen.append(t)
    return chosen


def _ease(fit: FitContext, t: int, points: CloudPoints) -> float:
    """Voxels with points, and the length of the outline in the same unit: limbs apart from the body make it longer."""
    outline = sum(len(rays.sigma_m) for rays in fit.silhouettes.observe(t, fit.parameters.state(_at(fit, points), fit.parameters.vector())))
    return len(points.xyz_m) + float(outline)


def _at(fit: FitContext, points: CloudPoints) -> np.ndarray:
    pose = np.zeros(len(fit.model.skeleton.dofs))
    pose[fit.model.skeleton.layout.group("base")] = np.median(points.xyz_m, axis=0)
    return pose


def _velocities(points_of: Callable[[int], CloudPoints], chosen: Sequence[int], time_s: np.ndarray) -> list[np.ndarray]:
    """The velocity (3,) [m/s] of the person in the chosen frames, from the medians of the points before and after."""
    found = []
    for t in chosen:
        near = np.flatnonzero(np.abs(time_s - time_s[t]) <= WALK_S)
        ends = ((s, points_of(s).xyz_m) for s in near[[0, -1]].tolist())
        at = [(time_s[s], np.median(xyz, axis=0)) for s, xyz in ends if len(xyz) >= LEAST_POINTS]
        step = at[-1][0] - at[0][0] if len(at) > 1 else 0.0
        found.append((at[-1][1] - at[0][1]) / step if step > 0 else np.zeros(3))
    return found


def _explained(fit: FitContext, t: int, points: CloudPoints, known: np.ndarray, velocity: np.ndarray, monitor: Monitor) -> _Frame:
    """The explanations of frame index `t`, with their probabilities.  (1)"""
    evidence, thin = fit.seen(t, points), thinned_points(points)
    found = hypotheses(fit, t, evidence, known).best(AMONG)
    monitor.step(STAGE, 2, 10)
    tried: list[Explanation] = []
    starts: list[np.ndarray] = []
    for pose, stature in zip(found.poses, found.stature.tolist()):
        joints = fit.parameters.state(pose, fit.parameters.vector()).joints_m
        if len(tried) < TRIED and all(np.linalg.norm(joints - other, axis=1).max() > DIFFERENT_M for other in starts):
            starts.append(joints)
            tried.append(of_hypothesis(fit, t, thin, pose, stature, monitor.part(STAGE, 2 + len(starts), 20)))
    tried.sort(key=lambda one: -one.score)
    complete = [with_limbs(fit, thin, one, monitor.part(STAGE, 8 + i, 20)) for i, one in enumerate(tried[:COMPLETED])]
    best = max(complete, key=lambda one: one.score)
    rivals = [exchanged(fit, thin, best, parts, monitor.part(STAGE, 12 + i, 20)) for i, parts in enumerate(EXCHANGES.values())]
    rivals += limb_rivals(fit, thin, best, monitor)
    return judged(fit, [*tried[COMPLETED:], *complete, *rivals], velocity)


def judged(fit: FitContext, found: Sequence[Explanation], velocity: np.ndarray) -> _Frame:
    """Different explanations, the best first, with their probabilities.  (1)"""
    names = fit.model.skeleton.joint_names
    odds = [one.score / TAU + _walks(one, names, velocity) for one in found]
    kept: list[int] = []
    for i in np.argsort(-np.array(odds), kind="stable").tolist():
        if all(difference_m(found[i], found[j], names).max() > SAME_M for j in kept):
            kept.append(i)
    share = np.exp(np.array([odds[i] for i in kept]) - odds[kept[0]])
    return _Frame(explanations=[found[i] for i in kept], probability=share / share.sum())


def _agreed(frames: Sequence[_Frame], names: Sequence[str], time_s: np.ndarray) -> list[_Frame]:
    """The frames, with the log odds of facing one way or the other added from all frames nearby."""
    found = []
    for one in frames:
        odds = np.log(np.maximum(one.probability, 1e-12))
        toward = facing(one.explanations[0], names)
        for other in frames:
            if other is not one and abs(time_s[other.explanations[0].t] - time_s[one.explanations[0].t]) <= TURN_S:
                same = np.array([facing(e, names) @ toward > 0 for e in other.explanations])
                likely = [max(float(other.probability[rows].sum()), 1e-12) for rows in (same, ~same)]
                there = float(np.clip(np.log(likely[0] / likely[1]), -MOST_AGREEMENT, MOST_AGREEMENT))
                odds += np.array([there if facing(e, names) @ toward > 0 else 0.0 for e in one.explanations])
        order = np.argsort(-odds, kind="stable")
        share = np.exp(odds[order] - odds[order[0]])
        found.append(_Frame(explanations=[one.explanations[i] for i in order.tolist()], probability=share / share.sum()))
    return found


def difference_m(a: Explanation, b: Explanation, names: Sequence[str]) -> np.ndarray:
    """The distances [m] of the joints by which explanations are compared; 0 for the others."""
    compared = np.array([name.partition(".")[0] in JUDGED for name in names])
    return np.where(compared, np.linalg.norm(a.joints_m - b.joints_m, axis=1), 0.0)


def facing(one: Explanation, names: Sequence[str]) -> np.ndarray:
    """The horizontal direction (3,) in which the person faces, from hips and shoulders."""
    at = dict(zip(names, one.joints_m))
    left = sum(at[f"{part}.L"] - at[f"{part}.R"] for part in ("hip", "shoulder") if f"{part}.L" in at)
    forward = np.cross(left, [0.0, 0.0, 1.0])
    return np.asarray(forward / max(float(np.linalg.norm(forward)), 1e-9))


def _walks(one: Explanation, names: Sequence[str], velocity: np.ndarray) -> float:
    """Log odds of facing as in an explanation, at a velocity (3,)."""
    return float(np.clip(FORWARD * facing(one, names) @ velocity, -MOST_FORWARD, MOST_FORWARD))


def _named(frame: _Frame, names: Sequence[str]) -> dict[str, float]:
    """What the rivals of the best explanation differ in, with their probabilities."""
    best, named = frame.explanations[0], dict[str, float]()
    for other, p in zip(frame.explanations[1:], frame.probability[1:].tolist()):
        if p >= UNLIKELY:
            name = _difference(best, other, names)
            named[name] = named.get(name, 0.0) + p
    return named


def _difference(a: Explanation, b: Explanation, names: Sequence[str]) -> str:
    """What two explanations differ in."""
    if facing(a, names) @ facing(b, names) < 0:
        return "front and back"
    off = difference_m(a, b, names)
    if "ankle.L" in names:
        left, right = names.index("ankle.L"), names.index("ankle.R")
        crossed = [float(np.linalg.norm(a.joints_m[i] - b.joints_m[j])) for i, j in ((left, right), (right, left))]
        if max(crossed) < min(off[left], off[right]):
            return "the left and the right leg"
    part, _, side = names[int(np.argmax(off))].partition(".")
    return f"where the {'left' if side == 'L' else 'right'} {'arm' if part in ('shoulder', 'elbow', 'wrist') else 'leg'} is"


def _decisive(frame: _Frame, names: Sequence[str]) -> str:
    """The joint to click: its places in the best explanation and in the rivals differ most, weighted by their probabilities."""
    best, total = frame.explanations[0], np.zeros(len(names))
    for other, p in zip(frame.explanations[1:], frame.probability[1:].tolist()):
        total += p * np.minimum(difference_m(best, other, names), 2 * SAME_M)
    return names[int(np.argmax(total))] if total.any() else next(name for name in names if name.startswith("elbow"))
