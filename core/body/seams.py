"""Seams of a skin in one piece without an edge: where limbs leave a trunk the normal turns no more suddenly than beside.

The jump at an edge between two parts is by how much the normal turns over it, less the mean of its turns over the two edges beside (those
opposite to it in both quads): what is left of the turn when the surface is only round there. Where thighs touch, the surface has a crease,
100° and more within a millimetre. About an edge that jumps the mesh becomes a thin plate, tied to where it was,

    Σ |x_i − Σ_j x_j/e_ij / Σ_j 1/e_ij|² + w⁻⁴ Σ |x_i − its place|² → min                                  (1)

with e_ij the lengths of the edges to its neighbours (Desbrun, Meyer, Schröder & Barr 1999, SIGGRAPH; Botsch & Kobbelt 2004, ACM ToG 23(3)):
bends of less than w quads go. That is done anew, from wider about, until none jumps; of rounds that do not end so the best is taken in
which no quad folds. Places that left the surface before (folds) are not tied. Neighbours that count alike would do away with the crease by
spreading its narrow quads: a gap of 2 mm would be bridged by 20.
"""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import spsolve

LARGEST_JUMP = np.radians(4.8)
WIDTH = 1.5  # w of (1) in quads
RINGS = 5  # so many quads about an edge that jumps are the plate …
WIDER_AFTER = 3  # … and one more after so many rounds
ROUNDS = 18
SHORTEST_M = 1e-4  # of the edges in (1)
FOLD = 0.4  # cosine: a face that stands so steeply on what is about its corners is in a fold


def mean_of_neighbours(faces: np.ndarray, count: int) -> sparse.csr_matrix:
    """(V, V): of values at `count` vertices, the mean of those that an edge joins to each."""
    ends = np.concatenate([faces[:, [i, (i + 1) % 4]] for i in range(4)])
    both = np.concatenate([ends, ends[:, ::-1]])
    joined = sparse.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), (count, count))
    joined.data[:] = 1.0
    return sparse.csr_matrix(sparse.diags(1.0 / np.maximum(np.asarray(joined.sum(axis=1)).ravel(), 1.0)) @ joined)


def within(near: sparse.csr_matrix, chosen: np.ndarray, rings: int) -> np.ndarray:
    """Which vertices are at most so many edges from the chosen ones."""
    found = chosen.astype(np.float64)
    for _ in range(rings):
        found = np.maximum(found, near @ found > 0)
    return np.flatnonzero(found)


def seam_jumps(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> np.ndarray:
    """The jumps (F, 4) at the edges of the quads [rad], 0 at those that are no border of two parts. `part` (V,)."""
    beyond, edge = _beyond(faces)
    corner = vertices[faces]
    normal = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    middle = corner.mean(axis=1)
    turn = np.arccos(np.clip(np.einsum("fk,fik->fi", normal, normal[beyond]), -1.0, 1.0))
    turn *= np.sign(np.einsum("fk,fik->fi", normal, middle[beyond] - middle[:, None]))  # valleys positive
    beside = (np.roll(turn, -2, axis=1) + turn[beyond, (edge + 2) % 4]) / 2
    own = _most_frequent(part[faces])
    return np.asarray(np.where(own[:, None] != own[beyond], np.abs(turn - beside), 0.0))


def in_a_fold(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which faces (F,) stand steeply on the mean of the faces about one of their corners."""
    corner = vertices[faces]
    normal = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    mean = np.stack([np.bincount(faces.ravel(), np.repeat(normal[:, k], 4), len(vertices)) for k in range(3)], axis=1)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return np.asarray((np.einsum("fk,fck->fc", normal, mean[faces]) < FOLD).any(axis=1))


def turned_over(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which quads (F,) look, at one of their corners, away from what is about that corner: flipped ones, and those folded in themselves."""
    corner = vertices[faces]
    normal = np.cross(np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-12)
    mean = np.stack([np.bincount(faces.ravel(), normal[..., k].ravel(), len(vertices)) for k in range(3)], axis=1)[faces]
    whole = np.broadcast_to(normal.sum(axis=1, keepdims=True), normal.shape)
    return np.asarray(((np.einsum("fck,fck->fc", normal, mean) <= 0) | (np.einsum("fck,fck->fc", whole, mean) <= 0)).any(axis=1))


def faired(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, tied: np.ndarray) -> np.ndarray:
    """Vertices (V, 3), moved about edges between parts (V,) that jump by more than `LARGEST_JUMP`; `tied` (V,) 0 to 1.  (1)"""
    found = best = np.array(vertices)
    least, near, rough = np.inf, mean_of_neighbours(faces, len(found)), np.zeros(len(found), dtype=bool)
    troubled = _troubled(found, faces)
    for step in range(ROUNDS):
        jumps = seam_jumps(found, faces, part)
        if jumps.max() < least and (_troubled(found, faces) <= troubled).all():
            best, least = found.copy(), jumps.max()
        if least <= LARGEST_JUMP:
            break
        jumping = np.isin(np.arange(len(found)), faces[(jumps > LARGEST_JUMP).any(axis=1)])
        rough |= jumping
        moved = _reached_from(near, within(near, rough, RINGS + step // WIDER_AFTER), jumping)
        found[moved] = _plate(found, faces, within(near, np.isin(np.arange(len(found)), moved), 1), moved, WIDTH**-4 * tied[moved])
    return best


def _reached_from(near: sparse.csr_matrix, among: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Those `among` the vertices that hang together, by edges between them, with `chosen` (V,) ones."""
    _, piece = csgraph.connected_components(near[among][:, among], directed=False)
    return np.asarray(among[np.isin(piece, piece[chosen[among]])])


def _troubled(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(2,) how many quads are turned over, and how many in a fold."""
    return np.array([turned_over(vertices, faces).sum(), in_a_fold(vertices, faces).sum()])


def _plate(vertices: np.ndarray, faces: np.ndarray, rows: np.ndarray, moved: np.ndarray, ties: np.ndarray) -> np.ndarray:
    """(M, 3): where (1) over the vertices `rows` has those `moved` (M,), with `ties` (M,) to their places; all others stay."""
    ends = np.concatenate([faces[:, [i, (i + 1) % 4]] for i in range(4)])
    ends = ends[np.isin(ends[:, 0], rows)]  # both ways round: every edge has two quads
    count = len(vertices)
    nearness = 1 / np.maximum(np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1), SHORTEST_M)
    joined = sparse.csr_matrix((nearness, (ends[:, 0], ends[:, 1])), (count, count))[rows]
    mean = sparse.diags(1 / np.asarray(joined.sum(axis=1)).ravel()) @ joined
    bending = sparse.csr_matrix(sparse.identity(count, format="csr")[rows] - mean)
    free = bending[:, moved]
    normal = sparse.csc_matrix(free.T @ free + sparse.diags(ties))
    return np.asarray(vertices[moved] - spsolve(normal, free.T @ (bending @ vertices)))


def _beyond(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The quad beyond each edge (F, 4), and which of its edges that is (F, 4); every edge has two quads."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    pairs = np.lexsort(ends.T).reshape(-1, 2)
    other = np.empty(len(ends), dtype=np.int64)
    other[pairs[:, 0]], other[pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
    return (other // 4).reshape(faces.shape), (other % 4).reshape(faces.shape)


def _most_frequent(values: np.ndarray) -> np.ndarray:
    """Of each row (F, 4) the value that is in it most often, the least of several."""
    ordered = np.sort(values, axis=1)
    times = (ordered[:, :, None] == ordered[:, None, :]).sum(axis=2)
    return np.asarray(np.take_along_axis(ordered, times.argmax(axis=1)[:, None], axis=1)[:, 0])
