"""Redundancy of every image coordinate, for Baarda's test (Baarda 1968: data snooping).

q_vv = 1 − a Q_c aᵀ − b U⁻¹ bᵀ ,   a = j − b U⁻¹ Wᵀ                          (1)   j, b: the coordinate's rows of the design matrix
Σ q_vv = number of observations − number of unknowns = redundancy           (2)
"""

import numpy as np

from .bundle import Network, Unknowns, design, normal_equations
from .precision import camera_covariance

CHUNK = 1000


def redundant_parts(network: Network, used: np.ndarray, unknowns: Unknowns, unit_px: float) -> np.ndarray:
    """q_vv (N, C, 2, 2) of all image coordinates for weight 1; of those not used, it is 1."""
    zero = np.zeros((*used.shape, 2))
    normals = normal_equations(network, zero, used.astype(np.float64), unknowns, unit_px)
    root = _root(camera_covariance(network, normals, unknowns))
    _, J, B = design(network, unknowns)
    C, N, _, p = J.shape
    inverse = np.linalg.inv(normals.U)
    parts = np.ones((N, C, 4))
    for start in range(0, N, CHUNK):
        at = slice(start, start + CHUNK)
        by_cameras = (inverse[at] @ normals.W[at]) @ root  # (n, 5, q)
        for c in range(C):
            a = J[c, at] @ root[c * p : (c + 1) * p] - B[c, at] @ by_cameras
            BU = B[c, at] @ inverse[at]
            parts[at, c] -= np.einsum("nrq,nrq->nr", a, a) + np.einsum("nrk,nrk->nr", BU, B[c, at])
    return np.where(used[..., None], parts.reshape(N, C, 2, 2), 1.0)


def _root(covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
