"""Edges at which the normals of neighbouring quads differ by more than `LARGEST_TURN`, and what is done about them.

A relief moves both sides of a fold, as at an armpit, towards each other until they meet, and narrow quads make the fairing unstable
there. Where quads would fold, the displacement is halved, with a smooth transition, until none does (`without_folds`), and the fairing is
left out (`faired_outside_folds`). Elsewhere an edge is a ledge of a few millimetres, or a quad too long for the surface: its surroundings
move half way to the means of their neighbours until no edge turns too much (`eased`), which costs the shape less than a wider fairing.
"""

from typing import TYPE_CHECKING

import numpy as np

from .closed_skin import beyond_edges, flipped, mean_of_neighbours

if TYPE_CHECKING:
    from scipy import sparse

LARGEST_TURN = np.radians(11.9)  # [rad] that an edge keeps
FOLDING = np.radians(45.0)  # more turn than before: a fold
UNSTABLE = np.radians(15.0)  # more turn than before the fairing
HALVINGS = 8
EASING_STEPS = 80
COARSE = 0.05  # share of edges that turn more: the mesh is too coarse for the surface
EASING_RING = 40  # steps after which another ring of vertices moves
FOLD_RINGS = 2  # about a fold in which the displacement is halved, one more after two rounds …
UNFAIRED_RINGS = 8  # … and in which the skin is not faired
BLURRED = 3  # rings of the transition


def turns(vertices: np.ndarray, faces: np.ndarray, beyond: np.ndarray) -> np.ndarray:
    """Angles (F, 4) between the normals of the quads and those `beyond` their edges (F, 4)."""
    corner = vertices[faces]
    normal = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.asarray(np.arccos(np.clip(np.einsum("fk,fik->fi", normal, normal[beyond]), -1.0, 1.0)))


def without_folds(vertices: np.ndarray, faces: np.ndarray, displacement: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The displacements (V,) of vertices in the directions `along` (V, 3), smaller where quads would fold."""
    beyond, near, found = beyond_edges(faces)[0], mean_of_neighbours(faces, len(vertices)), displacement.copy()
    before = turns(vertices, faces, beyond)
    for step in range(HALVINGS):
        moved = vertices + found[:, None] * along
        folded = (turns(moved, faces, beyond) - before > FOLDING).any(axis=1) | flipped(moved, faces)
        if not folded.any():
            break
        found *= 1 - 0.5 * _around(near, faces[folded], FOLD_RINGS + step // 2)
    return found


def faired_outside_folds(vertices: np.ndarray, faces: np.ndarray, fair: np.ndarray) -> np.ndarray:
    """The `fair` vertices (V, 3), but those before the fairing where it turned edges."""
    beyond = beyond_edges(faces)[0]
    unstable = (turns(fair, faces, beyond) - turns(vertices, faces, beyond) > UNSTABLE).any(axis=1) | flipped(fair, faces)
    if not unstable.any():
        return fair
    share = _around(mean_of_neighbours(faces, len(vertices)), faces[unstable], UNFAIRED_RINGS)
    return np.asarray(fair + share[:, None] * (vertices - fair))


def eased(vertices: np.ndarray, faces: np.ndarray, may: np.ndarray, earlier: np.ndarray | None = None) -> np.ndarray:
    """Vertices (V, 3): those that `may` move (V,), near edges that turn too much, moved to their neighbours' means.

    Edges that turned as much in `earlier` vertices (V, 3), which were eased, stay.
    So does a mesh that is too coarse for its surface: it would shrink.
    """
    beyond, near = beyond_edges(faces)[0], mean_of_neighbours(faces, len(vertices))
    found, allowed = np.array(vertices), may[faces].all(axis=1)
    limit = LARGEST_TURN if earlier is None else np.maximum(LARGEST_TURN, 1.001 * turns(earlier, faces, beyond))
    if (turns(found, faces, beyond)[allowed] > LARGEST_TURN).sum() > COARSE * 4 * allowed.sum():
        return found
    for step in range(EASING_STEPS):
        sharp = (turns(found, faces, beyond) > limit).any(axis=1) & allowed
        if not sharp.any():
            break
        share = _around(near, faces[sharp], step // EASING_RING, blurred=2) * may
        rows = np.flatnonzero(share > 1e-3)
        found[rows] += 0.5 * share[rows, None] * (near[rows] @ found - found[rows])
    return found


def _around(near: "sparse.csr_matrix", chosen: np.ndarray, rings: int, blurred: int = BLURRED) -> np.ndarray:
    """(V,) 1 at the chosen vertices (numbers, of any shape) and so many rings around them, and from there smoothly to 0."""
    found = np.zeros(near.shape[0])
    found[chosen] = 1.0
    for _ in range(rings):
        found = np.maximum(found, near @ found > 0)
    for _ in range(blurred):
        found = near @ found
    return np.asarray(found)
