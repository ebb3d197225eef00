"""Edges at which the normals of neighbouring quads differ by more than `LARGEST_TURN`, and what is done about them.

A relief moves both sides of a fold, as at an armpit, towards each other until they meet, and narrow quads make the fairing unstable
there. Where quads would fold, the displacement is halved, with a smooth transition, until none does (`without_folds`), and the fairing is
left out (`faired_outside_folds`). A slit that is left, at the nape or in an armpit, is closed: the displacement from the skin before the
relief, which is smooth there, becomes biharmonic about it (`without_slits`),

    ‖M^(−½) C (x − x⁰)‖² → min                                                                              (1)

with M, C of surface_operators at x⁰. Elsewhere an edge is a ledge of a few millimetres, or a quad too long for the surface: its
surroundings move half way to the means of their neighbours until no edge turns too much (`eased`), which costs the shape less than a wider
fairing. Where that turns edges more, it is left out.
"""

from typing import TYPE_CHECKING

import numpy as np

from .closed_skin import beyond_edges, face_normals, flipped, mean_of_neighbours, within
from .surface_operators import factorised, laplacian

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
SLIT = np.radians(15.0)  # an edge of a slit turns by more, and by `SLACK` more than before the relief
SLACK = np.radians(3.0)
SLIT_RINGS = 4  # about a slit, which are made anew …
WIDER = 2  # … and so many more where that was not enough
SLIT_ROUNDS = 8


def turns(vertices: np.ndarray, faces: np.ndarray, beyond: np.ndarray) -> np.ndarray:
    """Angles (F, 4) between the normals of the quads and those `beyond` their edges (F, 4)."""
    normal = face_normals(vertices, faces)
    return _angles(normal, normal[beyond])


def _angles(normal: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Angles (F, 4) between unit normals (F, 3) and others (F, 4, 3)."""
    return np.asarray(np.arccos(np.clip(np.einsum("fk,fik->fi", normal, others), -1.0, 1.0)))


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


def without_slits(before: np.ndarray, vertices: np.ndarray, faces: np.ndarray, may: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) of which those that `may` (V,) follow the ones `before` (V, 3) about slits (1); none on a mesh that is too coarse."""
    beyond, near = beyond_edges(faces)[0], mean_of_neighbours(faces, len(vertices))
    limit, allowed = np.maximum(SLIT, turns(before, faces, beyond) + SLACK), may[faces].all(axis=1)
    if _too_coarse(vertices, faces, beyond, allowed):
        return vertices
    found = best = vertices
    least, moved, bend = len(faces), np.zeros(len(vertices), dtype=bool), None
    for step in range(SLIT_ROUNDS):
        sharp = ((turns(found, faces, beyond) > limit).any(axis=1) | flipped(found, faces)) & allowed
        if (count := int(sharp.sum())) < least:
            best, least = found, count
        if not count:
            break
        chosen = np.isin(np.arange(len(vertices)), faces[sharp])
        moved[within(near, chosen, SLIT_RINGS + WIDER * step)] = True
        moved &= may
        bend = _bending(before, faces) if bend is None else bend
        found = np.where(moved[:, None], before + _biharmonic(bend, vertices - before, moved), vertices)
    return best


def _bending(vertices: np.ndarray, faces: np.ndarray) -> "sparse.csr_matrix":
    """M^(−½) C (V, V) of (1)."""
    from scipy import sparse

    C, area = laplacian(vertices, faces)
    return sparse.csr_matrix(sparse.diags(area**-0.5) @ C)


def _biharmonic(bending: "sparse.csr_matrix", displacement: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The displacement (V, 3) with that of the vertices `free` (V,) as smooth as can be between the others'.  (1)"""
    rows, bend = np.flatnonzero(free), bending[within(bending != 0, free, 1)]
    own, fixed = bend[:, rows], np.where(free[:, None], 0.0, displacement)
    found = fixed.copy()
    found[rows] = factorised(own.T @ own).solve(-(own.T @ (bend @ fixed)))
    return found


def eased(vertices: np.ndarray, faces: np.ndarray, may: np.ndarray, earlier: np.ndarray | None = None) -> np.ndarray:
    """Vertices (V, 3): those that `may` move (V,), near edges that turn too much, moved to their neighbours' means.

    Edges that turned as much in `earlier` vertices (V, 3), which were eased, stay.
    So does a mesh that is too coarse for its surface: it would shrink.
    """
    beyond, near = beyond_edges(faces)[0], mean_of_neighbours(faces, len(vertices))
    found, allowed = np.array(vertices), may[faces].all(axis=1)
    limit = np.full(beyond.shape, LARGEST_TURN) if earlier is None else np.maximum(LARGEST_TURN, 1.001 * turns(earlier, faces, beyond))
    if _too_coarse(found, faces, beyond, allowed):
        return found
    touched = np.zeros(len(vertices), dtype=bool)
    normal = face_normals(found, faces)
    sharper = (_angles(normal, normal[beyond]) > limit).any(axis=1)
    for step in range(EASING_STEPS):
        sharp = sharper & allowed
        if not sharp.any():
            break
        share = _around(near, faces[sharp], step // EASING_RING, blurred=2) * may
        rows = np.flatnonzero(share > 1e-3)
        found[rows] += 0.5 * share[rows, None] * (near[rows] @ found - found[rows])
        touched[rows] = True
        changed = np.flatnonzero(np.isin(faces, rows).any(axis=1))
        normal[changed] = face_normals(found, faces[changed])
        again = np.union1d(changed, beyond[changed])
        sharper[again] = (_angles(normal[again], normal[beyond[again]]) > limit[again]).any(axis=1)
    return _where_better(vertices, found, faces, near, np.flatnonzero(touched))


def _too_coarse(vertices: np.ndarray, faces: np.ndarray, beyond: np.ndarray, among: np.ndarray) -> bool:
    """Whether too many edges of the faces `among` (F,) turn too much, as those of a mesh that is too coarse for its surface do."""
    return bool((turns(vertices, faces, beyond)[among] > LARGEST_TURN).sum() > COARSE * 4 * among.sum())


def _where_better(before: np.ndarray, after: np.ndarray, faces: np.ndarray, near: "sparse.csr_matrix", rows: np.ndarray) -> np.ndarray:
    """The vertices `after` (V, 3) that moved, `rows`, but those `before` in pieces whose edges turn more by then."""
    from scipy.sparse import csgraph

    if not len(rows):
        return after
    beyond, piece = beyond_edges(faces)[0], np.full(len(before), -1)
    piece[rows] = csgraph.connected_components(near[rows][:, rows], directed=False)[1]
    own = piece[faces].max(axis=1)
    worse = [np.maximum(turns(v, faces, beyond) - LARGEST_TURN, 0.0).sum(axis=1) for v in (before, after)]
    was, now = (np.bincount(own[own >= 0], w[own >= 0], piece.max() + 1) for w in worse)
    return np.where(((piece >= 0) & (now > was)[piece])[:, None], before, after)


def _around(near: "sparse.csr_matrix", chosen: np.ndarray, rings: int, blurred: int = BLURRED) -> np.ndarray:
    """(V,) 1 at the chosen vertices (numbers, of any shape) and so many rings around them, and from there smoothly to 0."""
    found = np.zeros(near.shape[0])
    found[chosen] = 1.0
    for _ in range(rings):
        found = np.maximum(found, near @ found > 0)
    for _ in range(blurred):
        found = near @ found
    return np.asarray(found)
