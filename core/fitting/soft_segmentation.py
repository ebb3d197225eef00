"""Points that may belong to several limbs, to each in part (Horaud, Niskanen, Dewaele & Boyer 2009, IEEE TPAMI 31(1), §4).

    α_ij = π_ij N(d_ij; σ) max(0, n_i·n_j) / (Σ_k π_ik N(d_ik; σ) max(0, n_i·n_k) + π_0 / (2 gate))               (1)
    π_j = mean of α_ij over i ,   π_0 = what is left ,   σ² = Σ α d² / Σ α , within 3 and 30 mm                 (2)

d_ij is the distance of point i from the surface of limb j, n are their normals, and the last term of (1) is the class of outliers, even
within the gate. Few of a body's limbs are near a point: π_ij is π_j among those that are, together 1 − π_0. A few rounds of (1) and (2)
begin at σ = 30 mm; as the body comes to its points σ falls with their distances, so a far start is undecided, and a good fit decides as
sharply as the hard segmentation. What a limb gets where the surface is another part's (`segmentation`) is nobody's.
"""

import numpy as np

from .cloud_points import CloudPoints
from .segmentation import beside_bone, candidates
from .state import BodyState

WIDEST_M, NARROWEST_M = 0.030, 0.003
ROUNDS = 6
OUTLIERS = (0.05, 0.5)  # π_0 at the start, and at most
LEAST_SHARE = 0.05  # what a point gives to a limb; less is not worth its equation


def soft_segment(
    points: CloudPoints, state: BodyState, surface: np.ndarray, gate_m: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of the points (K,), a limb's bone (K,), and which share of the point is the limb's (K,). A row may come several times.

    Arguments as in `segmentation.segment`.
    """
    gate = np.broadcast_to(gate_m, (len(state.lengths_m),))
    found = candidates(points.xyz_m, state, gate)
    gap, likely, own = (np.zeros((len(points.xyz_m), len(found))) for _ in range(3))
    for j, (b, rows) in enumerate(found):
        d, along, cosine = beside_bone(points.xyz_m[rows], points.normals[rows], state, b)
        gap[rows, j], likely[rows, j] = d, np.maximum(cosine, 0.0) * (np.abs(d) < gate[b])
        own[rows, j] = (along >= surface[b, 0]) & (along <= surface[b, 1])
    share = responsibilities(gap, likely, float(gate.mean()))
    share = np.where(own > 0, share, 0.0)
    rows, column = np.nonzero(share > LEAST_SHARE)
    return rows, np.array([b for b, _ in found], dtype=np.intp)[column], share[rows, column]


def responsibilities(gap_m: np.ndarray, likely: np.ndarray, gate_m: float) -> np.ndarray:
    """α (N, J) of distances (N, J) and of factors (N, J) that are 0 where a limb cannot be.  (1), (2)"""
    share, sigma = np.zeros_like(gap_m), WIDEST_M
    mixture, outliers, near = np.ones(gap_m.shape[1]), OUTLIERS[0], likely > 0
    for _ in range(ROUNDS):
        among = (1 - outliers) * mixture / np.maximum((near * mixture).sum(axis=1, keepdims=True), 1e-12)
        density = among * likely * np.exp(-0.5 * (gap_m / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
        share = density / (density.sum(axis=1, keepdims=True) + outliers / (2 * gate_m))  # (1)
        total = float(share.sum())
        if total < 1e-9:
            break
        mixture = share.sum(axis=0) / max(int(near.any(axis=1).sum()), 1)  # what is beyond every gate is no outlier of the body
        outliers = float(np.clip(1 - mixture.sum(), *OUTLIERS))
        sigma = float(np.clip(np.sqrt((share * gap_m**2).sum() / total), NARROWEST_M, WIDEST_M))  # (2)
    return share
