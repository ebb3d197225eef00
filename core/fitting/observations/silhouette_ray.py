"""Silhouettes: the ray through a point of the contour touches the body's surface (Plänkers & Fua 2003; D'Apuzzo et al. 1999, §4).

    t* = argmax_t F(o + t u) ,   √(−½ ln F(o + t* u)) − √(½ ln 2) = ε                                    (1)

Because ∂F/∂t = 0 at t*, derivatives of F(o + t* u) need none of t* (envelope theorem): they are those of a surface point fixed there.
t* starts at the best of the closest approaches to the single balls, t = −(M o)·(M u)/|M u|² with M = diag(1/l) Rᵀ.
A ray belongs to one bone's part, whose field is F. The sigma is that of the contour in the image, carried to the ray's depth.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ..state import Block, BodyState, FromBlocks, balls_of_parts
from .surface_point import SurfacePoints

MEAN_STEPS, NEWTON_STEPS = 5, 12  # iterations for t* from the closest approach: fixed point, then Newton
LONGEST_M = 0.01  # of a Newton step: where ln F is hardly curved it would be far too long
DONE_M = 1e-6  # a step of Newton's method after which the error is far below 1e-9 m


@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteRays(FromBlocks):
    """N rays through contour points, each tangent to one bone's part, with weights from a reference state (`SilhouetteRays.about`)."""

    origin_m: np.ndarray  # (N, 3) camera centres
    direction: np.ndarray  # (N, 3) unit vectors
    bone: np.ndarray  # (N,)
    sigma_m: np.ndarray  # (N,) Z/f · σ_px
    variance_inflation: np.ndarray | float
    tangent: SurfacePoints  # the points of contact at the reference state, with their weights
    along_m: np.ndarray  # (N,) their places on the rays, from which t* is iterated at other states
    kind: str = "contours"
    _last: list[tuple[BodyState, SurfacePoints]] = field(default_factory=list, init=False, repr=False)  # at the state evaluated last

    @staticmethod
    def about(
        reference: BodyState,
        *,
        origin_m: np.ndarray,
        direction: np.ndarray,
        bone: np.ndarray,
        sigma_m: np.ndarray,
        variance_inflation: np.ndarray | float = 1.0,
    ) -> "SilhouetteRays":
        """The observations of rays, with weights from a reference state."""
        X = _contacts(reference, origin_m, direction, bone)
        return SilhouetteRays(
            origin_m=origin_m,
            direction=direction,
            bone=bone,
            sigma_m=sigma_m,
            variance_inflation=variance_inflation,
            tangent=SurfacePoints.about(reference, xyz_m=X, bone=bone, sigma_m=sigma_m),
            along_m=np.einsum("ni,ni->n", X - origin_m, direction),
        )

    def reweighted(self, reference: BodyState) -> "SilhouetteRays":
        """The same rays with weights from another reference state."""
        tangent = self._points(reference).reweighted(reference)
        along = np.einsum("ni,ni->n", tangent.xyz_m - self.origin_m, self.direction)
        again = replace(self, tangent=tangent, along_m=along)
        again._last.append((reference, tangent))
        return again

    def contacts(self, state: BodyState) -> np.ndarray:
        """The points (N, 3) where the field along each ray is largest.  (1)"""
        return _contacts(state, self.origin_m, self.direction, self.bone, self.along_m)

    def residual(self, state: BodyState) -> np.ndarray:
        """(N,)"""
        return self._points(state).residual(state)

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives at constant t*, part by part."""
        yield from self._points(state).blocks(state, shape)

    @property
    def size(self) -> int:
        """N."""
        return len(self.bone)

    def _points(self, state: BodyState) -> SurfacePoints:
        if not self._last or self._last[0][0] is not state:
            self._last[:] = [(state, self.tangent.moved(self.contacts(state)))]
        return self._last[0][1]


def _contacts(
    state: BodyState, origin_m: np.ndarray, direction: np.ndarray, bone: np.ndarray, start: np.ndarray | None = None
) -> np.ndarray:
    """The points (N, 3) of (1); `start` (N,) where t* is iterated from, else from the closest approaches to the balls."""
    t = _largest_field(state, bone, origin_m, direction, start)
    return np.asarray(origin_m + t[:, None] * direction)


def _largest_field(state: BodyState, bone: np.ndarray, origin: np.ndarray, direction: np.ndarray, start: np.ndarray | None) -> np.ndarray:
    """t* (N,). A ray's field is Σ w exp(−2 (a t² + 2 b t + c)): the balls' shares p give t = −Σ p b / Σ p a; then Newton on ln F."""
    balls, own = balls_of_parts(state.parts)
    a, b, c = (np.take_along_axis(v, balls[bone], axis=1) for v in _quadratics(state, origin, direction))
    nearest = -b / a
    log_least = np.where(own[bone], np.log(state.balls.weight)[balls[bone]], -np.inf) - 2 * (c + b * nearest)  # where the ball is nearest

    def shares(t: np.ndarray, rays: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        beyond = t[:, None] - nearest[rays]
        slopes = a[rays] * beyond
        log_terms = log_least[rays] - 2 * slopes * beyond
        log_terms -= log_terms.max(axis=1, keepdims=True)
        terms = np.exp(log_terms, out=log_terms)
        terms /= terms.sum(axis=1, keepdims=True)
        return terms, slopes

    def mean(p: np.ndarray, rays: np.ndarray | slice) -> np.ndarray:
        weights = p * a[rays]
        return np.asarray((weights * nearest[rays]).sum(axis=1) / weights.sum(axis=1))

    t = nearest[np.arange(len(origin)), np.argmax(log_least, axis=1)] if start is None else start
    for _ in range(MEAN_STEPS if start is None else 1):
        t = mean(shares(t, np.s_[:])[0], np.s_[:])
    left = np.arange(len(t))  # rays that have not converged
    for _ in range(NEWTON_STEPS):
        p, slopes = shares(t[left], left)
        slope = (p * slopes).sum(axis=1)  # of ln F, in units of −4
        curve = (p * (4 * slopes**2 - a[left])).sum(axis=1) - 4 * slope**2  # in units of 4
        newton = np.clip(slope / np.where(curve < 0, curve, -1.0), -LONGEST_M, LONGEST_M)
        step = np.where(curve < 0, newton, mean(p, left) - t[left])
        t[left] += step
        left = left[np.abs(step) >= DONE_M]
        if not len(left):
            break
    return np.asarray(t)


def _quadratics(state: BodyState, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a, b and c (N, M) of the distances a t² + 2 b t + c of rays from all balls: linear in the products of their coordinates."""
    frames, shifts = state.ball_frames
    i, j = np.triu_indices(3)
    form = (np.matmul(frames, frames.transpose(0, 2, 1))[:, i, j] * np.where(i == j, 1.0, 2.0)).T  # (6, M)
    shifted = np.einsum("mij,mj->im", frames, shifts)
    o, u = origin, direction
    both = (o[:, i] * u[:, j] + o[:, j] * u[:, i]) / 2
    return (
        (u[:, i] * u[:, j]) @ form,
        both @ form - u @ shifted,
        (o[:, i] * o[:, j]) @ form - 2 * o @ shifted + np.einsum("mi,mi->m", shifts, shifts),
    )
