"""Relative orientation of two cameras from the bar alone, for many guesses of focal lengths and distortion at once.

The focal length does not follow from the fundamental matrix when the axes of the cameras meet or are parallel, as in any row of cameras
(Sturm et al. 2005); it follows from the bar, whose length must be the same everywhere. So every guess is tried:

    n = (x_u − c) / f ,   x_d = x_u (1 + κ r_u² / r_corner²)                     (1)   f and κ guessed
    n_jᵀ E n_i = 0 ,   Σ w (n_jᵀ E n_i)² → min , w: Cauchy on Sampson's distance   (2)   eight-point algorithm (Hartley 1997)
    E = U diag(1, 1, 0) Vᵀ → (R, t) with the points in front of both cameras       (3)
    scale = L / median |A − B|                                                    (4)
    score = log CV(|A − B|) + ½ log(Sampson / px) − 4 log(fraction in front of both) (5)   CV: robust coefficient of variation
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.robust import mad_sigma

REWEIGHTINGS = 4  # of (2)
PAIR_TOLERANCE = 0.008  # of the image width: the points are still distorted
MAGSAC_ITERATIONS = 6000
MAX_POINTS = 400  # of MAGSAC
MIN_POINTS = 8
UNDISTORT_STEPS = 6


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PairGuesses:
    """H guesses of a pair of cameras, and the relative orientation x_j = R x_i + t that follows from each."""

    score: np.ndarray  # (H,) of (5), smaller is better
    R: np.ndarray  # (H, 3, 3)
    t_m: np.ndarray  # (H, 3)


def agreeing(xi: np.ndarray, xj: np.ndarray, width_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Which of m points (m, 2) agree with one fundamental matrix, and that matrix (3, 3); none where there is no matrix (MAGSAC++).

    The tolerance is wide, because the points are distorted.
    """
    none = np.zeros(len(xi), dtype=bool), np.zeros((3, 3))
    if len(xi) < MIN_POINTS:
        return none
    some = np.unique(np.linspace(0, len(xi) - 1, MAX_POINTS).astype(int))
    tolerance = PAIR_TOLERANCE * width_px
    F, _ = cv2.findFundamentalMat(
        np.ascontiguousarray(xi[some]), np.ascontiguousarray(xj[some]), cv2.USAC_MAGSAC, tolerance, 0.999, MAGSAC_ITERATIONS
    )
    if F is None or F.shape != (3, 3):
        return none
    return sampson(F, xi, xj) < tolerance, F


def sampson(F: np.ndarray, xi: np.ndarray, xj: np.ndarray) -> np.ndarray:
    """Sampson's distance (…, m) of points (…, m, 2) from x_jᵀ F x_i = 0, F (…, 3, 3)."""
    hi, hj = _homogeneous(xi), _homogeneous(xj)
    li, lj = hi @ np.swapaxes(F, -1, -2), hj @ F
    norm = li[..., 0] ** 2 + li[..., 1] ** 2 + lj[..., 0] ** 2 + lj[..., 1] ** 2
    return np.abs(np.sum(hj * li, axis=-1)) / np.sqrt(np.maximum(norm, 1e-30))


def undistorted(xy_px: np.ndarray, size_px: np.ndarray, kappa: float) -> np.ndarray:
    """Points (…, 2) relative to the image centre, without a radial distortion that is κ at the image corner.  (1)"""
    centred = xy_px - (size_px - 1) / 2
    corner2 = float(size_px @ size_px) / 4
    u = centred
    for _ in range(UNDISTORT_STEPS):
        u = centred / (1 + kappa * np.sum(u * u, axis=-1, keepdims=True) / corner2)
    return u


def try_guesses(ui: np.ndarray, uj: np.ndarray, bars: int, fi: np.ndarray, fj: np.ndarray, length_m: float) -> PairGuesses:
    """Evaluate H guesses fi, fj (H,) of the focal lengths; `ui`, `uj` (m, 2) are centred, undistorted points.

    The first 2 `bars` of them are the ends of complete bars, in pairs; the rest are single ends.
    """
    ni, nj = ui / fi[:, None, None], uj / fj[:, None, None]
    focal = np.sqrt(fi * fj)
    E, distance = _essential(ni, nj, focal)
    R, t, depth_i, depth_j, in_front = _decomposed(E, ni, nj)
    hi, hj = _homogeneous(ni), _homogeneous(nj)
    points = ((hi * depth_i[..., None]) @ R.transpose(0, 2, 1) + t[:, None] + hj * depth_j[..., None]) / 2
    lengths = np.linalg.norm(points[:, 0 : 2 * bars : 2] - points[:, 1 : 2 * bars : 2], axis=-1)
    median = np.maximum(np.median(lengths, axis=1), 1e-12)
    variation = mad_sigma(lengths - median[:, None], 1) / median
    score = np.log(np.maximum(variation, 1e-5)) + 0.5 * np.log(np.maximum(distance, 0.02)) - 4 * np.log(np.maximum(in_front, 1e-3))
    return PairGuesses(score=score, R=R, t_m=t * (length_m / median)[:, None])


def _homogeneous(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)


def _essential(ni: np.ndarray, nj: np.ndarray, focal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Essential matrices (H, 3, 3) and the median Sampson distance [px] of each.  (2)"""
    hi, hj = _homogeneous(ni), _homogeneous(nj)
    A = (hj[..., :, None] * hi[..., None, :]).reshape(*hi.shape[:2], 9)
    weight = np.ones(hi.shape[:2])
    E = np.zeros((len(hi), 3, 3))
    distance = weight
    for _ in range(REWEIGHTINGS):
        N = (A * weight[..., None]).transpose(0, 2, 1) @ A
        diagonal = 1 / np.sqrt(np.maximum(np.einsum("hii->hi", N), 1e-30))
        _, vectors = np.linalg.eigh(N * diagonal[:, :, None] * diagonal[:, None, :])
        E = (vectors[:, :, 0] * diagonal).reshape(-1, 3, 3)
        U, _, Vt = np.linalg.svd(E)
        E = (U * np.array([1.0, 1.0, 0.0])) @ Vt
        distance = sampson(E, ni, nj) * focal[:, None]
        width = np.maximum(2 * np.median(distance, axis=1, keepdims=True), 0.05)
        weight = 1 / (1 + (distance / width) ** 2)
    return E, np.median(distance, axis=1)


def _decomposed(E: np.ndarray, ni: np.ndarray, nj: np.ndarray) -> tuple[np.ndarray, ...]:
    """R, t of each E with most points in front of both cameras, their depths (H, m), and that fraction (H,).  (3)"""
    U, _, Vt = np.linalg.svd(E)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    candidates = []
    for W in (turn, turn.T):
        R = U @ W @ Vt
        R = R * np.sign(np.linalg.det(R))[:, None, None]
        candidates += [(R, U[:, :, 2]), (R, -U[:, :, 2])]
    R = np.stack([r for r, _ in candidates], axis=1)
    t = np.stack([s for _, s in candidates], axis=1)  # (H, 4, …)
    depth_i, depth_j = _depths(R, t, _homogeneous(ni)[:, None], _homogeneous(nj)[:, None])
    in_front = ((depth_i > 0) & (depth_j > 0)).mean(axis=-1)
    best = np.argmax(in_front, axis=1)
    row = np.arange(len(E))
    return R[row, best], t[row, best], depth_i[row, best], depth_j[row, best], in_front[row, best]


def _depths(R: np.ndarray, t: np.ndarray, hi: np.ndarray, hj: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depths that fit λ_j h_j = λ_i R h_i + t best."""
    a = hi @ np.swapaxes(R, -1, -2)
    t = t[..., None, :]
    aa, bb, ab = np.sum(a * a, -1), np.sum(hj * hj, -1), np.sum(a * hj, -1)
    at, bt = np.sum(a * t, -1), np.sum(hj * t, -1)
    determinant = np.maximum(aa * bb - ab * ab, 1e-15)
    return (ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant
