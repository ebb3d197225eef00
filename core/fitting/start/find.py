"""The start of a fit without clicks: which frame, which pose, which side, and how sure that is.

The frame in which most is seen of the person, and in which the limbs are furthest from the body, is searched, and another one shortly
before or after (`search`). In each, the best hypotheses are adjusted (`refine`), lost limbs are looked for, and the best explanation gets
rivals: the same limbs of a person who faces the other way, or with the legs exchanged, or one limb elsewhere. What is found in one frame is
followed to the others. All explanations compete:

    p_k = exp(S_k / τ) / Σ_j exp(S_j / τ)                                                                  (1)

S is the number of voxels of all these frames that an explanation accounts for; S/τ also contains log odds for walking forwards, because
people seldom walk backwards. Explanations whose joints agree within `SAME_M` in all of them are one. The best one is uncertain unless
another frame's own search finds it best, too: the right one may be missing among them. If it does not, a third frame is searched. Each
clicked joint halves that doubt. A limb may also be elsewhere in the best explanation (`limb_places`): the start is in the frame that shows
best where the limbs are, and is the less probable, the less certain each of them is there. Where it is less probable than
`fitting.least_start_probability`, a click is asked for: on the most uncertain joint of the least certain limb, or on the joint whose places
in the explanations differ most. Clicked joints are observations in all steps, and a click that is missed makes
the start improbable.

Where an arm lies on the body is hardly seen in one frame: an adjustment that begins at the truth moves a wrist by up to 33 cm.
Wrists therefore have a larger sigma (`StartJoints.sigma_m`).
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..inputs.cloud_points import CloudPoints
from ..inputs.start_joints import UNTRIED, StartJoints
from .limb_places import NEAR_M, LimbPlaces, limb_places
from .pose_dictionary import known_poses
from .refine import (
    LEAST_POINTS,
    ROUNDS,
    STAGE,
    Explanation,
    adjusted,
    carried,
    exchanged,
    exchanges_of,
    missed_m,
    of_hypothesis,
    thinned_points,
    with_clicks,
    with_lengths,
    with_limb,
    with_limbs,
)
from .search import Framing, framing, hypotheses

LOOKED_AT = 24  # frames of which the easiest is searched, and of those around it
OUTLINE = 3.0  # voxels, by ray of an outline
AROUND_S = (0.06, 0.25)  # between two frames that are searched
SEARCHED = 3  # frames, at most
FOLLOWED, LEAST_RIVAL = 2, 0.01  # explanations of a frame that are followed to the others: at most, and their least probability in it
UNCONFIRMED = 0.1  # the probability that no explanation is right, unless both frames find the best one; each clicked joint halves it
TRIED, DIFFERENT_M, AMONG = 5, 0.2, 600  # hypotheses that are adjusted: these differ, and are among so many of the best
COMPLETED = 2  # of them, which are adjusted to the end, and whose limbs are looked for
SAME_M = 0.2  # between the joints of explanations that are one
TAU = 40.0  # voxels for a probability ratio of e
FORWARD, MOST_FORWARD = 3.0, 1.0  # log odds per m/s of walking forwards, and at most
WALK_S = 0.3  # before and after a frame, for the velocity
UNLIKELY = 0.01  # a less probable rival is not named
JUDGED = ("shoulder", "hip", "knee", "ankle")  # joints by which explanations are compared: of an arm all frames decide
ASKED = (*JUDGED, "elbow", "wrist")  # joints that a person can click
ARMS = ("elbow.L", "elbow.R")  # the first joints of limbs that all frames decide, not the first one
LEAST_CERTAINTY = 0.95  # of an arm: below it is not certain in its frame
ELSEWHERE = 0.5  # of a leg: one that is less certain in all frames is more probably elsewhere
MISSED_M = 0.07  # from a click to its joint: the probability of the start falls by e^(-½) at this distance


@dataclass(frozen=True, eq=False, kw_only=True)
class Followed:
    """An explanation of the frame in which it was found, and the same in the other frames."""

    found: Explanation
    elsewhere: Sequence[Explanation] = ()

    def at(self, t: int) -> Explanation:
        """The explanation of frame index `t`."""
        return next(one for one in (self.found, *self.elsewhere) if one.t == t)

    def is_same(self, other: "Followed", names: Sequence[str]) -> bool:
        """Whether the joints agree in all frames."""
        return all(difference_m(one, other.at(one.t), names).max() <= SAME_M for one in (self.found, *self.elsewhere))


@dataclass(frozen=True, eq=False, kw_only=True)
class Judged:
    """Different explanations, the best first, and the probability of each."""

    followed: Sequence[Followed]
    probability: np.ndarray


def find_start(
    fit: FitContext,
    points_of: Callable[[int], CloudPoints],
    frames: Sequence[int],
    time_s: np.ndarray,
    monitor: Monitor,
    shown: Collection[Framing],
    without: tuple[str, ...] = (),
) -> StartJoints | None:
    """The joints where the fit begins; None where no frame has enough points and shows as much of the person as one of `shown`.

    `fit`: a body of that part, without the joints of clicks as a start. `points_of(t)`: the points of frame index
    t. `without`: recordings of the pose dictionary that are left out.

    Raises:
        Cancelled: the user asked to stop.
    """
    chosen = easiest_frames(fit, points_of, time_s, monitor, shown)
    if not chosen:
        return None
    known, names = known_poses(fit.model.skeleton, without), fit.model.skeleton.joint_names
    walk, parts = dict(zip(chosen, _velocities(points_of, chosen, time_s))), 2 * SEARCHED + 1
    found = list[list[Explanation]]()
    for i, t in enumerate(chosen):
        found.append(_explained(fit, t, points_of(t), known, walk[t], monitor.part(STAGE, 2 * i, parts)))
        if i or len(chosen) == 1:
            best = judged(fit, _everywhere(fit, points_of, found, monitor.part(STAGE, 2 * i + 1, parts)), walk)
            if is_confirmed(best.followed[0], found, names):
                break
    last = monitor.part(STAGE, parts - 1, parts)
    searched = [chosen[0]] if fit.clicked else [of_frame[0].t for of_frame in found]
    clicked = {t: with_clicks(fit, thinned_points(points_of(t)), best.followed[0].at(t), last) for t in searched}
    limbs = {t: limb_places(fit, points_of(t), one, last) for t, one in clicked.items()}
    for t in searched:
        clicked[t], limbs[t] = _with_legs(fit, points_of(t), clicked[t], limbs[t], last)
    at = max(searched, key=lambda t: surely(limbs[t]))
    arms = [limb for limb in limbs[at] if next(iter(limb.doubt)) in ARMS]
    legs = [leg for leg in _legs(map(_surest, zip(*limbs.values()))) if leg.certainty < ELSEWHERE]
    joints = np.unique(fit.clicked[at].joint) if at in fit.clicked else np.zeros(0, dtype=np.intp)
    doubt = 0.0 if is_confirmed(best.followed[0], found, names) else UNCONFIRMED / 2 ** len(joints)
    unsure = tuple(joint for arm in arms if arm.certainty < LEAST_CERTAINTY for joint in arm.doubt)
    final, stature = with_lengths(fit, thinned_points(points_of(at)), clicked[at], last)
    kept = (1 - doubt) * float(np.exp(-0.5 * (missed_m(fit, final) / MISSED_M) ** 2))
    explanations, probability = [one.at(at) for one in best.followed], kept * best.probability
    likely, rivals = float(probability[0]), _named(explanations, probability, names)
    if 1 - kept >= UNLIKELY:
        rivals[UNTRIED] = 1 - kept
    uncertain = {int(leg.limb.bones[0]) for leg in legs}
    doubted = [leg for leg in _legs(limbs[at]) if int(leg.limb.bones[0]) in uncertain]
    return StartJoints(
        frame=frames[at],
        xyz_m=dict(zip(names, final.joints_m)),
        rival_m=_rival(names, final, explanations, probability, doubted),
        stature=stature,
        model=fit.model.name,
        unsure=unsure,
        probability=likely * surely(legs),
        rivals=_with_limbs(rivals, legs, likely),
        ask=_least_sure(legs, max(1 - kept, 1 - float(best.probability[0])), {names[j] for j in joints.tolist()})
        or _decisive(explanations, np.maximum(best.probability, 1 - kept), names, joints),
    )


def _everywhere(
    fit: FitContext, points_of: Callable[[int], CloudPoints], found: Sequence[Sequence[Explanation]], monitor: Monitor
) -> list[Followed]:
    """The explanations of each frame, followed to the other frames that were searched."""
    chosen = [of_frame[0].t for of_frame in found]
    return [
        Followed(found=one, elsewhere=[carried(fit, points_of, one, t, monitor) for t in chosen if t != one.t])
        for of_frame in found
        for one in of_frame
    ]


def easiest_frames(
    fit: FitContext,
    points_of: Callable[[int], CloudPoints],
    time_s: np.ndarray,
    monitor: Monitor,
    shown: Collection[Framing] = (Framing.WHOLE,),
) -> list[int]:
    """The frame indices to search: the easiest one, of those with clicks if there are any, then the easiest ones around it (`AROUND_S`).

    Only frames with enough points, in which the image shows so much of the person.
    """
    chosen, some = list[int](), sorted(fit.clicked) or _spread(np.arange(len(time_s)), LOOKED_AT)
    while len(chosen) < SEARCHED and (easiest := _easiest(fit, points_of, some, monitor, shown)) is not None:
        chosen.append(easiest)
        apart = np.abs(time_s[:, None] - time_s[chosen])
        some = _spread(np.flatnonzero((apart >= AROUND_S[0]).all(axis=1) & (apart[:, 0] <= AROUND_S[1])), LOOKED_AT)
    return chosen


def _spread(rows: np.ndarray, count: int) -> list[int]:
    """Not more than `count` of the rows, evenly."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int))].tolist()


def _easiest(
    fit: FitContext, points_of: Callable[[int], CloudPoints], some: Sequence[int], monitor: Monitor, shown: Collection[Framing]
) -> int | None:
    ease, middle = dict[int, float](), fit.cameras[len(fit.cameras) // 2]
    for t in some:
        monitor.check()
        points = points_of(t)
        if len(points.xyz_m) >= LEAST_POINTS:
            ease[t] = _ease(fit, t, points)
    return next((t for t in sorted(ease, key=lambda t: -ease[t]) if framing(fit.seen(t, points_of(t)), middle) in shown), None)


def _ease(fit: FitContext, t: int, points: CloudPoints) -> float:
    """Voxels with points, the area of the person's cells, and the length of the outline: limbs apart from the body make it longer."""
    outline = sum(len(rays.sigma_m) for rays in fit.silhouettes.observe(t, fit.parameters.state(_at(fit, points), fit.parameters.vector())))
    middle = np.median(points.xyz_m, axis=0)
    seen = fit.seen(t, points)
    cells = sum(seen.cell_area(view, middle) * len(view.xy_px) for view in seen.cells)
    return len(points.xyz_m) + cells + OUTLINE * outline


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


def _explained(
    fit: FitContext, t: int, points: CloudPoints, known: np.ndarray, velocity: np.ndarray, monitor: Monitor
) -> list[Explanation]:
    """The best explanations of frame index `t` that differ."""
    evidence, thin, names = fit.seen(t, points), thinned_points(points), fit.model.skeleton.joint_names
    found = hypotheses(fit, t, evidence, known).best(AMONG)
    monitor.step(STAGE, 2, 10)
    tried: list[Explanation] = []
    starts: list[Explanation] = []
    for pose, stature in zip(found.poses, found.stature.tolist()):
        start = of_hypothesis(fit, t, pose, stature)
        if len(tried) < TRIED and all(difference_m(start, other, names).max() > DIFFERENT_M for other in starts):
            starts.append(start)
            tried.append(adjusted(fit, thin, start, ROUNDS[:1], monitor.part(STAGE, 2 + len(starts), 20)))
    tried.sort(key=lambda one: -one.score)
    complete = [_complete(fit, thin, one, monitor.part(STAGE, 8 + i, 20)) for i, one in enumerate(tried[:COMPLETED])]
    best = max(complete, key=lambda one: one.score)
    rivals = [exchanged(fit, thin, best, parts, monitor.part(STAGE, 12 + i, 20)) for i, parts in enumerate(exchanges_of(fit).values())]
    frame = judged(fit, [Followed(found=one) for one in (*complete, *rivals)], {t: velocity})
    return [one.found for one, p in zip(frame.followed[:FOLLOWED], frame.probability.tolist()) if p >= LEAST_RIVAL]


def _complete(fit: FitContext, points: CloudPoints, found: Explanation, monitor: Monitor) -> Explanation:
    """The explanation adjusted to the end, with its limbs."""
    return with_limbs(fit, points, adjusted(fit, points, found, ROUNDS[1:], monitor), monitor)


def judged(fit: FitContext, found: Sequence[Followed], velocity: Mapping[int, np.ndarray]) -> Judged:
    """Different explanations, the best first, with their probabilities.  (1)  `velocity`: (3,) by frame index."""
    names = fit.model.skeleton.joint_names
    odds = [sum(e.score / TAU + _walks(e, names, velocity[e.t]) for e in (one.found, *one.elsewhere)) for one in found]
    kept: list[int] = []
    for i in np.argsort(-np.array(odds), kind="stable").tolist():
        if not any(found[i].is_same(found[j], names) for j in kept):
            kept.append(i)
    share = np.exp(np.array([odds[i] for i in kept]) - odds[kept[0]])
    return Judged(followed=[found[i] for i in kept], probability=share / share.sum())


def is_confirmed(one: Followed, found: Sequence[Sequence[Explanation]], names: Sequence[str]) -> bool:
    """Whether an explanation is also the best one of another frame's own search (`found`: of each frame, the best first)."""
    others = (of_frame[0] for of_frame in found if of_frame[0].t != one.found.t)
    return any(difference_m(one.at(other.t), other, names).max() <= SAME_M for other in others)


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


def _named(explanations: Sequence[Explanation], probability: np.ndarray, names: Sequence[str]) -> dict[str, float]:
    """What the rivals of the best explanation differ in, with their probabilities."""
    best, named = explanations[0], dict[str, float]()
    for other, p in zip(explanations[1:], probability[1:].tolist()):
        if p >= UNLIKELY:
            name = _difference(best, other, names)
            named[name] = named.get(name, 0.0) + p
    return named


def _rival(
    names: Sequence[str],
    final: Explanation,
    explanations: Sequence[Explanation],
    probability: np.ndarray,
    legs: Sequence[LimbPlaces],
) -> dict[str, np.ndarray]:
    """The joints of the likeliest other explanation: one of the `explanations`, the best first, or the `final` one, which comes from the
    best, with a leg elsewhere; empty if none has a probability."""
    found = [(p, dict(zip(names, one.joints_m))) for one, p in zip(explanations[1:], probability[1:].tolist())]
    for leg in legs:
        k = int(np.argmax(np.where(leg.off_m.max(axis=1) > NEAR_M, leg.probability, -1.0)))
        joints = [leg.limb.parameters.skeleton.bones[bone].tail_joint for bone in leg.limb.bones.tolist()]
        found.append(
            (float(probability[0]) * (1 - leg.certainty), {**dict(zip(names, final.joints_m)), **dict(zip(joints, leg.ends_m[k]))})
        )
    p, joints_m = max(found, key=lambda one: one[0], default=(0.0, dict[str, np.ndarray]()))
    return joints_m if p >= UNLIKELY else {}


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
    return _whereabouts(names[int(np.argmax(off))])


def _whereabouts(joint: str) -> str:
    """The question where the limb of a joint is."""
    part, _, side = joint.partition(".")
    return f"where the {'left' if side == 'L' else 'right'} {'arm' if part in ('shoulder', 'elbow', 'wrist') else 'leg'} is"


def surely(limbs: Sequence[LimbPlaces]) -> float:
    """The probability that all limbs are where they were found."""
    return float(np.prod([limb.certainty for limb in limbs]))


def _with_legs(
    fit: FitContext, points: CloudPoints, found: Explanation, limbs: list[LimbPlaces], monitor: Monitor
) -> tuple[Explanation, list[LimbPlaces]]:
    """An explanation with its limbs' places; better ones, if a leg is more probably elsewhere and the whole body explains more with it
    there. Explanations that were followed to another frame may have lost a leg on the way."""
    thin = thinned_points(points)
    for _ in _legs(limbs):
        leg = min(_legs(limbs), key=lambda leg: leg.certainty)
        if leg.certainty >= ELSEWHERE:
            break
        better = max(with_limb(fit, thin, found, leg.poses[int(np.argmax(leg.gain))], monitor), key=lambda one: one.score)
        if better.score <= found.score:
            break
        found, limbs = better, limb_places(fit, points, better, monitor)
    return found, limbs


def _legs(limbs: Iterable[LimbPlaces]) -> list[LimbPlaces]:
    return [limb for limb in limbs if next(iter(limb.doubt)) not in ARMS]


def _surest(of_frames: Sequence[LimbPlaces]) -> LimbPlaces:
    """The places of one limb in the frame in which it is most certain."""
    return max(of_frames, key=lambda limb: limb.certainty)


def _with_limbs(rivals: Mapping[str, float], limbs: Sequence[LimbPlaces], probability: float) -> dict[str, float]:
    """The rivals with other places of single limbs, of an explanation with this probability; the more probable ones of the same name."""
    named = dict(rivals)
    for limb in limbs:
        name, elsewhere = _whereabouts(next(iter(limb.doubt))), probability * (1 - limb.certainty)
        if elsewhere >= UNLIKELY:
            named[name] = max(elsewhere, named.get(name, 0.0))
    return named


def _least_sure(limbs: Sequence[LimbPlaces], doubt: float, clicked: Set[str]) -> str | None:
    """The joint to click of the least certain limb; None if something else is doubted more, or all its joints are clicked."""
    if not limbs:
        return None
    least = min(limbs, key=lambda limb: limb.certainty)
    joints = {joint: off for joint, off in least.doubt.items() if joint not in clicked and joint.partition(".")[0] in ASKED}
    return max(joints, key=lambda joint: joints[joint]) if joints and 1 - least.certainty > doubt else None


def _decisive(explanations: Sequence[Explanation], probability: np.ndarray, names: Sequence[str], clicked: np.ndarray) -> str:
    """The joint to click: its places in the best explanation and in the rivals differ most, weighted by their probabilities."""
    best, total = explanations[0], np.zeros(len(names))
    for other, p in zip(explanations[1:], probability[1:].tolist()):
        total += p * np.minimum(difference_m(best, other, names), 2 * SAME_M)
    total[clicked] = 0.0
    if total.any():
        return names[int(np.argmax(total))]
    left = [name for j, name in enumerate(names) if j not in clicked and name.partition(".")[0] in ASKED]
    return next((name for name in left if name.startswith("elbow")), left[0] if left else names[0])
