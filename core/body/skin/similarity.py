"""A part of a skin, put by a similarity where the points of all frames measured it.

In the axes of the part's bone the vertices x move by a similarity of nine parameters p, a shift t, a rotation Q and three scales S, to the
degree w to which they are the part's, smoothed beyond it:

    x' = x + w (Q S (x − c) + c + t − x) ,   Σ ρ( m·(X − x')/σ ) + (p − p₀)ᵀ Σ⁻¹ (p − p₀) → min              (1)

with Σ = diag(σ_p²), and more for a common scale; X, m a point and its normal in the bone's axes, x' the nearest of those vertices whose
normals are alike, renewed in every step. ρ is Tukey's biweight.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.robust import TUKEY
from ...geometry.rotation import cross_matrix, rotation_from_vector, vector_from_rotation
from ..shape import BodyShape
from ..skeleton import bone_frames
from .relief import LEAST_COSINE, SurfacePoints

FARTHEST_M = 0.03  # of a point from the skin
SIGMA_M = 0.003  # σ: what a person differs from an anatomical part
EACH_FOR = 100.0  # as many points count as one: their errors are alike
FEWEST = 300  # points
MOST_FRAMES = 24  # evenly
CANDIDATES = 4  # nearest vertices of a point
STEPS = 15


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Prior:
    """p₀ and Σ of (1)."""

    mean: np.ndarray  # (9,)
    sigma: np.ndarray  # (9,) of t [m], Rodrigues vector of Q, ln S
    size: float  # what the three ln S have in common

    @property
    def information(self) -> np.ndarray:
        """Σ⁻¹ (9, 9)."""
        common = np.repeat([0.0, self.size], (6, 3))
        return np.linalg.inv(np.diag(self.sigma**2) + np.outer(common, common))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Movable:
    """The vertices of a skin in the axes of a part's bone."""

    x: np.ndarray  # (V, 3)
    across: np.ndarray  # (V, 3) normals
    share: np.ndarray  # (V, 1) w of (1)
    own: np.ndarray  # (V,) bool: the part's; the others only take their points from what lies next to it
    middle: np.ndarray  # (3,) c of (1)

    def at(self, p: np.ndarray) -> np.ndarray:
        """x' (V, 3) of (1)."""
        return np.asarray(self.x + self.share * (moved(self.x, self.middle, p) - self.x))

    def within(self, low: np.ndarray, high: np.ndarray) -> "Movable":
        """The part, and the other vertices in a box."""
        near = self.own | ((self.x > low) & (self.x < high)).all(axis=1)
        return Movable(x=self.x[near], across=self.across[near], share=self.share[near], own=self.own[near], middle=self.middle)


def points_about(
    shape: BodyShape, b: int, frames: Sequence[SurfacePoints], vertices: np.ndarray, below_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Points near vertices in the axes of bone b, and their normals (N, 3), in these axes; also those so far `below_m` them."""
    low, high = vertices.min(axis=0) - FARTHEST_M, vertices.max(axis=0) + FARTHEST_M
    low[1] -= below_m
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(MOST_FRAMES, len(frames))).round().astype(int))
    points, normals = [], []
    for frame in (frames[i] for i in chosen):
        R, head = bone_frames(shape.skeleton, shape.lengths_m, frame.motion)
        X = (frame.xyz_m - head[b]) @ R[b]
        near = ((X > low) & (X < high)).all(axis=1)
        points.append(X[near])
        normals.append(frame.normals[near] @ R[b])
    return np.concatenate(points), np.concatenate(normals)


def moved(x: np.ndarray, middle: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) moved entirely."""
    return np.asarray(((x - middle) * np.exp(p[6:])) @ rotation_from_vector(p[3:6]).T + middle + p[:3])


def changed(p: np.ndarray, step: np.ndarray) -> np.ndarray:
    """p (9,) after a step (9,), of which the rotation follows the one that is there."""
    turned = vector_from_rotation(rotation_from_vector(step[3:6]) @ rotation_from_vector(p[3:6]))
    return np.concatenate([p[:3] + step[:3], turned, p[6:] + step[6:]])


def derivatives(x: np.ndarray, middle: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Those of `moved` with respect to a step, (V, 3, 9)."""
    Q, scaled = rotation_from_vector(p[3:6]), (x - middle) * np.exp(p[6:])
    shift = np.broadcast_to(np.eye(3), (len(x), 3, 3))
    return np.concatenate([shift, -cross_matrix(scaled @ Q.T), Q * scaled[:, None]], axis=2)


def registered(
    skin: Movable,
    points: np.ndarray,
    normals: np.ndarray,
    prior: Prior,
    *,
    stand_for: int = 1,
    steps: int = STEPS,
    start: np.ndarray | None = None,
) -> np.ndarray | None:
    """p (9,) of (1); None if too few points find a vertex. Each of the points `stand_for` several."""
    p, information = prior.mean if start is None else start, prior.information
    for _ in range(steps):
        at = skin.at(p)
        found, r = residuals(skin, at, p, points, normals)
        good = np.flatnonzero(np.isfinite(r) & skin.own[found])
        if len(good) * stand_for < FEWEST:
            return None
        n, i, r = normals[good], found[good], r[good]
        J = skin.share[i] * np.einsum("nk,nkp->np", n, derivatives(skin.x[i], skin.middle, p))
        spread = max(SIGMA_M, 1.4826 * float(np.median(np.abs(r))))
        weight = np.clip(1 - (r / (TUKEY * spread)) ** 2, 0, None) ** 2 * stand_for / (EACH_FOR * spread**2)
        normal = J.T @ (weight[:, None] * J) + information
        p = changed(p, np.linalg.solve(normal, J.T @ (weight * r) - information @ (p - prior.mean)))
    return p


def residuals(skin: Movable, at: np.ndarray, p: np.ndarray, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertex (N,) to which each point belongs, of those that are `at`, and its distance (N,) along the normal; inf without one."""
    from scipy.spatial import cKDTree

    rows = np.arange(len(points))
    distance, near = cKDTree(at).query(points, k=CANDIDATES, distance_upper_bound=FARTHEST_M)
    near = np.minimum(near, len(at) - 1)
    cosine = np.einsum("nkc,nc->nk", skin.across[near] @ rotation_from_vector(p[3:6]).T, normals)
    best = np.argmin(np.where(cosine > LEAST_COSINE, distance * (2 - cosine), np.inf), axis=1)
    found = near[rows, best]
    good = np.isfinite(distance[rows, best]) & (cosine[rows, best] > LEAST_COSINE)
    return found, np.where(good, np.einsum("nk,nk->n", normals, points - at[found]), np.inf)
