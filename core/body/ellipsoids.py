"""Metaballs as the ellipsoids that each would show alone (D'Apuzzo et al. 1999, Figs. 10 b and 11), as one mesh."""

from dataclasses import dataclass

import numpy as np

from ..foundation.arrays import frozen
from .anatomy import KINDS, ball_names
from .metaballs import THRESHOLD
from .shape import BodyShape
from .skeleton import bone_frames

RINGS, RAYS = 8, 14  # of a sphere, without its poles
LEAST = 0.05  # of l: the size of a ball whose field alone nowhere reaches the threshold


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Ellipsoids:
    """M ellipsoids as one mesh."""

    vertices_m: np.ndarray  # (V, 3) world
    triangles: np.ndarray  # (F, 3) outward
    ball: np.ndarray  # (V,) the metaball
    kind: np.ndarray  # (V,) index in `anatomy.KINDS`

    def __post_init__(self) -> None:
        v = len(self.vertices_m)
        object.__setattr__(self, "vertices_m", frozen(self.vertices_m, (v, 3), name="vertices_m"))
        object.__setattr__(self, "triangles", frozen(self.triangles, (None, 3), np.int64, "triangles"))
        for name in ("ball", "kind"):
            object.__setattr__(self, name, frozen(getattr(self, name), (v,), np.int64, name))


def ellipsoids(shape: BodyShape, motion: np.ndarray) -> Ellipsoids:
    """The balls of a body in one pose (D,), each with the radius r = l √(½ ln(w / T)) at which its field alone is the threshold."""
    balls = shape.metaballs
    R, head = bone_frames(shape.skeleton, shape.lengths_m, motion)
    visible = np.sqrt(np.maximum(0.5 * np.log(np.maximum(balls.weight / THRESHOLD, 1e-12)), LEAST**2))
    sphere, triangles = _sphere()
    own = balls.centres_m(shape.lengths_m)[:, None] + sphere * (balls.radii_m * visible[:, None])[:, None]
    vertices = np.einsum("mij,mvj->mvi", R[balls.bone_index], own) + head[balls.bone_index][:, None]
    count, kinds = len(balls.weight), [KINDS.index(n.kind) for n in ball_names([b.name for b in shape.skeleton.bones], balls.bone_index)]
    return Ellipsoids(
        vertices_m=vertices.reshape(-1, 3),
        triangles=(triangles + len(sphere) * np.arange(count)[:, None, None]).reshape(-1, 3),
        ball=np.repeat(np.arange(count), len(sphere)),
        kind=np.repeat(np.array(kinds, dtype=np.int64), len(sphere)),
    )


def _sphere() -> tuple[np.ndarray, np.ndarray]:
    """A unit sphere: vertices (V, 3), triangles (F, 3), outward."""
    polar, around = np.pi * np.arange(1, RINGS + 1)[:, None] / (RINGS + 1), 2 * np.pi * np.arange(RAYS) / RAYS
    ring = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around], axis=-1)
    i, j = np.meshgrid(np.arange(RINGS - 1), np.arange(RAYS), indexing="ij")
    a, b = 1 + i * RAYS + j, 1 + i * RAYS + (j + 1) % RAYS
    sides = np.concatenate([np.stack([a, a + RAYS, b], -1).reshape(-1, 3), np.stack([b, a + RAYS, b + RAYS], -1).reshape(-1, 3)])
    s, e, low, pole = np.arange(RAYS), (np.arange(RAYS) + 1) % RAYS, 1 + (RINGS - 1) * RAYS, 1 + RINGS * RAYS
    ends = np.concatenate([np.stack([0 * s, 1 + s, 1 + e], 1), np.stack([0 * s + pole, low + e, low + s], 1)])
    return np.concatenate([[[0.0, 0.0, 1.0]], ring.reshape(-1, 3), [[0.0, 0.0, -1.0]]]), np.concatenate([ends, sides])
