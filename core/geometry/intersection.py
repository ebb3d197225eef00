"""Forward intersection: the point in space that fits its image points best, with its covariance.

Σ_k (x_k − F_k(X))ᵀ K_k⁻¹ (x_k − F_k(X)) → min                             (1)   F_k: camera k (collinearity)
N = Σ J_kᵀ K_k⁻¹ J_k ,   X ← X + N⁻¹ Σ J_kᵀ K_k⁻¹ v_k ,   K_X = N⁻¹         (2)
σ0² = vᵀ P v / (2 K − 3)                                                   (3)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .camera import Camera, project_all
from .small_matrices import invert_spd

STEPS = 4  # of (2), at most
RAY_TEST = 0.999  # probability of the χ² test of rays
START_STEPS = 2  # of the rays from which (2) starts: within 10⁻⁶ of their directions
CONVERGED_M = 1e-6  # step; the next one would be a thousandth of it
CLICK_SIGMA_PX = 5.0  # of a click, unless the knob fitting.click_sigma_px sets another
MOST_MISS_SIGMAS = 3.0  # of the clicks, their root mean square; by chance one in 45 000 (two views) or 170 000 (three) misses by more
JOINT_PLACE_M = 0.015  # sigma of a joint's place in the body, as it is believed from one side


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Intersection:
    """N points in space. A point with fewer than two rays is NaN in every array."""

    xyz_m: np.ndarray  # (N, 3) world
    covariance_m2: np.ndarray  # (N, 3, 3) from the a priori covariances of the image points
    residual_px: np.ndarray  # (N, K, 2) image point − projection; NaN where not observed
    sigma0: np.ndarray  # (N,) square root of (3)
    rays: np.ndarray  # (N,) number of rays

    @property
    def rms_residual_px(self) -> np.ndarray:
        """(N,) root mean square over the rays of the distance between image point and projection; NaN where there is no point."""
        square = np.nansum(self.residual_px**2, axis=(1, 2))
        return np.where(np.isfinite(self.xyz_m[:, 0]), np.sqrt(square / np.maximum(self.rays, 1)), np.nan)


def forward_intersection(cameras: Sequence[Camera], xy_px: np.ndarray, covariance_px2: np.ndarray) -> Intersection:
    """Intersect the rays of N points in K cameras.

    `xy_px` (N, K, 2) full-frame pixels, NaN where a point is not visible; `covariance_px2` (N, K, 2, 2).
    """
    visible = np.isfinite(xy_px).all(axis=2)
    rays = visible.sum(axis=1)
    good = np.flatnonzero(rays >= 2)
    n, xy, seen = len(xy_px), xy_px[good], visible[good]
    P = np.zeros((len(good), len(cameras), 2, 2))
    P[seen] = invert_spd(covariance_px2[good][seen])
    X = _closest_points(cameras, xy, seen)
    for _ in range(STEPS):
        N, rhs, _ = _normal_equations(cameras, X, xy, P, seen)
        step = _solve(N, rhs)
        X += step
        if np.nanmax(np.abs(step), initial=0.0) < CONVERGED_M:
            break
    N, _, v = _normal_equations(cameras, X, xy, P, seen)
    usable = np.isfinite(N).all(axis=(1, 2))
    vPv = np.einsum("nki,nkij,nkj->n", np.nan_to_num(v), P, np.nan_to_num(v))
    xyz, K, residual, sigma0 = (np.full((n, *shape), np.nan) for shape in ((3,), (3, 3), xy_px.shape[1:], ()))
    rows = good[usable]
    xyz[rows], residual[rows] = X[usable], v[usable]
    K[rows] = invert_spd(N[usable] + np.eye(3) * 1e-9)
    sigma0[rows] = np.sqrt(vPv[usable] / np.maximum(2 * rays[rows] - 3, 1))
    return Intersection(xyz_m=xyz, covariance_m2=K, residual_px=residual, sigma0=sigma0, rays=rays)


def chi2_limit(rays: np.ndarray) -> np.ndarray:
    """Largest sigma0 (N,) of intersections of so many rays that 999 in 1000 good points have: 2 K − 3 are redundant."""
    from scipy.special import gammaincinv

    redundant = np.maximum(2 * rays - 3, 1)
    return np.asarray(np.sqrt(2 * gammaincinv(redundant / 2, RAY_TEST) / redundant))


def intersect_clicks(cameras: Sequence[Camera], xy_px: np.ndarray, sigma_px: float | np.ndarray = CLICK_SIGMA_PX) -> Intersection:
    """Intersect the rays of N points clicked in K cameras: full-frame pixels (N, K, 2), NaN where a point is not clicked.

    `sigma_px` is that of a click, the same for all or (N, K).
    """
    variance = np.broadcast_to(np.square(sigma_px), np.shape(xy_px)[:2])
    return forward_intersection(cameras, np.asarray(xy_px, dtype=np.float64), np.eye(2) * variance[..., None, None])


def clicks_contradict(point: Intersection, sigma_px: float = CLICK_SIGMA_PX) -> np.ndarray:
    """(N,) which points' clicks contradict each other: there is no point, or its rays miss by more than MOST_MISS_SIGMAS."""
    return ~(point.rms_residual_px <= MOST_MISS_SIGMAS * sigma_px)


def joint_clicks_contradict(cameras: Sequence[Camera], point: Intersection, sigma_px: float = CLICK_SIGMA_PX) -> np.ndarray:
    """(N,) which joints' clicks contradict each other: there is no point, or its rays miss by more than `most_miss_px`."""
    return ~(point.rms_residual_px <= most_miss_px(cameras, point, sigma_px))


def most_miss_px(cameras: Sequence[Camera], point: Intersection, sigma_px: float = CLICK_SIGMA_PX) -> np.ndarray:
    """(N,) by how much, as root mean square, the rays of clicks on joints may miss each other:

    MOST_MISS_SIGMAS √(σ² + (JOINT_PLACE_M f/Z sin α)²), with the largest angle α between rays. A joint lies inside the body. Views beside
    each other see it from the same side, and err alike; who sees it from the front and from behind believes it in two places.
    """
    seen = np.isfinite(point.residual_px[..., 0]) & np.isfinite(point.xyz_m[:, :1])
    ray = point.xyz_m[:, None] - np.array([camera.centre_m for camera in cameras])
    depth = np.einsum("nki,ki->nk", ray, np.array([camera.R_cam_world[2] for camera in cameras]))
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    sine = np.linalg.norm(np.cross(ray[:, :, None], ray[:, None]), axis=3)
    behind = np.einsum("nki,nli->nkl", ray, ray) < 0  # beyond 90° the two sides differ as much as at 90°
    apart = np.where(seen[:, :, None] & seen[:, None], np.where(behind, 1.0, sine), 0.0).max(axis=(1, 2))
    focal = np.array([camera.focal_px for camera in cameras])
    place_px = np.where(seen, JOINT_PLACE_M * apart[:, None] * focal / np.where(depth > 0, depth, np.inf), 0.0)
    square = sigma_px**2 + (place_px**2).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    return np.asarray(MOST_MISS_SIGMAS * np.sqrt(square))


def doubtful_view(cameras: Sequence[Camera], xy_px: np.ndarray) -> int:
    """Of a point's contradicting clicks (K, 2) in three views or more: the one without which the others agree best."""
    K = len(cameras)
    without = np.where(np.eye(K, dtype=bool)[..., None], np.nan, xy_px)
    return int(np.argmin(np.nan_to_num(intersect_clicks(cameras, without).rms_residual_px, nan=np.inf)))


def _closest_points(cameras: Sequence[Camera], xy: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """The points closest to the rays (N, 3), approximately: Σ (I − d dᵀ)(X − C) = 0."""
    A, b = np.zeros((len(xy), 3, 3)), np.zeros((len(xy), 3))
    for k, camera in enumerate(cameras):
        d = camera.rays(np.where(visible[:, k, None], xy[:, k], 0.0), START_STEPS)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        across = (np.eye(3) - d[:, :, None] * d[:, None, :]) * visible[:, k, None, None]
        A += across
        b += across @ camera.centre_m
    return _solve(A + np.eye(3) * 1e-12, b)


def _normal_equations(
    cameras: Sequence[Camera], X: np.ndarray, xy: np.ndarray, P: np.ndarray, visible: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    image, J = project_all(cameras, X)
    there = visible.T
    v = np.where(there[..., None], xy.transpose(1, 0, 2) - image, np.nan)
    J = np.where(there[..., None, None], J, 0.0)
    JP = np.where(there[..., None, None], P.transpose(1, 0, 2, 3) @ J, 0.0)
    N = np.einsum("knia,knib->nab", JP, J)
    rhs = np.einsum("knia,kni->na", JP, np.where(there[..., None], v, 0.0))
    return N, rhs, v.transpose(1, 0, 2)  # (2)


def _solve(N: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """x of N x = rhs for many positive definite 3×3 systems; NaN where there is no solution."""
    with np.errstate(invalid="ignore", over="ignore"):
        x = np.einsum("nij,nj->ni", invert_spd(N), rhs)
    x[~np.isfinite(x).all(axis=1)] = np.nan
    return x
