"""Silhouettes: the ray through a point of the contour touches the body's surface (Plänkers & Fua 2003; SCIENCE: D'Apuzzo et al. 1999, §4).

    t* = argmax_t F(o + t u) ,   √(−½ ln F(o + t* u)) − √(½ ln 2) = ε                                    (1)

Because ∂F/∂t = 0 at t*, derivatives of F(o + t* u) need none of t* (envelope theorem): they are those of a surface point held there.
t* starts at the best of the closest approaches to the single balls, t = −(M o)·(M u)/|M u|² with M = diag(1/l) Rᵀ.
A ray belongs to one bone's part, whose field is meant. The sigma is that of the contour in the image, carried to the ray's depth.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..state import Block, BodyState, FromBlocks
from .surface_point import SurfacePoints

MEAN_STEPS, NEWTON_STEPS, LONGEST_M = 10, 5, 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteRays(FromBlocks):
    """N rays through contour points, each tangent to one bone's part."""

    origin_m: np.ndarray  # (N, 3) camera centres
    direction: np.ndarray  # (N, 3) unit vectors
    bone: np.ndarray  # (N,)
    sigma_m: np.ndarray  # (N,) Z/f · σ_px
    variance_inflation: np.ndarray | float = 1.0
    held: SurfacePoints | None = None  # the touching points with their weights, at the state of `scaled`
    along_m: np.ndarray | None = None  # (N,) where they lie on their rays: at other states they are looked for from there
    kind: str = "contours"

    def scaled(self, state: BodyState) -> "SilhouetteRays":
        """The same rays with weights for this state."""
        X = replace(self, along_m=None).touching(state)
        along = np.einsum("ni,ni->n", X - self.origin_m, self.direction)
        return replace(self, held=SurfacePoints(xyz_m=X, bone=self.bone, sigma_m=self.sigma_m).scaled(state), along_m=along)

    def touching(self, state: BodyState) -> np.ndarray:
        """The points (N, 3) where the field along each ray is largest.  (1)"""
        X = np.empty_like(self.origin_m)
        for b in np.unique(self.bone):
            rows = np.flatnonzero(self.bone == b)
            start = None if self.along_m is None else self.along_m[rows]
            X[rows] = _largest_field(state, int(b), self.origin_m[rows], self.direction[rows], start)
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


def _largest_field(state: BodyState, bone: int, origin: np.ndarray, direction: np.ndarray, start: np.ndarray | None) -> np.ndarray:
    """Along a ray the field is Σ w exp(−2 (a t² + 2 b t + c)): its shares p_i give t = −Σ p b / Σ p a, then Newton's steps on ln F."""
    part, balls = state.parts[bone], state.balls
    own, of = part.balls, balls.bone_index[part.balls]
    centre = state.head_m[of] + np.einsum("mij,mj->mi", state.R[of], balls.centre[own] * state.lengths_m[of, None])
    M = state.R[of].transpose(0, 2, 1) / balls.radii_m[own][:, :, None]
    o, u = origin @ M.transpose(0, 2, 1) - np.einsum("mij,mj->mi", M, centre)[:, None], direction @ M.transpose(0, 2, 1)  # (m, N, 3)
    a, b = np.einsum("mni,mni->nm", u, u), np.einsum("mni,mni->nm", o, u)
    least = np.einsum("mni,mni->nm", o, o) - b * b / a  # d where the ball is nearest, at t = −b/a
    nearest, log_weight = -b / a, np.log(balls.weight[own])

    def shares(t: np.ndarray) -> np.ndarray:
        log_terms = log_weight - 2 * (least + a * (t[:, None] - nearest) ** 2)
        terms = np.exp(log_terms - log_terms.max(axis=1, keepdims=True))
        return np.asarray(terms / terms.sum(axis=1, keepdims=True))

    t = nearest[np.arange(len(origin)), np.argmax(log_weight - 2 * least, axis=1)] if start is None else start
    for _ in range(MEAN_STEPS if start is None else 1):
        p = shares(t)
        t = -(p * b).sum(axis=1) / (p * a).sum(axis=1)
    for _ in range(NEWTON_STEPS):
        p, slopes = shares(t), -4 * (a * t[:, None] + b)
        slope = (p * slopes).sum(axis=1)
        curve = (p * (slopes**2 - 4 * a)).sum(axis=1) - slope**2
        mean = -(p * b).sum(axis=1) / (p * a).sum(axis=1)
        t = np.where(curve < 0, t + np.clip(-slope / np.where(curve < 0, curve, 1.0), -LONGEST_M, LONGEST_M), mean)
    return np.asarray(origin + t[:, None] * direction)
