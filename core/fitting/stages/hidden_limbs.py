"""Reacquisition of limbs that have lost their points, or that leave many points near them unexplained.

A limb that moved on while it was not measured is no longer where it is predicted, and its points lie beyond the gate; it may have taken
points of something else. Poses all over the joints' range are tried against the points that no part of the body explains, evenly spread
(Halton 1960), then closer ones around the best; the last best is a new start for the adjustment.
"""

from functools import lru_cache

import numpy as np
from scipy.stats import qmc

from ...foundation.progress import Monitor
from ..context import FitContext
from ..inputs.cloud_points import CloudPoints
from ..segmentation import facing_bone, segment
from ..state import BodyState, free_bones

ROUNDS = (
    (400, 150.0, 0.03, 4),
    (60, 25.0, 0.02, 2),
    (60, 10.0, 0.015, 1),
)  # poses, spread [°], width [m] of weights, how many of the best go on
BEYOND_M = 0.05  # points so far beyond a limb's reach, or so near to another part or bone, are not the limb's
LOST_SHARE, ASTRAY_SHARE = 0.5, 1.0  # of `min_points`: unexplained points for a search, for a limb without points and for one with some
SEARCH = "look for a limb"


def lost_limbs(fit: FitContext, counts: np.ndarray) -> list[np.ndarray]:
    """The limbs, or outer parts of limbs (the bones of each, from the body outwards), whose bones all have too few points.

    `counts` (B,) of a pose. A part of a larger lost one is not listed by itself.
    """
    few, outer = counts < fit.few_points, _limbs(fit)
    lost = [b for b, bones in outer.items() if few[bones].all()]
    return [outer[b] for b in lost if int(fit.model.skeleton.parents[b]) not in lost]


def reacquired_poses(
    fit: FitContext, points: CloudPoints, motion: np.ndarray, vector: np.ndarray, monitor: Monitor | None = None
) -> list[np.ndarray]:
    """Poses (D,) in which limbs explain points that no other part does; none where there are too few such points.

    At most one for each limb; each includes those before it. First the limbs without points; then, from the hands and feet inwards, those
    with points, perhaps another limb's, that leave more of them unexplained nearby.

    Raises:
        Cancelled: the user asked to stop.
    """
    monitor, state = monitor or Monitor(), fit.parameters.state(motion, vector)
    _, owners = segment(points, state, fit.model.surface, fit.settings.gate_m)
    lost = lost_limbs(fit, np.bincount(owners, minlength=len(state.lengths_m)))
    found, now, moved = [], motion, np.zeros(len(state.lengths_m), dtype=bool)
    tries = [
        *((limb, _unexplained, LOST_SHARE) for limb in lost),
        *((limb, _astray, ASTRAY_SHARE) for limb in sorted(_limbs(fit).values(), key=len)),
    ]
    for i, (limb, rows_of, least) in enumerate(tries):
        if moved[limb].any():
            continue
        rows = rows_of(fit, points, fit.parameters.state(now, vector), limb)
        if len(rows) < least * fit.settings.min_points:
            continue
        pose = _search(fit, points.take(rows), limb, now, vector, monitor.part(SEARCH, i, len(tries)))
        if pose is not None:
            now, moved[limb] = pose, True
            found.append(now)
    return found


def _search(
    fit: FitContext, points: CloudPoints, limb: np.ndarray, now: np.ndarray, vector: np.ndarray, monitor: Monitor
) -> np.ndarray | None:
    """The pose (D,) in which a limb explains most of these points; None if it explains too few."""
    best = now[None]
    for k, (count, spread, width, most) in enumerate(ROUNDS):
        monitor.step(SEARCH, k, len(ROUNDS))
        tried = np.concatenate([_poses(fit, pose, limb, count, np.radians(spread)) for pose in best])
        support = np.array([_explained(fit, points, s, limb, width) for s in fit.parameters.states(tried, vector)])
        best = tried[np.argsort(-support, kind="stable")[:most]]
    return best[0] if support.max() > fit.least_gain else None


def _limbs(fit: FitContext) -> dict[int, np.ndarray]:
    """Limbs and the outer parts of limbs: by the first bone of each all its bones with a pose to be observed, from the body outwards."""
    skeleton, free = fit.model.skeleton, free_bones(fit.parameters)
    first = [int(b) for b in np.flatnonzero(free) if skeleton.parents[b] >= 0 and _limb(fit, int(b))]
    return {b: np.array([c for c in np.flatnonzero(free) if b in _path_to_base(skeleton.parents, int(c))]) for b in first}


def _limb(fit: FitContext, bone: int) -> bool:
    return fit.model.skeleton.bones[bone].name.endswith((".L", ".R"))


def _path_to_base(parents: np.ndarray, bone: int) -> list[int]:
    path = [int(bone)]
    while parents[path[-1]] >= 0:
        path.append(int(parents[path[-1]]))
    return path


def _unexplained(fit: FitContext, points: CloudPoints, state: BodyState, limb: np.ndarray) -> np.ndarray:
    """Rows of the points within a limb's reach that are near no other part of the body, nor near a hand, foot or other bone's axis."""
    reach = float(state.lengths_m[limb].sum()) + BEYOND_M
    near = np.linalg.norm(points.xyz_m - state.head_m[limb[0]], axis=1) < reach
    outer = {c for c in range(len(state.lengths_m)) if limb[0] in _path_to_base(fit.model.skeleton.parents, c)}
    fleshy = set(state.balls.bone_index.tolist())
    for b in set(range(len(state.lengths_m))) - outer:
        rows = np.flatnonzero(near)
        if b in fleshy:
            near[rows] = facing_bone(points.xyz_m[rows], points.normals[rows], state, b)[0] > max(fit.settings.gate_m, BEYOND_M)
        else:
            w, axis = points.xyz_m[rows] - state.head_m[b], state.R[b][:, 1]
            along = np.clip(w @ axis, 0.0, state.lengths_m[b] + BEYOND_M)
            near[rows] = np.linalg.norm(w - along[:, None] * axis, axis=1) > BEYOND_M
    return np.flatnonzero(near)


def _astray(fit: FitContext, points: CloudPoints, state: BodyState, limb: np.ndarray) -> np.ndarray:
    """Rows of the points within a limb's reach that neither the limb nor another part explains."""
    rows = _unexplained(fit, points, state, limb)
    for b in limb:
        rows = rows[facing_bone(points.xyz_m[rows], points.normals[rows], state, int(b))[0] > max(fit.settings.gate_m, BEYOND_M)]
    return rows


def _poses(fit: FitContext, pose: np.ndarray, limb: np.ndarray, count: int, spread: float) -> np.ndarray:
    """Poses (count, D) of one limb, evenly within `spread` [rad] of a pose and the joints' limits; the rest of the body stays.

    The bone before it turns about itself, too: its own points hardly constrain its twist, and it carries the limb around.
    """
    skeleton, free = fit.model.skeleton, free_bones(fit.parameters)
    above = int(skeleton.parents[limb[0]])
    twist = (skeleton.dof_bone == above) & free[above] & np.array([dof.axis == "y" for dof in skeleton.dofs])
    columns = np.flatnonzero((np.isin(skeleton.dof_bone, limb) | twist) & ~np.isin(np.arange(len(pose)), skeleton.locked))
    low, high = (np.array([skeleton.dofs[c].limits[i] for c in columns]) for i in (0, 1))
    low, high = np.maximum(low, pose[columns] - spread), np.minimum(high, pose[columns] + spread)
    tried = np.tile(pose, (count, 1))
    tried[:, columns] = low + _halton(len(columns), count) * np.maximum(high - low, 0.0)
    return tried


@lru_cache(maxsize=8)
def _halton(dimensions: int, count: int) -> np.ndarray:
    return np.asarray(qmc.Halton(dimensions, scramble=False).random(count))


def _explained(fit: FitContext, points: CloudPoints, state: BodyState, limb: np.ndarray, width_m: float) -> float:
    """How many of the points a limb explains: the sum of their weights."""
    best = np.zeros(len(points.xyz_m))
    for b in limb:
        gap, along, facing = facing_bone(points.xyz_m, points.normals, state, int(b))
        own = facing & (along >= fit.model.surface[b, 0]) & (along <= fit.model.surface[b, 1])
        best = np.maximum(best, own / (1 + (gap / width_m) ** 2) ** 2)
    return float(best.sum())
