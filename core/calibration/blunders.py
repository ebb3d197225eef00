"""Redundancy of every image coordinate, for Baarda's test (Baarda 1968: data snooping).

q_vv = 1 − a Q_c aᵀ − b U⁻¹ bᵀ ,   a = j − b U⁻¹ Wᵀ                          (1)   j, b: the coordinate's rows of the design matrix
Σ q_vv = number of observations − number of unknowns = redundancy           (2)
"""

import numpy as np

from .bundle import Network, Unknowns, design, eliminated, inverse_factors, normal_equations
from .precision import camera_covariance


def redundant_parts(network: Network, used: np.ndarray, unknowns: Unknowns, unit_px: float) -> np.ndarray:
    """q_vv (N, C, 2, 2) of all image coordinates for weight 1; of those not used, it is 1."""
    zero = np.zeros((*used.shape, 2))
    normals = normal_equations(network, zero, used.astype(np.float64), unknowns, unit_px)
    root = _root(camera_covariance(network, normals, unknowns)).T
    C, N = len(network.R), len(network.middle)
    parts = np.ones((C, 4, N))
    for at, some in network.stretches():
        _, J, B = design(some, unknowns)
        rows = J.reshape(C, -1, J[0, 0].size)  # (C, p, 4 n)
        inverse = inverse_factors(normals.U[..., at])
        by_cameras = root @ eliminated(inverse, normals.W[..., at])  # (5, q, n)
        b = np.einsum("jkn,ckrn->cjrn", inverse, B.reshape(C, 5, 4, -1))  # L⁻¹ bᵀ
        for c, of in enumerate(np.split(root, C, axis=1)):
            a = (of @ rows[c]).reshape(len(root), 4, -1) - np.einsum("jrn,jqn->qrn", b[c], by_cameras)
            parts[c, :, at] -= np.einsum("qrn,qrn->rn", a, a) + np.einsum("jrn,jrn->rn", b[c], b[c])
    return np.where(used[..., None], parts.reshape(C, 2, 2, N).transpose(3, 0, 2, 1), 1.0)


def _root(covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
