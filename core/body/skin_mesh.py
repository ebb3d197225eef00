"""The mesh of a skin: closed, of quadrilaterals, of the same topology in every posture."""

from dataclasses import dataclass

import numpy as np

from ..settings import knob
from ..values import frozen

INTERPOLATING, APPROXIMATING = "interpolating", "approximating"


@dataclass(frozen=True, kw_only=True, slots=True)
class SkinSettings:
    """How finely the skin is sampled."""

    contours: int = knob(14, "Contours along each bone.", low=4, high=200)
    rays: int = knob(32, "Points on each contour (an even number).", low=8, high=400)
    cap_contours: int = knob(5, "Contours that close each end of the limb.", low=2, high=100)
    detail: int = knob(1, "Pieces of each mesh between contours and points, by B-spline patches; 1: the points alone.", low=1, high=16)
    patches: str = knob(
        INTERPOLATING,
        "B-spline patches go through the points, or approximate them and shrink a little.",
        choices=(INTERPOLATING, APPROXIMATING),
    )
    anatomy: bool = knob(
        True, "Heads, hands and feet as people have them, with jaw, fingers, heel and toes, not the three balls that were fitted."
    )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Skin:
    """A closed mesh, outside counter-clockwise, of the same topology in every posture."""

    vertices_m: np.ndarray  # (V, 3) world: the pole at the base, contour after contour, the pole at the end
    faces: np.ndarray  # (F, 4)
    weights: np.ndarray  # (V, B) share of each bone of the skeleton in a vertex; rows sum to 1
    bone_names: tuple[str, ...]
    normals: np.ndarray  # (V, 3) outward, of the implicit surface
    part_sizes: tuple[int, ...]  # vertices of each part, in order; every part is closed by itself
    rays: int  # points on each contour

    def __post_init__(self) -> None:
        v = len(self.vertices_m)
        object.__setattr__(self, "vertices_m", frozen(self.vertices_m, (v, 3), name="vertices_m"))
        object.__setattr__(self, "faces", frozen(self.faces, (None, 4), np.int64, "faces"))
        object.__setattr__(self, "normals", frozen(self.normals, (v, 3), name="normals"))
        object.__setattr__(self, "weights", frozen(self.weights, (v, len(self.bone_names)), name="weights"))

    @property
    def triangles(self) -> np.ndarray:
        """The faces as triangles (2 F, 3)."""
        return np.stack([self.faces[:, [0, 1, 2]], self.faces[:, [0, 2, 3]]], axis=1).reshape(-1, 3)


def chain_faces(n_vertices: int, rays: int) -> np.ndarray:
    """Faces (F, 4) of contours of `rays` points, closed by poles: quadrilaterals; at the poles each spans two edges of the contour."""
    contours = (n_vertices - 2) // rays
    i, j = np.meshgrid(np.arange(contours - 1), np.arange(rays), indexing="ij")
    here, on = 1 + i * rays + j, 1 + i * rays + (j + 1) % rays
    sides = np.stack([here, on, on + rays, here + rays], axis=-1).reshape(-1, 4)
    k = np.arange(0, rays, 2)
    first, last = 1 + np.stack([k, k + 1, (k + 2) % rays], axis=1), n_vertices - 1 - rays + np.stack([k, k + 1, (k + 2) % rays], axis=1)
    start = np.column_stack([np.zeros(len(k), dtype=np.int64), first[:, ::-1]])
    end = np.column_stack([np.full(len(k), n_vertices - 1), last])
    return np.concatenate([start, sides, end])
