"""One closed skin for a whole body, of the surface that its parts have together: vertices put onto it, and which bones move them.

    G = (Σ_p F_p^n)^(1/n) = T ,   n = 4 ,   F_p: the sum of the balls of part p                            (1)

that is the largest of the parts' fields, with a fillet where limbs grow out of the trunk (Ricci 1973, as in skin_roots). Newton's steps
along ∇G = Σ F_p³ ∇F_p / G³ take the vertices of any mesh that is near onto it. Weights come from the skin of the parts, and are smoothed
along the mesh, or it would tear where one part ends and another begins.
"""

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from .metaballs import THRESHOLD, Metaballs, field_and_derivatives
from .shape import BodyShape
from .skeleton import bone_frames
from .skin_mesh import Skin
from .skin_parts import body_parts
from .skin_roots import BLEND_POWER

NEWTON_STEPS = 3
LONGEST_STEP_M = 0.005
CHUNK = 4000
NEAREST = 6  # vertices of the parts' skin that say which bones move a vertex
SMOOTHED_M = 0.03  # weights are smoothed over about this distance


def onto_surface(shape: BodyShape, motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) near the surface of a body in one posture, moved onto it.  (1)"""
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.asarray(motion, dtype=np.float64))
    found = np.array(points, dtype=np.float64)
    for first in range(0, len(found), CHUNK):
        part = found[first:first + CHUNK]
        for _ in range(NEWTON_STEPS):
            G, gradient = _joined(shape, R, head, part)
            size = np.maximum(np.einsum("nk,nk->n", gradient, gradient), 1e-12)
            step = ((THRESHOLD - G) / size)[:, None] * gradient
            part += step * np.minimum(1.0, LONGEST_STEP_M / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
    return found


def _joined(shape: BodyShape, R: np.ndarray, head: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """G (N,) and ∇G (N, 3).  (1)"""
    total, slope = np.zeros(len(points)), np.zeros((len(points), 3))
    for part in body_parts(shape):
        F, gradient, _, _ = field_and_derivatives(_balls_of(shape.metaballs, part.bones), shape.lengths_m, R, head, points)
        total += F**BLEND_POWER
        slope += (F ** (BLEND_POWER - 1))[:, None] * gradient
    G = total ** (1 / BLEND_POWER)
    return G, slope / np.maximum(G, 1e-12)[:, None] ** (BLEND_POWER - 1)


def _balls_of(balls: Metaballs, bones: tuple[int, ...]) -> Metaballs:
    own = np.isin(balls.bone_index, bones)
    return Metaballs(bone_index=balls.bone_index[own], centre=balls.centre[own], radii_m=balls.radii_m[own], weight=balls.weight[own])


def shared_weights(points: np.ndarray, quads: np.ndarray, skin: Skin) -> np.ndarray:
    """The share (N, B) of every bone in the vertices (N, 3) of a mesh of quads (K, 4) in the posture of `skin`; rows sum to 1."""
    distance, near = cKDTree(skin.vertices_m).query(points, k=NEAREST)
    closeness = 1.0 / np.maximum(distance, 1e-4)
    weights = np.einsum("nk,nkb->nb", closeness, skin.weights[near]) / closeness.sum(axis=1, keepdims=True)
    ends = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)])
    both = np.concatenate([ends, ends[:, ::-1]])
    joined = sparse.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), (len(points), len(points)))
    joined.data[:] = 1.0
    mean = sparse.diags(1.0 / np.maximum(np.asarray(joined.sum(axis=1)).ravel(), 1.0)) @ joined
    edge = float(np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1).mean())
    for _ in range(round(2 * (SMOOTHED_M / edge) ** 2)):
        weights = 0.5 * weights + 0.5 * (mean @ weights)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
