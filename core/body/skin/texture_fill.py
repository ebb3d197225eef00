"""Colours of what no view showed: those of the body's other side, of its front on its back, and a smooth continuation of what is left.

A texel at X with normal n gets the colour of a known one, that is nearest to

    X mirrored in x = 0, within 3 cm across the surface and d along it, with a like normal                  (1)
    X but for how far ahead it is, on the other face, front or back, of the same part, within 2 d           (2)

with d = 5 mm and a texel's width: the nearest at the end of what is known would be drawn out into bands. In (2) the normal counts, too,
reflected in the direction ahead, a difference of 1 like 2 cm: seen from ahead, all places of a flank are one. To this is added
a smooth difference h that fades over r = 3 cm, so that no edge is left where known colours c end (after Pérez, Gangnet & Blake 2003,
Poisson image editing, ACM ToG 22(3)), with Δ the Laplace–Beltrami operator of the skin:

    c(X) = c(source of X) + h(X) ,   Δh = h/r² ,   h = c − c(source) at known texels                         (3)

Known are the texels that were seen, and in (2) those of (1), too. A head has no second face: (2) leaves it out. What is still missing has
colours with Δc = 0. A limb alone has no other side.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from ...foundation.progress import Monitor
from ...foundation.threads import THREADS
from .closed_skin import OneSkin
from .ends import HEAD
from .surface_operators import factorised, laplacian, vertex_normals

FARTHEST_M = 0.03  # of a source from where it is looked for …
BESIDE_M = 0.005  # … and a texel's width, along the surface: the nearest at the end of what is known would be repeated again and again
NORMAL_M = 0.02  # that counts like a difference of 1 between normals, in (2)
LIKE = 0.3  # cosine between normals that are alike
FADING_M = 0.03  # r of (3)
HEADS = 0.5  # weight of the head in what is the head's
STIFF, WEAK = 100.0, 1e-6  # ties of vertices with known values to these, and of all to the mean
PLAIN = 127.0  # grey, where nothing was seen
Sources = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Texels:
    """N texels of a skin in the rest pose."""

    skin: OneSkin
    corners: np.ndarray  # (N, 3) vertices around each
    shares: np.ndarray  # (N, 3) and their weights
    ahead: np.ndarray  # (3,) where the body looks

    def at(self, values: np.ndarray, rows: "slice | np.ndarray" = slice(None)) -> np.ndarray:
        """Values (V, …) of the vertices at the texels (N, …), or at some of them."""
        corners, shares = self.corners[rows].T, self.shares[rows].T.reshape(3, -1, *[1] * (values.ndim - 1))
        first, *others = (share * values.take(corner, axis=0) for corner, share in zip(corners, shares))
        for other in others:
            first += other
        return np.asarray(first)

    @property
    def vertex(self) -> np.ndarray:
        """(N,) the vertex that is nearest to each."""
        return np.asarray(self.corners[np.arange(len(self.corners)), self.shares.argmax(axis=1)])


def filled(texels: Texels, colour: np.ndarray, seen: np.ndarray, monitor: Monitor) -> np.ndarray:
    """The colours (N, C) of all texels, from those that were `seen` (N,). 2 s for a whole body and 700,000 texels.

    Raises:
        Cancelled: the monitor was cancelled.
    """
    if not seen.any():
        return np.full(colour.shape, PLAIN)
    skin = texels.skin
    low, high = colour[seen].min(axis=0), colour[seen].max(axis=0)
    places, normals = texels.at(skin.vertices_m), texels.at(vertex_normals(skin.vertices_m, skin.faces))
    from_ahead = places - np.outer(places @ texels.ahead, texels.ahead)
    reflected = normals - 2 * np.outer(normals @ texels.ahead, texels.ahead)
    head = texels.at(skin.weights[:, [name == HEAD for name in skin.bone_names]].sum(axis=1)) > HEADS
    face = np.where(head, -1, 2 * skin.part[texels.vertex] + (normals @ texels.ahead > 0))
    of_vertices = _nearest_texels(texels)
    beside_m = BESIDE_M + float(np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    ways: list[Sources] = [partial(_other_face, from_ahead, normals, reflected, face, 2 * beside_m)]
    if not skin.rays:
        ways.insert(0, partial(_other_side, places, normals, beside_m))
    found, known = colour.copy(), seen.copy()
    for sources in ways:
        rows = np.flatnonzero(known)
        wanted, common = np.flatnonzero(~known), of_vertices[known[of_vertices]]
        monitor.check()
        source = sources(rows, wanted)
        monitor.check()
        check = sources(rows, common)
        monitor.check()
        wanted, source, common, check = wanted[source >= 0], source[source >= 0], common[check >= 0], check[check >= 0]
        h = _continued(texels, wanted, common, found[common] - found[check], np.zeros(colour.shape[1]), FADING_M)  # (3)
        found[wanted] = np.clip(found[source] + h, low, high)
        known[wanted] = True
    monitor.check()
    rows, missing = np.flatnonzero(known), np.flatnonzero(~known)
    found[missing] = _continued(texels, missing, rows, found[rows], found[rows].mean(axis=0))
    return found


def _other_side(places: np.ndarray, normals: np.ndarray, beside_m: float, known: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The sources (M,) of (1), not farther along the surface, among the texels `known` (K,), of the texels `wanted` (M,); −1: none.
    `places`, `normals` (N, 3)."""
    flip = np.array([-1.0, 1.0, 1.0])
    source = known[_nearest(places[known], flip * places[wanted])]
    like = np.einsum("nk,nk->n", normals[source], flip * normals[wanted]) > LIKE
    apart = places[source] - flip * places[wanted]
    beside = apart - np.einsum("nk,nk->n", apart, normals[source])[:, None] * normals[source]
    near = np.linalg.norm(beside, axis=1) <= beside_m
    return np.where(near & like, source, -1)


def _other_face(
    from_ahead: np.ndarray,
    normals: np.ndarray,
    reflected: np.ndarray,
    face: np.ndarray,
    beside_m: float,
    known: np.ndarray,
    wanted: np.ndarray,
) -> np.ndarray:
    """As `_other_side`, of (2). `from_ahead` (N, 3): places without how far ahead they are; `reflected` (N, 3): normals, reflected in that
    direction; `face` (N,): twice the number of the part, one more in front; negative: none."""
    found = np.full(len(wanted), -1)
    for own in np.unique(face[wanted]):
        there, here = known[face[known] == (own ^ 1)], wanted[face[wanted] == own]
        if own >= 0 and len(there):
            looked_for = np.hstack([from_ahead[here], NORMAL_M * reflected[here]])
            source = there[_nearest(np.hstack([from_ahead[there], NORMAL_M * normals[there]]), looked_for)]
            near = np.linalg.norm(from_ahead[source] - from_ahead[here], axis=1) <= beside_m
            found[face[wanted] == own] = np.where(near, source, -1)
    return found


def _nearest_texels(texels: Texels) -> np.ndarray:
    """One texel of each vertex that has any: the nearest."""
    order = np.argsort(-texels.shares.max(axis=1), kind="stable")
    return np.asarray(order[np.unique(texels.vertex[order], return_index=True)[1]])


def _nearest(points: np.ndarray, to: np.ndarray) -> np.ndarray:
    """The rows (M,) of the nearest of points (N, K) `to` others (M, K), any row where none is near enough."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)  # on a surface, a quarter of the time of a balanced one
    return np.minimum(tree.query(to, distance_upper_bound=FARTHEST_M, workers=THREADS)[1], len(points) - 1)


def _continued(
    texels: Texels, wanted: np.ndarray, rows: np.ndarray, values: np.ndarray, far: np.ndarray, fading_m: float = np.inf
) -> np.ndarray:
    """Values (K, C) at the texels `wanted` that continue those (M, C) of the texels `rows` smoothly and pass to `far` (C,)."""
    from scipy import sparse

    skin, count = texels.skin, len(texels.skin.vertices_m)
    vertex = texels.vertex[rows]
    times = np.bincount(vertex, minlength=count)
    total = np.stack([np.bincount(vertex, value, count) for value in values.T], axis=1)
    C, area = laplacian(skin.vertices_m, skin.faces)
    tie, loose = STIFF * (times > 0), WEAK + area / fading_m**2
    right = tie[:, None] * total / np.maximum(times, 1)[:, None] + loose[:, None] * far
    return texels.at(factorised(sparse.diags(tie + loose) - C).solve(right), wanted)
