"""Differential operators on a mesh of quads: vertex normals, areas, and the Laplace–Beltrami operator; and the solution of their equations.

    (C f)_i = ½ Σ_j (cot α_ij + cot β_ij)(f_j − f_i) ,   Δf = M⁻¹ C f ,   M: the vertices' areas             (1)

(Pinkall & Polthier 1993, Experimental Mathematics 2(1)), each quad as the mean of its two triangulations; negative weights, which obtuse
corners cause, are set to a small positive one, so that the maximum principle holds.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from scipy import sparse

LEAST_COTANGENT = 0.02
LEAST_AREA_M2 = 1e-8


def triangles_of(faces: np.ndarray) -> np.ndarray:
    """Both triangulations (4 F, 3) of quads (F, 4)."""
    return np.concatenate([faces[:, c] for c in ([0, 1, 2], [0, 2, 3], [1, 2, 3], [1, 3, 0])])


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Outward unit normals (V, 3), the mean of the adjacent quads weighted by area."""
    corner = vertices[faces]
    normal = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    total = np.stack([np.bincount(faces.ravel(), np.repeat(normal[:, k], 4), len(vertices)) for k in range(3)], axis=1)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))


def laplacian(vertices: np.ndarray, faces: np.ndarray) -> "tuple[sparse.csr_matrix, np.ndarray]":
    """C (V, V) of (1), and the areas (V,) [m²] of the vertices."""
    from scipy import sparse

    triangles, count = triangles_of(faces), len(vertices)
    rows, columns, values, area = [], [], [], np.zeros(count)
    for i in range(3):
        a, b, c = (triangles[:, (i + k) % 3] for k in range(3))
        u, v = vertices[b] - vertices[a], vertices[c] - vertices[a]
        across = np.linalg.norm(np.cross(u, v), axis=1)
        cotangent = np.maximum(np.einsum("nk,nk->n", u, v) / np.maximum(across, 2 * LEAST_AREA_M2), LEAST_COTANGENT)
        rows += [b, c]
        columns += [c, b]
        values += [cotangent / 4, cotangent / 4]  # half of the weight in each triangulation
        area += np.bincount(a, across / 12, count)  # a third of half of the triangle's area
    W = sparse.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (count, count))
    C = sparse.csr_matrix(W - sparse.diags(np.asarray(W.sum(axis=1)).ravel()))
    return C, np.maximum(area, LEAST_AREA_M2)


def factorised(matrix: "sparse.spmatrix", weight: np.ndarray | None = None) -> Any:
    """The factors of a positive definite matrix (V, V), which needs no pivots, with `weight` (V,) added to its diagonal."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    whole = matrix if weight is None else matrix + sparse.diags(weight.astype(np.float64))
    return splu(sparse.csc_matrix(whole), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
