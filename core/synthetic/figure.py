"""The scene of a synthetic recording: an arm of metaballs with a sleeve, a hand, a torso, a neck and a head, and a wall.

Every part is a closed mesh (the wall: a grid) with the rest-pose coordinates at which its solid texture is looked up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..body.shape import BodyShape
from ..body.skeleton import bone_frames
from ..body.skin.contour_skin import SkinSettings, limb_skin
from ..foundation.arrays import frozen
from ..geometry.raster import vertex_normals

SKIN = SkinSettings(contours=48, rays=64, cap_contours=10)
HAND_SEMI_AXES_M = (0.036, 0.092, 0.018)  # across, along the forearm, through the palm
HAND_CENTRE_M = 0.070  # beyond the wrist
GREY = np.array([0.299, 0.587, 0.114])  # of red, green and blue (ITU-R BT.601)


@dataclass(frozen=True, kw_only=True, slots=True)
class Material:
    """A solid texture in grey values under frontal light: mean, standard deviation, and the scale of the noise; with a `tint` (red, green,
    blue), in colours that have these grey values."""

    mean: float
    contrast: float
    stretch: float = 1.0
    offset_m: float = 0.0
    textured: bool = False
    tint: tuple[float, float, float] | None = None

    @property
    def bgr(self) -> np.ndarray:
        """The factors (3,) of blue, green and red, whose grey value (ITU-R BT.601) is 1."""
        rgb = np.array(self.tint or (1.0, 1.0, 1.0))
        return np.asarray(rgb[::-1] / (rgb @ GREY))


CLOTH = Material(mean=140.0, contrast=29.0, textured=True)
BARE_SKIN = Material(mean=165.0, contrast=5.0, stretch=0.8, offset_m=0.11)
WALL = Material(mean=112.0, contrast=5.0, stretch=6.0, offset_m=0.05)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Part:
    """One mesh of the scene at one moment."""

    vertices_m: np.ndarray  # (V, 3) world
    triangles: np.ndarray  # (F, 3)
    rest_m: np.ndarray  # (V, 3) where its texture is looked up
    material: Material

    def __post_init__(self) -> None:
        v = len(self.vertices_m)
        object.__setattr__(self, "vertices_m", frozen(self.vertices_m, (v, 3), name="vertices_m"))
        object.__setattr__(self, "triangles", frozen(self.triangles, (None, 3), np.int64, "triangles"))
        object.__setattr__(self, "rest_m", frozen(self.rest_m, (v, 3), name="rest_m"))


def arm_parts(shape: BodyShape, motion: np.ndarray, rest: Sequence["Part"] | None = None) -> tuple[Part, ...]:
    """The sleeve and the hand in one pose (D,). `rest`: the same parts in the rest pose, made without it."""
    skin = limb_skin(shape, motion, SKIN)
    centre = np.array([0.0, shape.lengths_m[-1] + HAND_CENTRE_M, 0.0])  # in the forearm's axes
    hand, hand_triangles = superellipsoid(centre, np.array(HAND_SEMI_AXES_M), 2.3, 40, 40)
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    hand = head[-1] + hand @ R[-1].T
    rest_m = (skin.vertices_m, hand) if rest is None else tuple(part.vertices_m for part in rest)
    return (
        Part(vertices_m=skin.vertices_m, triangles=skin.triangles, rest_m=rest_m[0], material=CLOTH),
        Part(vertices_m=hand, triangles=hand_triangles, rest_m=rest_m[1], material=BARE_SKIN),
    )


def torso_parts(shoulder_m: np.ndarray) -> tuple[Part, ...]:
    """Torso, neck and head of a person whose right shoulder is at `shoulder_m` (3,); they sway with it."""
    parts = []
    for centre, semi_axes, power, n, material in (
        ((0.150, 0.01, -0.26), (0.225, 0.125, 0.335), 2.5, 96, CLOTH),
        ((0.150, 0.0, 0.10), (0.058, 0.062, 0.11), 2.0, 32, BARE_SKIN),
        ((0.150, -0.015, 0.26), (0.075, 0.095, 0.120), 2.0, 40, BARE_SKIN),
    ):
        vertices, triangles = superellipsoid(shoulder_m + np.array(centre), np.array(semi_axes), power, n, n)
        parts.append(Part(vertices_m=vertices, triangles=triangles, rest_m=vertices - shoulder_m, material=material))
    return tuple(parts)


def wall(y_m: float, cells: int = 80, half_m: float = 2.0, centre_m: tuple[float, float] = (-0.3, 1.3)) -> Part:
    """A wall across y, visible from smaller y. Its cells are small enough for a camera with distortion."""
    t = np.linspace(-half_m, half_m, cells + 1)
    x, z = np.meshgrid(centre_m[0] + t, centre_m[1] + t)
    vertices = np.stack([x.ravel(), np.full(x.size, y_m), z.ravel()], axis=1)
    a = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    triangles = np.concatenate([np.stack([a, a + 1, a + cells + 2], 1), np.stack([a, a + cells + 2, a + cells + 1], 1)])
    return Part(vertices_m=vertices, triangles=triangles, rest_m=vertices, material=WALL)


def superellipsoid(centre_m: np.ndarray, semi_axes_m: np.ndarray, power: float, rings: int, rays: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed mesh |x/a|^p + |y/b|^p + |z/c|^p = 1 (Barr 1981 with equal exponents): vertices (V, 3), triangles (F, 3), outward."""
    polar = np.linspace(0, np.pi, rings + 2)[1:-1, None]
    around = np.arange(rays) * (2 * np.pi / rays)
    ring = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around], axis=-1)
    sphere = np.concatenate([[[0.0, 0.0, 1.0]], ring.reshape(-1, 3), [[0.0, 0.0, -1.0]]])
    radius = (np.abs(sphere) ** power).sum(axis=1, keepdims=True) ** (-1 / power)
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(rays), indexing="ij")
    a, b = 1 + i * rays + j, 1 + i * rays + (j + 1) % rays
    sides = np.concatenate([np.stack([a, a + rays, b], -1).reshape(-1, 3), np.stack([b, a + rays, b + rays], -1).reshape(-1, 3)])
    s, e, low = np.arange(rays), (np.arange(rays) + 1) % rays, 1 + (rings - 1) * rays
    top, bottom = np.stack([0 * s, 1 + s, 1 + e], 1), np.stack([0 * s + len(sphere) - 1, low + e, low + s], 1)
    return centre_m + sphere * radius * semi_axes_m, np.concatenate([top, sides, bottom])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Scene:
    """Several parts as one mesh."""

    vertices_m: np.ndarray  # (V, 3)
    triangles: np.ndarray  # (F, 3)
    normals: np.ndarray  # (V, 3)
    rest_m: np.ndarray  # (V, 3)
    owner: np.ndarray  # (F,) the part of each triangle
    materials: tuple[Material, ...]  # of the parts


def joined(parts: Sequence[Part]) -> Scene:
    """All parts as one mesh, each with normals of its own."""
    start = np.cumsum([0, *(len(p.vertices_m) for p in parts)])
    return Scene(
        vertices_m=np.concatenate([p.vertices_m for p in parts]),
        triangles=np.concatenate([p.triangles + first for p, first in zip(parts, start)]),
        normals=np.concatenate([vertex_normals(p.vertices_m, p.triangles) for p in parts]),
        rest_m=np.concatenate([p.rest_m for p in parts]),
        materials=tuple(p.material for p in parts),
        owner=np.repeat(np.arange(len(parts)), [len(p.triangles) for p in parts]),
    )
