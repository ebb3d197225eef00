"""Measured points on hands with their fingers, where the flat hand of metaballs would be drawn to fingers that it does not have.

    r = L g(Rᵀ (X − o) / L, b) / σ                                                                        (1)

g is the distance from the nearest capsule of the hand (`fitting.hands`) in lengths L of its bone, o and R are the bone's head and axes, and
b is how far its fingers are bent, a parameter of the shape. The foot of a point on its capsule's axis minimises the distance, so that g
changes with the capsule's motion there only.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..hands import BACK, REACH, Fingers
from ..segmentation import gap_to_bone, near_pairs
from ..state import Block, BodyState, FromBlocks

FACING = 0.0  # least cosine between a point's normal and the hand's: across a finger few of a patch's pixels are the finger's


@dataclass(frozen=True, eq=False, kw_only=True)
class HandPoints(FromBlocks):
    """N points on the surfaces of hands.  (1)"""

    xyz_m: np.ndarray  # (N, 3) world
    bone: np.ndarray  # (N,) the hand's
    sigma_m: np.ndarray  # (N,)
    variance_inflation: np.ndarray | float
    kind: str = "hands"

    @property
    def size(self) -> int:
        """N."""
        return len(self.bone)

    def residual(self, state: BodyState) -> np.ndarray:
        """(N,)"""
        value = np.empty(len(self.bone))
        for b in np.unique(self.bone).tolist():
            rows = np.flatnonzero(self.bone == b)
            value[rows] = hand_gaps(self.xyz_m[rows], state, b)[0]
        return value / self.sigma_m

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, hand by hand."""
        for b in np.unique(self.bone).tolist():
            rows, (dofs, before) = np.flatnonzero(self.bone == b), state.parts[b].chain
            X = self.xyz_m[rows]
            gap, normal, by_bend = hand_gaps(X, state, b)
            screws = np.einsum("dij,nj->ndi", state.screws[dofs], normal)
            J, columns = screws[..., 0] + np.einsum("ndi,ni->nd", screws[..., 1:], X), dofs
            if shape:
                shifts = -normal @ (state.lengths_m[before, None] * state.R[before, :, 1]).T
                own = gap - np.einsum("ni,ni->n", normal, X - state.head_m[b])
                J = np.column_stack([J, shifts, own, (state.finger_bends[b] + BACK) * by_bend])
                columns = np.concatenate([dofs, state.layout.lengths(np.append(before, b)), [state.layout.bend(b)]])
            yield rows, columns, J / self.sigma_m[rows, None]


def hand_gaps(xyz_m: np.ndarray, state: BodyState, b: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points (N, 3) the distance from a hand (N,) [m], its gradient (N, 3) in the world, and its derivative by the bend (N,) [m]."""
    L, fingers = state.lengths_m[b], Fingers.bent(state.skeleton.bones[b].name.endswith(".L"), state.finger_bends[b])
    gap, normal, by_bend = fingers.gaps((xyz_m - state.head_m[b]) @ state.R[b] / L)
    return L * gap, normal @ state.R[b].T, L * by_bend


def hand_owners(xyz_m: np.ndarray, normals: np.ndarray, state: BodyState, gate_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of the points nearer than a gate to a hand and nearer to it than to any other part, and the hand's bone (K,)."""
    others = np.setdiff1d(np.unique(state.balls.bone_index), state.layout.hands)
    nearest, owner = np.full(len(xyz_m), gate_m), np.full(len(xyz_m), -1)
    for b in state.layout.hands:
        close = np.flatnonzero(np.linalg.norm(xyz_m - state.head_m[b], axis=1) < REACH * state.lengths_m[b] + gate_m)
        if not len(close):
            continue
        gap, normal, _ = hand_gaps(xyz_m[close], state, b)
        known = normals[close].any(axis=1)
        facing = ~known | (np.einsum("ni,ni->n", normals[close], normal) >= FACING)
        mine = facing & (np.abs(gap) < gate_m) & (gap < nearest[close])
        nearest[close[mine]], owner[close[mine]] = gap[mine], b
    rows = np.flatnonzero(owner >= 0)
    of, bone = near_pairs(xyz_m[rows], state, np.full(len(state.lengths_m), gate_m), others)
    nearer = gap_to_bone(xyz_m[rows][of], state, bone) < nearest[rows][of]
    rows = np.delete(rows, np.unique(of[nearer]))
    return rows, owner[rows]
