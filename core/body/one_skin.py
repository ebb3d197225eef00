"""The skin of a body as one closed mesh, as a modeller would have built it: rings of quads along the limbs, sewn into the trunk's.

    skin of the parts ── sewn together (welding) ──▶ vertices about the seams evened out, on the surface of the whole

Between Newton's steps that take it onto the surface (whole_surface) a vertex near a seam goes half way to the middle of its neighbours.
The bones' shares are those of the parts, smoothed about the seams, or the skin would tear where one part ends. Where the surface of
the whole folds near a seam (thighs that touch, an arm close to the flank), the mesh leaves it and goes smoothly over the fold. Where a quad
near a seam is turned over after all, what is about it is evened out until none is; edges along seams are rounded (seams). Where contours
across the trunk miss what lies level, under a chin, vertices are evened out along the surface.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..values import frozen
from .seams import faired, in_a_fold, mean_of_neighbours, turned_over, within
from .shape import BodyShape
from .skin import body_skin
from .skin_mesh import SkinSettings
from .skin_parts import body_parts
from .skin_patches import corner_uv, refined
from .skin_quads import cut, face_uv, net_faces
from .skin_weights import strongest
from .welding import welded
from .whole_surface import WholeSurface

DETAIL = 2  # of a scene: at 32 rays the quads are 0.15 to 0.25 mm RMS from the surface, with 1 they are 0.7, being flat
SEAM_RINGS = 4  # so many quads on either side of a seam are evened out
SPARSE_M = 0.005  # … and about quads whose middle is so far from the surface
EVENING_STEPS = 40
UNTANGLING_STEPS = 30  # the first of them, which move vertices also across the surface
CUT_STEPS = 2  # Newton's, from the middle of an edge or quad: a millimetre
UNFOLDING_STEPS = 40
LOOSE_RINGS = 4  # over so many quads the mesh comes back to the surface
MENDING_STEPS = 200  # at most
MENDING_RING = 20  # … and a ring more is evened out after so many
SMOOTHED_M = 0.03  # shares are smoothed over about this distance


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class OneSkin:
    """One closed mesh of quads, outside counter-clockwise."""

    vertices_m: np.ndarray  # (V, 3) world
    faces: np.ndarray  # (F, 4)
    uv: np.ndarray  # (F, 4, 2) of the faces' corners in 0…1: around the bones and along them, an island a part
    weights: np.ndarray  # (V, B) share of each bone of the skeleton in a vertex; rows sum to 1
    part: np.ndarray  # (V,) which of `body_parts` a vertex is a place of
    bone_names: tuple[str, ...]

    def __post_init__(self) -> None:
        v, f = len(self.vertices_m), len(self.faces)
        object.__setattr__(self, "vertices_m", frozen(self.vertices_m, (v, 3), name="vertices_m"))
        object.__setattr__(self, "faces", frozen(self.faces, (f, 4), np.int64, "faces"))
        object.__setattr__(self, "uv", frozen(self.uv, (f, 4, 2), name="uv"))
        object.__setattr__(self, "part", frozen(self.part, (v,), np.int64, "part"))
        object.__setattr__(self, "weights", frozen(self.weights, (v, len(self.bone_names)), name="weights"))


def one_skin(shape: BodyShape, settings: SkinSettings, detail: int = 1) -> OneSkin:
    """The skin of the rest posture in one piece; with `detail` above 1 every edge in so many pieces, on the surface.

    A body of one chain is its closed chain, by B-spline patches where `settings` or `detail` want them; a whole body's vertices are on the
    surface itself in any fineness, but for folds near its seams. A whole body has 10,000 quads and takes 1.5 s.

    Raises:
        InputError: there are no metaballs, or the number of rays is odd.
    """
    rest = np.zeros(len(shape.skeleton.dof_names))
    if len(body_parts(shape)) == 1:
        return _of_one_chain(shape, settings, detail)
    skin = body_skin(shape, rest, SkinSettings(contours=settings.contours, rays=settings.rays, cap_contours=settings.cap_contours))
    surface = WholeSurface(shape, rest)
    whole = welded(skin, body_parts(shape), surface)
    faces = np.concatenate([net_faces(net) for net in whole.nets])
    uv = face_uv(whole)
    near = mean_of_neighbours(faces, len(whole.vertices_m))
    free = within(near, whole.sewn, SEAM_RINGS)
    uneven = np.union1d(free, within(near, _sparse(whole.vertices_m, faces, whole.part, surface), SEAM_RINGS))
    vertices, loose = _unfolded(_evened(whole.vertices_m, near, uneven, free, whole.part, surface), faces, near, free)
    weights = _smoothed(whole.weights, vertices, faces, near, free)
    part, pieces, kept = whole.part, detail * settings.detail, 1 - loose
    seam = np.isin(np.arange(len(vertices)), free).astype(np.float64)
    if pieces > 1:
        vertices, both, part, faces, uv = cut(vertices, np.column_stack([weights, seam, loose]), part, faces, uv, pieces)
        weights, seam, kept = strongest(both[:, :-2]), both[:, -2], 1 - both[:, -1]
        vertices = vertices + kept[:, None] * (surface.reached(vertices, part, CUT_STEPS) - vertices)
    vertices = faired(_mended(vertices, faces, seam > 0), faces, part, kept)
    return OneSkin(vertices_m=vertices, faces=faces, uv=uv, weights=weights, part=part, bone_names=skin.bone_names)


def _of_one_chain(shape: BodyShape, settings: SkinSettings, detail: int) -> OneSkin:
    skin = body_skin(shape, np.zeros(len(shape.skeleton.dof_names)), settings)
    skin = refined(skin, detail) if detail > 1 else skin
    return OneSkin(
        vertices_m=skin.vertices_m,
        faces=skin.faces,
        uv=corner_uv(skin),
        weights=skin.weights,
        bone_names=skin.bone_names,
        part=np.zeros(len(skin.vertices_m), dtype=np.int64),
    )


def _sparse(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, surface: WholeSurface) -> np.ndarray:
    """Which vertices (V,) of the trunk are corners of quads that cut short what is between them, as under the chin above a short neck.

    Of limbs none: evened out, a thumb has fewer quads.
    """
    trunk = faces[(part[faces] == 0).all(axis=1)]
    found = np.zeros(len(vertices), dtype=bool)
    found[trunk[np.abs(surface.distance_m(vertices[trunk].mean(axis=1), np.zeros(len(trunk), dtype=np.int64))) > SPARSE_M]] = True
    return found


def _evened(
    vertices: np.ndarray, near: sparse.csr_matrix, free: np.ndarray, sewn: np.ndarray, part: np.ndarray, surface: WholeSurface
) -> np.ndarray:
    """Vertices (V, 3), the free ones evened out on the surface; those about a seam first in all directions."""
    found, part = vertices.copy(), part[free]
    along, towards = np.flatnonzero(~np.isin(free, sewn)), np.arange(len(free))
    for i in range(EVENING_STEPS if len(free) else 0):
        step = 0.5 * (near[free] @ found - found[free])
        rows = along if i < UNTANGLING_STEPS else towards
        normals = surface.normals(found[free[rows]], part[rows])
        step[rows] -= np.einsum("nk,nk->n", step[rows], normals)[:, None] * normals
        found[free] = surface.reached(found[free] + step, part, steps=1)
    found[free] = surface.reached(found[free], part)
    return found


def _unfolded(vertices: np.ndarray, faces: np.ndarray, near: sparse.csr_matrix, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) of which the free ones leave the surface where it folds, and how far (V,), 0 to 1, each belongs to such a place."""
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


def _mended(vertices: np.ndarray, faces: np.ndarray, may: np.ndarray) -> np.ndarray:
    """Vertices (V, 3): those that `may` (V,), about quads that are turned over, go half way to their neighbours' middle until none is."""
    found, near = np.array(vertices), None
    for step in range(MENDING_STEPS):
        bad = turned_over(found, faces) & may[faces].all(axis=1)
        if not bad.any():
            break
        near = mean_of_neighbours(faces, len(found)) if near is None else near
        moved = within(near, np.isin(np.arange(len(found)), faces[bad]), 1 + step // MENDING_RING)
        moved = moved[may[moved]]
        found[moved] = 0.5 * (found[moved] + near[moved] @ found)
    return found


def _smoothed(weights: np.ndarray, vertices: np.ndarray, faces: np.ndarray, near: sparse.csr_matrix, free: np.ndarray) -> np.ndarray:
    found = weights.copy()
    edge = float(np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2).mean())
    for _ in range(round(2 * (SMOOTHED_M / edge) ** 2)):
        found[free] = 0.5 * found[free] + 0.5 * (near[free] @ found)
    return strongest(found)
