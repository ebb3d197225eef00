"""The rigid motion that a point's neighbours share, fitted robustly and without the point itself.

For neighbours that move from p_j to q_j with weights w_j (p̄, q̄ their weighted means), the rotation R is the solution of

    (Σ w (|P|² I − P Pᵀ) + λ I) ω = Σ w P × (q − q̄ − P) ,   P = R (p − p̄) ,   R ← exp(ω) R                (1)

and the point is expected at R (x − p̄) + q̄. One step of (1) is the velocity field v = v0 + ω × (X − X̄) of a rigid body, which describes
a rotating limb, unlike a common velocity; repeated, it converges for rotations of any size. λ keeps R = I about axes that the neighbours do
not determine. For a point on one limb whose neighbours lie mostly on another there is a second fit, which starts from the neighbours whose
distance from the point is the same at both instants: in a rigid body all distances are invariant.
"""

from dataclasses import dataclass

import numpy as np

from ..geometry.robust import mad_sigma
from ..geometry.rotation import cross_matrix, rotation_from_vector
from ..geometry.small_matrices import invert_spd

NEIGHBOURS = 14
STEPS = 6  # of (1)
PLAIN_STEPS = 2  # of these without reweighting, while R is far from the solution
NOISE_M = 2e-3  # sigma of a neighbour: λ = NOISE_M² Σ w in (1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Expectation:
    """Positions of N points predicted by their neighbours. Metres."""

    xyz_m: np.ndarray  # (N, 3); NaN with fewer than three neighbours
    spread_m: np.ndarray  # (N,) robust scatter of the neighbours about their common motion
    members: np.ndarray  # (N,) neighbours that share the motion
    leverage: np.ndarray  # (N,) variance of the predicted position, in units of a neighbour's variance


def nearest_neighbours(xyz_m: np.ndarray, among_m: np.ndarray, radius_m: float, *, same: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N, m) of `among_m` nearest to the points (N, 3) within the radius, and which of them exist.

    `same`: the points are those of `among_m`, and no point counts as its own neighbour.
    """
    from scipy.spatial import cKDTree

    if not len(among_m):
        return np.zeros((len(xyz_m), 1), dtype=np.int64), np.zeros((len(xyz_m), 1), dtype=bool)
    count = min(NEIGHBOURS + same, len(among_m))
    distance, rows = cKDTree(among_m).query(
        xyz_m, k=list(range(1 + same, count + 1)) if count > same else [1], distance_upper_bound=radius_m
    )
    there = np.isfinite(distance) & (np.full(len(xyz_m), count > same)[:, None])
    return np.where(there, rows, 0), there


def common_motion(
    xyz_m: np.ndarray, before_m: np.ndarray, after_m: np.ndarray, weight: np.ndarray, scale_m: float | np.ndarray
) -> Expectation:
    """Positions of points (N, 3) that move with their neighbours from `before_m` to `after_m` (N, m, 3), with initial weights (N, m).

    `scale_m` is a scatter of neighbours that is always accepted.
    """
    R = np.tile(np.eye(3), (len(xyz_m), 1, 1))
    there, w = weight > 0, weight.astype(np.float64)
    scale = np.broadcast_to(np.asarray(scale_m, dtype=np.float64), (len(xyz_m),))
    for step in range(STEPS):
        total = np.maximum(w.sum(axis=1), 1e-12)[:, None]
        p0, q0 = np.einsum("nm,nmi->ni", w, before_m) / total, np.einsum("nm,nmi->ni", w, after_m) / total
        P = (before_m - p0[:, None]) @ R.transpose(0, 2, 1)
        R = rotation_from_vector(_turn(P, after_m - q0[:, None], w)) @ R  # (1)
        miss = np.linalg.norm((before_m - p0[:, None]) @ R.transpose(0, 2, 1) + q0[:, None] - after_m, axis=2)
        if step >= PLAIN_STEPS - 1:
            spread = mad_sigma(miss, 1, w > 0.25 * w.max(axis=1, keepdims=True))
            w = weight / (1 + (miss / (2 * np.maximum(spread, scale))[:, None]) ** 2) ** 2  # Geman & McClure
    members = (there & (miss < 3 * np.maximum(spread, scale)[:, None])).sum(axis=1)
    goal = np.einsum("nij,nj->ni", R, xyz_m - p0) + q0
    return Expectation(
        xyz_m=np.where((there.sum(axis=1) >= 3)[:, None], goal, np.nan),
        spread_m=spread,
        members=members,
        leverage=_leverage(xyz_m - p0, before_m - p0[:, None], w / np.maximum(w.max(axis=1, keepdims=True), 1e-12)),
    )


def _leverage(x: np.ndarray, p: np.ndarray, w: np.ndarray) -> np.ndarray:
    """1 / Σ w + tr([x]× J⁻¹ [x]×ᵀ) / 3, J the matrix of (1): the effect at x (N, 3) of errors of the neighbours p (N, m, 3)."""
    X = cross_matrix(x)
    turned = ((X @ invert_spd(_inertia((w[..., None] * p).transpose(0, 2, 1) @ p, w))) * X).sum(axis=(1, 2)) / 3
    return np.asarray(1 / np.maximum(w.sum(axis=1), 1e-12) + turned)


def _turn(P: np.ndarray, Q: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Rotation vectors ω (N, 3) of (1), at most a radian."""
    weighted = (w[..., None] * P).transpose(0, 2, 1)
    M = weighted @ Q  # Σ w P × (Q − P) is twice its antisymmetric part
    torque = np.stack([M[:, 1, 2] - M[:, 2, 1], M[:, 2, 0] - M[:, 0, 2], M[:, 0, 1] - M[:, 1, 0]], axis=1)
    omega = np.einsum("nij,nj->ni", invert_spd(_inertia(weighted @ P, w)), torque)
    return np.asarray(omega / np.maximum(1.0, np.linalg.norm(omega, axis=1))[:, None])


def _inertia(moments: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The matrix (N, 3, 3) of (1) from Σ w P Pᵀ (N, 3, 3)."""
    total = np.einsum("nii->n", moments) + w.sum(axis=1) * NOISE_M**2 + 1e-15
    return np.eye(3) * total[:, None, None] - moments


def same_distance(
    before_m: np.ndarray, after_m: np.ndarray, neighbours_before: np.ndarray, neighbours_after: np.ndarray, scale_m: float | np.ndarray
) -> np.ndarray:
    """Weights (N, m) by how little the distance from a point (N, 3) to each neighbour (N, m, 3) has changed."""
    d0 = np.linalg.norm(neighbours_before - before_m[:, None], axis=2)
    d1 = np.linalg.norm(neighbours_after - after_m[:, None], axis=2)
    return 1 / (1 + ((d1 - d0) / (2 * np.reshape(np.asarray(scale_m), (-1, 1)))) ** 2) ** 2
