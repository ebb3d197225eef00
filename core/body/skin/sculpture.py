"""Shapes sculpted from few solids, smoothly joined, and meshes cast onto them; coordinates in millimetres.

    d = smin(d, d_i; k) ,  or for a hollow  d = −smin(−d, d_i; k) ,   in the order of the solids                            (1)
    smin(a, b; k) = min(a, b) − h² k/4 ,   h = max(1 − |a − b|/k, 0)

d_i is about the signed distance from solid i: of an ellipsoid q (q − 1)/|∇q| with q² = Σ (x_i/r_i)², of a cone of spheres the exact one.
k is the width over which a solid passes into the others. (Hart 1996, Sphere tracing, The Visual Computer 12; smooth minimum: Quilez 2013,
iquilezles.org/articles/smin)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

STEPS = 90  # of sphere tracing
CAREFUL = 0.7  # of a step, because ellipsoids' distances are not exact
CLOSE_MM = 0.01


@dataclass(frozen=True, slots=True)
class Solid:
    """An ellipsoid with half axes `half`, or a cone of spheres from `at` to `end`, of radii half[0] and half[1].

    `pair`: there is one on either side, x > 0 and x < 0. `hollow`: it is taken away. `turn_deg`: about x, y, z, in this order.
    """

    at: tuple[float, float, float]
    half: tuple[float, ...]
    blend: float
    end: tuple[float, float, float] | None = None
    pair: bool = False
    hollow: bool = False
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, x: np.ndarray) -> np.ndarray:
        """(N,) of points (N, 3), negative inside."""
        p = np.column_stack([np.abs(x[:, 0]), x[:, 1:]]) if self.pair else x
        p = p - np.array(self.at)
        if self.end is not None:
            along = np.array(self.end) - np.array(self.at)
            t = np.clip(p @ along / (along @ along), 0.0, 1.0)
            return np.asarray(np.linalg.norm(p - t[:, None] * along, axis=1) - (self.half[0] + t * (self.half[1] - self.half[0])))
        q = p @ _turned(self.turn_deg) / np.array(self.half)
        size = np.linalg.norm(q, axis=1)
        slope = np.linalg.norm(q / np.array(self.half), axis=1)
        return np.asarray(size * (size - 1) / np.maximum(slope, 1e-9))


def _turned(degrees: tuple[float, float, float]) -> np.ndarray:
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.asarray(np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]]) @ about_y @ about_x)


def distance_mm(solids: Sequence[Solid], x: np.ndarray) -> np.ndarray:
    """(N,) d of (1) at points (N, 3)."""
    found = solids[0].distance(x)
    for solid in solids[1:]:
        own = solid.distance(x)
        found = -_smooth_minimum(-found, own, solid.blend) if solid.hollow else _smooth_minimum(found, own, solid.blend)
    return found


def _smooth_minimum(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    h = np.maximum(1 - np.abs(a - b) / k, 0.0)
    return np.asarray(np.minimum(a, b) - h**2 * k / 4)


def cast_inwards(solids: Sequence[Solid], origin: np.ndarray, direction: np.ndarray, from_mm: float) -> np.ndarray:
    """Points (N, 3) where rays from `origin` (N, 3) in unit directions (N, 3) leave the solids for the last time within `from_mm`."""
    r = np.full(len(origin), from_mm)
    going = np.arange(len(origin))
    for _ in range(STEPS):
        d = distance_mm(solids, origin[going] + r[going, None] * direction[going])
        r[going] = np.maximum(r[going] - CAREFUL * d, 0.0)
        going = going[(np.abs(d) > CLOSE_MM) & (r[going] > 0)]
        if not len(going):
            break
    return np.asarray(origin + r[:, None] * direction)
