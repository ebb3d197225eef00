"""Inverses and products of many small matrices at once, as arrays over the matrices.

LAPACK called matrix by matrix costs several microseconds each, most of it for the call; here the loop runs over the pivots.
"""

import numpy as np


def invert_spd(matrices: np.ndarray) -> np.ndarray:
    """Inverses (N, k, k) of symmetric positive definite matrices (N, k, k), by sweep operations, without pivoting.

    Only the lower triangles are used. A singular matrix gives inf or NaN in its own rows only. The unknowns should have similar scales.
    """
    M = np.ascontiguousarray(np.moveaxis(matrices, 0, -1), dtype=np.float64)  # (k, k, N): every step runs over the matrices
    k = len(M)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for p in range(k):
            inverse = 1 / M[p, p]
            column = np.concatenate([M[p, :p], M[p:, p]])
            row = column * inverse
            for i in (i for i in range(k) if i != p):
                M[i, : i + 1] -= column[i] * row[: i + 1]
            M[p, :p], M[p + 1 :, p], M[p, p] = row[:p], row[p + 1 :], -inverse
        for i in range(k):
            M[: i + 1, i] = M[i, : i + 1] = -M[i, : i + 1]
    return np.moveaxis(M, -1, 0)


def sandwich(A: np.ndarray, K: np.ndarray) -> np.ndarray:
    """A K Aᵀ (N, 2, 2) of symmetric K (N, 2, 2); faster than numpy's product for such small matrices."""
    left = [[A[:, i, 0] * K[:, 0, j] + A[:, i, 1] * K[:, 1, j] for j in range(2)] for i in range(2)]
    out = np.empty_like(A)
    out[:, 0, 0], out[:, 1, 1] = (left[i][0] * A[:, i, 0] + left[i][1] * A[:, i, 1] for i in range(2))
    out[:, 0, 1] = out[:, 1, 0] = left[0][0] * A[:, 1, 0] + left[0][1] * A[:, 1, 1]
    return out


def largest(v: np.ndarray) -> np.ndarray:
    """Largest absolute value (N,) in the few columns of v (N, k)."""
    columns = np.abs(np.ascontiguousarray(v.T))
    return np.asarray(columns.max(axis=0))
