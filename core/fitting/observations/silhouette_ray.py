"""Silhouettes: the ray through a point of the contour touches the body's surface (Plänkers & Fua 2003; SCIENCE: D'Apuzzo et al. 1999, §4).

    t* = argmax_t F(o + t u) ,   √(−½ ln F(o + t* u)) − √(½ ln 2) = ε                                    (1)

Because ∂F/∂t = 0 at t*, derivatives of F(o + t* u) need none of t* (envelope theorem): they are those of a surface point held there.
t* is the best of the closest approaches to the single balls, t = −(M o)·(M u)/|M u|² with M = diag(1/l) Rᵀ, made exact by Newton steps.
A ray belongs to one bone's part, whose field is meant. The sigma is that of the contour in the image, carried to the ray's depth.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..part_field import PartField
from ..state import BodyState
from .blocks import Block, FromBlocks
from .surface_point import SurfacePoints

NEWTON_STEPS = 8


@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteRays(FromBlocks):
    """N rays through contour points, each tangent to one bone's part."""

    origin_m: np.ndarray  # (N, 3) camera centres
    direction: np.ndarray  # (N, 3) unit vectors
    bone: np.ndarray  # (N,)
    sigma_m: np.ndarray  # (N,) Z/f · σ_px
    crowding: np.ndarray | float = 1.0
    held: SurfacePoints | None = None  # the touching points with their weights, at the state of `scaled`
    robust: bool = True

    def scaled(self, state: BodyState) -> "SilhouetteRays":
        """The same rays with weights for this state."""
        touching = SurfacePoints(xyz_m=self.touching(state), bone=self.bone, sigma_m=self.sigma_m).scaled(state)
        return SilhouetteRays(origin_m=self.origin_m, direction=self.direction, bone=self.bone, sigma_m=self.sigma_m,
                              crowding=self.crowding, held=touching)

    def touching(self, state: BodyState) -> np.ndarray:
        """The points (N, 3) where the field along each ray is largest.  (1)"""
        X = np.empty_like(self.origin_m)
        for b in np.unique(self.bone):
            rows = np.flatnonzero(self.bone == b)
            X[rows] = _largest_field(state, int(b), self.origin_m[rows], self.direction[rows])
        return X

    def residual(self, state: BodyState) -> np.ndarray:
        """(N,)"""
        return self._points(state).residual(state)

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives at fixed t*, part by part."""
        yield from self._points(state).blocks(state, shape)

    @property
    def size(self) -> int:
        """N."""
        return len(self.bone)

    def _points(self, state: BodyState) -> SurfacePoints:
        if self.held is None:
            raise ValueError("silhouette rays need `scaled(state)` first")
        return self.held.at(self.touching(state))


def _largest_field(state: BodyState, bone: int, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    part, balls = state.parts[bone], state.balls
    approaches = []
    for ball in part.balls:
        b = balls.bone_index[ball]
        centre = state.head_m[b] + state.R[b] @ (balls.centre[ball] * state.lengths_m[b])
        M = state.R[b].T / balls.radii_m[ball][:, None]
        o, u = (origin - centre) @ M.T, direction @ M.T
        approaches.append(-np.einsum("ni,ni->n", o, u) / np.einsum("ni,ni->n", u, u))
    t = np.stack(approaches, axis=1)
    X = origin[:, None] + t[..., None] * direction[:, None]
    F = PartField(part, state, X.reshape(-1, 3)).F.reshape(t.shape)
    best = t[np.arange(len(t)), np.argmax(F, axis=1)]
    for _ in range(NEWTON_STEPS):
        best = best + _newton(state, bone, origin, direction, best)
    return origin + best[:, None] * direction


def _newton(state: BodyState, bone: int, origin: np.ndarray, direction: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Steps (N,) [m] towards the largest F along the rays, from differences of the slope; at most a centimetre."""
    h = 1e-4
    slopes = [np.einsum("ni,ni->n", PartField(state.parts[bone], state, origin + (t + d)[:, None] * direction).gradient, direction)
              for d in (0.0, h)]
    slope, curve = slopes[0], (slopes[1] - slopes[0]) / h
    step = np.where(curve < 0, -slope / np.where(curve < 0, curve, 1.0), np.sign(slope) * 0.005)
    return np.clip(step, -0.01, 0.01)
