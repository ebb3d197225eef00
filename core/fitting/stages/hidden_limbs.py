"""Reacquisition of limbs that have lost their points, or that leave much of what is seen near them unexplained.

A limb that moved on while it was not measured is no longer where it is predicted, and its points lie beyond the gate; it may have taken
points of something else. Poses all over the joints' range are tried against the points, and the person's cells in front of the still
background, that no part of the body explains, evenly spread (Halton 1960), then closer ones around the best; the last best is a new start
for the adjustment.
"""

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..explained import Evidence, limb_gains
from ..inputs.cloud_points import CloudPoints
from ..limb import Limb, limbs_of, whole_limbs
from ..segmentation import segment

ROUNDS = (
    (800, 150.0, 0.04, 5),
    (60, 30.0, 0.025, 2),
    (60, 12.0, 0.02, 1),
)  # poses, spread [°], width [m] of weights, how many of the best go on
CELLS_SHARE = 1.5  # of `min_points`, with cells: outlines differ by so much all around
LOST_SHARE, ASTRAY_SHARE = 0.5, 1.0  # of `min_points`: unexplained points for a search, for a limb without points and for one with some
SEARCH = "look for a limb"


def lost_limbs(fit: FitContext, counts: np.ndarray) -> list[Limb]:
    """The limbs, or outer parts of limbs, whose bones all have too few points.

    `counts` (B,) of a pose. A part of a larger lost one is not listed by itself.
    """
    few = counts < fit.few_points
    lost = {b: limb for b, limb in limbs_of(fit.parameters).items() if few[limb.bones].all()}
    return [limb for limb in lost.values() if limb.parent not in lost]


def reacquired_poses(
    fit: FitContext, t: int, points: CloudPoints, motion: np.ndarray, vector: np.ndarray, monitor: Monitor | None = None
) -> list[np.ndarray]:
    """Poses (D,) of frame index `t` in which limbs explain what no other part does; none where there is too little, or without
    `search_limbs`.

    At most one for each limb; each includes those before it. First the limbs without points; then, from the hands and feet inwards, those
    with points, perhaps another limb's, that leave more of what is seen nearby unexplained.

    Raises:
        Cancelled: the user asked to stop.
    """
    if not fit.settings.search_limbs:
        return []
    monitor, state = monitor or Monitor(), fit.parameters.state(motion, vector)
    evidence = fit.seen(t, points)
    _, owners = segment(points, state, fit.model.surface, fit.settings.gate_m)
    lost = lost_limbs(fit, np.bincount(owners, minlength=len(state.lengths_m)))
    if evidence.cells:
        tries = [(limb, CELLS_SHARE) for limb in (*lost, *whole_limbs(fit.parameters))]
    else:
        astray = sorted(limbs_of(fit.parameters).values(), key=lambda limb: len(limb.bones))
        tries = [*((limb, LOST_SHARE) for limb in lost), *((limb, ASTRAY_SHARE) for limb in astray)]
    found, now, moved = [], motion, np.zeros(len(state.lengths_m), dtype=bool)
    for i, (limb, least) in enumerate(tries):
        if moved[limb.bones].any():
            continue
        near = evidence.near(limb, fit.parameters.state(now, vector))
        search = _search(near, limb, now, vector, least * fit.settings.min_points, monitor.part(SEARCH, i, len(tries)))
        if search is not None:
            now, moved[limb.bones] = search, True
            found.append(now)
    return found


def _search(evidence: Evidence, limb: Limb, now: np.ndarray, vector: np.ndarray, least: float, monitor: Monitor) -> np.ndarray | None:
    """The pose (D,) in which a limb explains most of what the rest of the body does not; None if it explains too little more than now.

    `least`: the unexplained area, in voxels, for a search, and by how much its pose must explain more.
    """
    have = limb_gains(evidence, limb, now[None], vector, ROUNDS[-1][2])[0]
    if evidence.unexplained(limb.head_m(now, vector)) - have < least:
        return None
    best = now[None]
    for k, (count, spread, width, most) in enumerate(ROUNDS):
        monitor.step(SEARCH, k, len(ROUNDS))
        around = [limb.poses(pose, limb.samples(pose[limb.columns], count, np.radians(spread))) for pose in best]
        tried, seen = np.concatenate(around), evidence if k else evidence.thinned()
        gain = limb_gains(seen, limb, best, vector, width)
        present = -np.inf if k else float(gain[0])  # of the coarse poses, only those that explain more go on
        gain = np.concatenate([gain, limb_gains(seen, limb, tried, vector, width, present)])
        order = np.argsort(-gain, kind="stable")[:most]
        if not k and order[0] == 0:
            return None
        order = order[gain[order] >= present]
        best, gain = np.concatenate([best, tried])[order], gain[order]
    return best[0] if gain[0] > have + least else None
