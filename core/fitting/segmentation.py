"""Which limb does a measured point belong to? (D'Apuzzo et al. 1999, §3.3: the closest limb in the posture so far.)

Closest is the limb with the smallest distance from the bone's segment, minus the limb's radius there (a fat trunk must not swallow the
points of a thin arm). A point is nobody's when it is further from that surface than a gate, when it lies along the bone where the surface
is another part's or bends with the joint (the shoulder belongs to the trunk, what is beyond the wrist to the hand), or when its normal
points into the limb.
"""

import numpy as np

from ..body.metaballs import STATIONS
from .cloud_points import CloudPoints
from .state import CROSS, BodyState

RADIUS_OF_SUM = 1 / 1.534  # limb radius / l of three balls a segment
FACING = 0.6  # least cosine between a point's normal and its direction from the bone


def segment(points: CloudPoints, state: BodyState, surface: np.ndarray, gate_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points that belong to a limb (K,) and the limb's bone (K,).

    `surface` (B, 2): fractions of each bone between which a surface is its own; `gate_m`: farthest distance from the limb's surface.
    """
    bones = np.unique(state.balls.bone_index)
    if not len(points.xyz_m):
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    gap, along, facing = (np.stack(a, axis=1) for a in zip(*(_from_bone(points, state, int(b)) for b in bones)))
    nearest = np.argmin(gap, axis=1)
    rows = np.arange(len(nearest))
    bone, t = bones[nearest], along[rows, nearest]
    own = (t >= surface[bone, 0]) & (t <= surface[bone, 1])
    keep = own & (np.abs(gap[rows, nearest]) < gate_m) & facing[rows, nearest]
    return np.flatnonzero(keep), bone[keep]


def crop(points: CloudPoints, state: BodyState, reach_m: float) -> CloudPoints:
    """The points within `reach_m` of the bones: what a fit near this posture can ever need."""
    near = np.zeros(len(points.xyz_m), dtype=bool)
    for b in np.unique(state.balls.bone_index):
        near |= _from_bone(points, state, int(b))[0] < reach_m
    return points.take(np.flatnonzero(near))


def _from_bone(points: CloudPoints, state: BodyState, bone: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance from the limb's surface (N,) [m], fraction along the bone (N,), and whether the normal points outwards (N,)."""
    local = (points.xyz_m - state.head_m[bone]) @ state.R[bone]
    along = local[:, 1] / state.lengths_m[bone]
    across = local.copy()
    across[:, 1] -= np.clip(along, 0.0, 1.0) * state.lengths_m[bone]
    distance = np.linalg.norm(across, axis=1)
    mine = state.balls.bone_index == bone
    radii = RADIUS_OF_SUM * state.balls.radii_m[mine][:, CROSS].mean(axis=1)
    order = np.argsort(state.balls.centre[mine, 1]) if mine.sum() != len(STATIONS) else slice(None)
    radius = np.interp(along, state.balls.centre[mine, 1][order], radii[order])
    normal = points.normals @ state.R[bone]
    outward = normal[:, 0] * across[:, 0] + normal[:, 2] * across[:, 2]
    size = np.linalg.norm(normal, axis=1) * np.hypot(across[:, 0], across[:, 2])
    return distance - radius, along, (outward >= FACING * size)
