"""The skin of a body as one closed mesh, built like a modeller's: rings of quads along the limbs, sewn into the trunk's.

    skin of the parts ── sewn together (welding) ──▶ vertices near the seams relaxed on the surface of the whole body

Relaxation: between Newton's steps onto the surface (whole_surface) a vertex near a seam moves half way to the mean of its neighbours.
The bones' weights are those of the parts, smoothed near the seams, or the skin would tear where a part ends. Where the surface of the
whole body folds near a seam (thighs that touch, an arm close to the flank), the mesh leaves it and bridges the fold smoothly. If a quad
near a seam is flipped in spite of this, its surroundings are relaxed until none is; edges along seams are rounded (1). Where contours
across the trunk miss horizontal surfaces, under a chin, vertices are relaxed along the surface.

Seams without an edge: where limbs leave the trunk, the normal turns no more abruptly than nearby.

The jump at an edge between two parts is the turn of the normal over it, less the mean of the turns over the two adjacent edges (those
opposite to it in both quads): zero where the surface is merely curved. Where thighs touch, the surface has a crease, 100° and more within
a millimetre. Near an edge with a jump the mesh becomes a thin plate, tied to its earlier position x⁰,

    Σ |x_i − Σ_j x_j/e_ij / Σ_j 1/e_ij|² + w⁻⁴ Σ |x_i − x⁰_i|² → min                                        (1)

with e_ij the lengths of the edges to its neighbours (Desbrun, Meyer, Schröder & Barr 1999, SIGGRAPH; Botsch & Kobbelt 2004, ACM ToG 23(3)):
it removes bends shorter than w quads. This is repeated over growing neighbourhoods until no edge jumps; if some remain, the best round
without folded quads is used. Vertices that left the surface before (folds) are not tied. Equal weights of the neighbours would remove the
crease by spreading its narrow quads: a gap of 2 mm would be bridged by 20.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...foundation.arrays import frozen
from ...geometry.rotation import cross
from ..parts import body_parts
from ..shape import BodyShape
from .contour_skin import body_skin, strongest
from .ends import caged, rounded
from .limb_weights import with_limb_borders, with_neck
from .mesh import SkinSettings, corner_uv, refined
from .welding import cut, welded
from .whole_surface import WholeSurface

if TYPE_CHECKING:
    from scipy import sparse

LARGEST_JUMP = np.radians(4.8)  # [rad]
WIDTH = 1.5  # w of (1) in quads
RINGS = 5  # quads of the plate about an edge with a jump …
WIDER_AFTER = 3  # … and rounds after which there is one more
ROUNDS = 18
SHORTEST_M = 1e-4  # least edge length in (1)
FOLD = 0.4  # cosine between a face's normal and the mean normal at a corner, below which the face is in a fold


def mean_of_neighbours(faces: np.ndarray, count: int) -> "sparse.csr_matrix":
    """(V, V): the mean of the values at the neighbours of each of `count` vertices."""
    from scipy import sparse

    ends = np.concatenate([faces[:, [i, (i + 1) % 4]] for i in range(4)])
    both = np.concatenate([ends, ends[:, ::-1]])
    joined = sparse.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), (count, count))
    joined.data[:] = 1.0
    return sparse.csr_matrix(sparse.diags(1.0 / np.maximum(np.asarray(joined.sum(axis=1)).ravel(), 1.0)) @ joined)


def within(near: "sparse.csr_matrix", chosen: np.ndarray, rings: int) -> np.ndarray:
    """The vertices at most `rings` edges from the chosen ones."""
    found = chosen.astype(np.float64)
    for _ in range(rings):
        found = np.maximum(found, near @ found > 0)
    return np.flatnonzero(found)


def seam_jumps(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> np.ndarray:
    """The jumps (F, 4) at the edges of the quads [rad], 0 at those that are no border of two parts. `part` (V,)."""
    beyond, edge = beyond_edges(faces)
    normal, middle = face_normals(vertices, faces), vertices[faces].mean(axis=1)
    turn = np.arccos(np.clip(np.einsum("fk,fik->fi", normal, normal[beyond]), -1.0, 1.0))
    turn *= np.sign(np.einsum("fk,fik->fi", normal, middle[beyond] - middle[:, None]))  # valleys positive
    nearby = (np.roll(turn, -2, axis=1) + turn[beyond, (edge + 2) % 4]) / 2
    own = _most_frequent(part[faces])
    return np.asarray(np.where(own[:, None] != own[beyond], np.abs(turn - nearby), 0.0))


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Outward unit normals (F, 3) of quads."""
    a, b, c, d = (vertices[faces[:, i]] for i in range(4))
    normal = cross(c - a, d - b)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))


def in_a_fold(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces (F,) that are steep to the mean of the faces around one of their corners."""
    normal = face_normals(vertices, faces)
    mean = np.stack([np.bincount(faces.ravel(), np.repeat(normal[:, k], 4), len(vertices)) for k in range(3)], axis=1)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return np.asarray((np.einsum("fk,fck->fc", normal, mean[faces]) < FOLD).any(axis=1))


def flipped(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The quads (F,) that, at one of their corners, face away from the surface around it: flipped ones, and those folded in themselves."""
    corners = [vertices[faces[:, i]] for i in range(4)]
    edges = [after - corner for corner, after in zip(corners, corners[1:] + corners[:1])]
    normals = [cross(before, edge) for before, edge in zip(edges[-1:] + edges[:-1], edges)]
    normals = [n / np.maximum(np.sqrt(np.einsum("fk,fk->f", n, n)), 1e-12)[:, None] for n in normals]
    stacked, whole = np.concatenate(normals), sum(normals)
    mean = np.stack([np.bincount(faces.T.ravel(), stacked[:, k], len(vertices)) for k in range(3)], axis=1)
    away = [
        (np.einsum("fk,fk->f", own, mean[faces[:, i]]) <= 0) | (np.einsum("fk,fk->f", whole, mean[faces[:, i]]) <= 0)
        for i, own in enumerate(normals)
    ]
    return np.asarray(np.any(away, axis=0))


def faired(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, tied: np.ndarray) -> np.ndarray:
    """Vertices (V, 3), moved about edges between parts (V,) that jump by more than `LARGEST_JUMP`; `tied` (V,) 0 to 1.  (1)"""
    found = best = np.array(vertices)
    least, near, rough = np.inf, mean_of_neighbours(faces, len(found)), np.zeros(len(found), dtype=bool)
    at_first = _defects(found, faces)
    for step in range(ROUNDS):
        jumps = seam_jumps(found, faces, part)
        if jumps.max() < least and (_defects(found, faces) <= at_first).all():
            best, least = found.copy(), jumps.max()
        if least <= LARGEST_JUMP:
            break
        jumping = np.isin(np.arange(len(found)), faces[(jumps > LARGEST_JUMP).any(axis=1)])
        rough |= jumping
        moved = _reached_from(near, within(near, rough, RINGS + step // WIDER_AFTER), jumping)
        found[moved] = _plate(found, faces, within(near, np.isin(np.arange(len(found)), moved), 1), moved, WIDTH**-4 * tied[moved])
    return best


def _reached_from(near: "sparse.csr_matrix", among: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Those `among` the vertices that edges between them connect to `chosen` (V,) ones."""
    from scipy.sparse import csgraph

    _, piece = csgraph.connected_components(near[among][:, among], directed=False)
    return np.asarray(among[np.isin(piece, piece[chosen[among]])])


def _defects(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(2,) the number of flipped quads, and of quads in a fold."""
    return np.array([flipped(vertices, faces).sum(), in_a_fold(vertices, faces).sum()])


def _plate(vertices: np.ndarray, faces: np.ndarray, rows: np.ndarray, moved: np.ndarray, ties: np.ndarray) -> np.ndarray:
    """Positions (M, 3) of the vertices `moved` (M,) that minimise (1) over the vertices `rows`, with the weights `ties` (M,)."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

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


def beyond_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The quad beyond each edge (F, 4), and which of its edges that is (F, 4); every edge has two quads."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    pairs = np.lexsort(ends.T).reshape(-1, 2)
    other = np.empty(len(ends), dtype=np.int64)
    other[pairs[:, 0]], other[pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
    return (other // 4).reshape(faces.shape), (other % 4).reshape(faces.shape)


def _most_frequent(values: np.ndarray) -> np.ndarray:
    """The most frequent value of each row (F, 4), the smallest of several."""
    ordered = np.sort(values, axis=1)
    times = (ordered[:, :, None] == ordered[:, None, :]).sum(axis=2)
    return np.asarray(np.take_along_axis(ordered, times.argmax(axis=1)[:, None], axis=1)[:, 0])


SEAM_RINGS = 4  # quads on either side of a seam that are relaxed
SPARSE_M = 0.005  # quads whose middle is farther from the surface are relaxed, too
RELAXING_STEPS = 40
UNTANGLING_STEPS = 30  # the first of them, which move vertices also across the surface
CUT_STEPS = 2  # Newton's, from the middle of an edge or quad: a millimetre
UNFOLDING_STEPS = 40
LOOSE_RINGS = 4  # quads over which the mesh returns to the surface
UNFLIPPING_STEPS = 200  # at most
UNFLIPPING_RING = 20  # steps after which another ring is relaxed
SMOOTHED_M = 0.03  # distance over which weights are smoothed, about


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class OneSkin:
    """One closed mesh of quads, outside counter-clockwise."""

    vertices_m: np.ndarray  # (V, 3) world
    faces: np.ndarray  # (F, 4)
    uv: np.ndarray  # (F, 4, 2) of the faces' corners in 0…1: around the bones and along them, an island a part
    weights: np.ndarray  # (V, B) of each bone of the skeleton in a vertex; rows sum to 1
    part: np.ndarray  # (V,) index in `body_parts` of the part to which a vertex belongs
    bone_names: tuple[str, ...]
    pieces: int = 1  # per edge of the cage; if sewn from several chains, the faces of each quad of the cage follow each other, row by row
    rays: int = 0  # vertices on each contour of a mesh of one chain; 0: sewn from several
    relief_m: np.ndarray | None = None  # (V,) measured displacement along the normals, and the standard deviation of where the surface is
    sigma_m: np.ndarray | None = None

    def __post_init__(self) -> None:
        v, f = len(self.vertices_m), len(self.faces)
        for name in ("relief_m", "sigma_m"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, frozen(value, (v,), name=name))
        object.__setattr__(self, "vertices_m", frozen(self.vertices_m, (v, 3), name="vertices_m"))
        object.__setattr__(self, "faces", frozen(self.faces, (f, 4), np.int64, "faces"))
        object.__setattr__(self, "uv", frozen(self.uv, (f, 4, 2), name="uv"))
        object.__setattr__(self, "part", frozen(self.part, (v,), np.int64, "part"))
        object.__setattr__(self, "weights", frozen(self.weights, (v, len(self.bone_names)), name="weights"))


def one_skin(shape: BodyShape, settings: SkinSettings, detail: int = 1) -> OneSkin:
    """The skin of the rest pose in one piece; with `detail` above 1 every edge is cut into so many pieces, on the surface.

    A body of one chain has the closed mesh of that chain, refined by B-spline patches where `settings` or `detail` ask for them; a whole
    body's vertices are on the surface itself at any detail, except in folds near its seams. A whole body has 10,000 quads and takes 1.5 s.

    Raises:
        InputError: there are no metaballs, or the number of rays is odd.
    """
    rest = np.zeros(len(shape.skeleton.dof_names))
    if len(body_parts(shape)) == 1:
        return _of_one_chain(shape, settings, detail)
    skin = body_skin(shape, rest, SkinSettings(contours=settings.contours, rays=settings.rays, cap_contours=settings.cap_contours))
    surface = WholeSurface(shape, rest)
    whole = caged(welded(skin, body_parts(shape), surface), shape)
    faces, uv, part = whole.faces, whole.uv, whole.part
    near = mean_of_neighbours(faces, len(whole.vertices_m))
    free = within(near, whole.sewn, SEAM_RINGS)
    coarse = _sparse(whole.vertices_m, faces, part, surface) & ~whole.end
    uneven = np.setdiff1d(np.union1d(free, within(near, coarse, SEAM_RINGS)), np.flatnonzero(whole.end))
    vertices, loose = _unfolded(_relaxed(whole.vertices_m, near, uneven, free, part, surface), faces, near, free)
    weights = with_neck(shape, vertices, faces, with_limb_borders(shape, vertices, part, whole.weights))
    weights = _smoothed(weights, vertices, faces, near, free)
    kept = 1 - np.maximum(loose, whole.end)
    end = whole.end.astype(np.float64)
    for pieces in (settings.detail, detail):
        if pieces > 1:
            columns = np.column_stack([weights, 1 - kept, end])
            vertices, both, part, faces, uv = cut(vertices, columns, part, faces, uv, pieces)
            weights, kept, end = strongest(both[:, :-2]), 1 - both[:, -2], both[:, -1]
            vertices = rounded(vertices, faces, end > 0)
    if detail * settings.detail > 1:
        rows = np.flatnonzero(kept)
        vertices[rows] += kept[rows, None] * (surface.projected(vertices[rows], part[rows], CUT_STEPS) - vertices[rows])
    vertices = faired(unflipped(vertices, faces, np.ones(len(vertices), dtype=bool)), faces, part, kept)
    return OneSkin(vertices_m=vertices, faces=faces, uv=uv, weights=weights, part=part, bone_names=skin.bone_names, pieces=detail)


def _of_one_chain(shape: BodyShape, settings: SkinSettings, detail: int) -> OneSkin:
    skin = body_skin(shape, np.zeros(len(shape.skeleton.dof_names)), settings)
    skin = refined(skin, detail) if detail > 1 else skin
    return OneSkin(
        vertices_m=skin.vertices_m,
        faces=skin.faces,
        uv=corner_uv(skin),
        weights=skin.weights,
        bone_names=skin.bone_names,
        pieces=detail,
        rays=skin.rays,
        part=np.zeros(len(skin.vertices_m), dtype=np.int64),
    )


def _sparse(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, surface: WholeSurface) -> np.ndarray:
    """The vertices (V,) of the trunk at corners of quads too coarse for the surface, as under the chin above a short neck.

    None of limbs: relaxed, a thumb has fewer quads.
    """
    trunk = faces[(part[faces] == 0).all(axis=1)]
    found = np.zeros(len(vertices), dtype=bool)
    found[trunk[np.abs(surface.distance_m(vertices[trunk].mean(axis=1), np.zeros(len(trunk), dtype=np.int64))) > SPARSE_M]] = True
    return found


def _relaxed(
    vertices: np.ndarray, near: "sparse.csr_matrix", free: np.ndarray, sewn: np.ndarray, part: np.ndarray, surface: WholeSurface
) -> np.ndarray:
    """Vertices (V, 3), the free ones relaxed on the surface; those near a seam first in all directions."""
    found, part = vertices.copy(), part[free]
    along, towards = np.flatnonzero(~np.isin(free, sewn)), np.arange(len(free))
    for i in range(RELAXING_STEPS if len(free) else 0):
        step = 0.5 * (near[free] @ found - found[free])
        rows = along if i < UNTANGLING_STEPS else towards
        normals = surface.normals(found[free[rows]], part[rows])
        step[rows] -= np.einsum("nk,nk->n", step[rows], normals)[:, None] * normals
        found[free] = surface.projected(found[free] + step, part, steps=1)
    found[free] = surface.projected(found[free], part)
    return found


def _unfolded(vertices: np.ndarray, faces: np.ndarray, near: "sparse.csr_matrix", free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) of which the free ones leave the surface where it folds, and the degree (V,), 0 to 1, to which each has left it."""
    found, may = vertices.copy(), np.isin(np.arange(len(vertices)), free)
    loose = np.zeros(len(vertices))
    for _ in range(UNFOLDING_STEPS):
        folded = np.zeros(len(vertices), dtype=bool)
        folded[faces[in_a_fold(found, faces) & may[faces].all(axis=1)]] = True
        if not folded.any():
            break
        moved = np.intersect1d(within(near, folded, 2), free)
        found[moved] = 0.5 * (found[moved] + near[moved] @ found)
        loose[moved] = 1.0
    for _ in range(LOOSE_RINGS):
        loose = np.maximum(loose, near @ loose)
    return found, loose


def unflipped(vertices: np.ndarray, faces: np.ndarray, may: np.ndarray) -> np.ndarray:
    """Vertices (V, 3): those that `may` move (V,), near flipped quads, move half way to their neighbours' mean until none is flipped."""
    found, near = np.array(vertices), None
    bad = flipped(found, faces)
    for step in range(UNFLIPPING_STEPS):
        chosen = bad & may[faces].all(axis=1)
        if not chosen.any():
            break
        near = mean_of_neighbours(faces, len(found)) if near is None else near
        moved = within(near, np.isin(np.arange(len(found)), faces[chosen]), 1 + step // UNFLIPPING_RING)
        moved = moved[may[moved]]
        found[moved] = 0.5 * (found[moved] + near[moved] @ found)
        _flipped_again(bad, found, faces, moved)
    return found


def _flipped_again(bad: np.ndarray, vertices: np.ndarray, faces: np.ndarray, moved: np.ndarray) -> None:
    """Renew `bad` (F,), the flipped quads, after some vertices moved: only quads about these can have changed."""
    near = np.zeros(len(vertices), dtype=bool)
    near[moved] = True
    rings = []
    for _ in range(3):  # the quads of the vertices, those whose mean normals they change, and those that these means are made of
        rings.append(np.flatnonzero(near[faces].any(axis=1)))
        near[faces[rings[-1]]] = True
    _, changed, around = rings
    bad[changed] = flipped(vertices, faces[around])[np.searchsorted(around, changed)]


def _smoothed(weights: np.ndarray, vertices: np.ndarray, faces: np.ndarray, near: "sparse.csr_matrix", free: np.ndarray) -> np.ndarray:
    found = weights.copy()
    edge = float(np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2).mean())
    for _ in range(round(2 * (SMOOTHED_M / edge) ** 2)):
        found[free] = 0.5 * found[free] + 0.5 * (near[free] @ found)
    return strongest(found)
