"""Inverses of many small symmetric positive definite matrices at once, as arrays over the matrices.

LAPACK called matrix by matrix costs several microseconds each, most of it for the call; here the loop runs over the pivots.
"""

import numpy as np


def invert_spd(matrices: np.ndarray) -> np.ndarray:
    """Inverses (N, k, k) of symmetric positive definite matrices (N, k, k), by Gauss–Jordan elimination without pivoting.

    A singular matrix gives inf or NaN in its own rows only. Scale the unknowns alike before: nothing is pivoted.
    """
    M = np.ascontiguousarray(np.moveaxis(matrices, 0, -1), dtype=np.float64)  # (k, k, N): every step runs over the matrices
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for pivot in range(M.shape[0]):
            inverse = 1 / M[pivot, pivot]
            row, column = M[pivot] * inverse, M[:, pivot].copy()
            M -= column[:, None] * row[None]
            M[pivot], M[:, pivot] = row, -column * inverse
            M[pivot, pivot] = inverse
    return np.moveaxis(M, -1, 0)
