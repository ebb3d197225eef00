"""Image points of the reference bar, and its positions from roughly calibrated cameras: robust intersection, and the order of the ends.

Some image points are missing, some wrong, and the ends may be swapped between cameras.

    Σ (I − d dᵀ)(X − C) = 0                                                         (1)   the point closest to the rays of an end
    cost of an order of the ends: Sampson's distance, and | |A − B| / L − 1 |        (2)   truncated, summed over pairs of cameras

Relative orientation of two cameras from the bar alone, for many guesses of focal lengths and distortion at once.

The focal length does not follow from the fundamental matrix when the axes of the cameras meet or are parallel, as in any row of cameras
(Sturm et al. 2005); it follows from the bar, whose length must be the same everywhere. So every guess is tried:

    n = (x_u − c) / f ,   x_d = x_u (1 + κ r_u² / r_corner²)                     (3)   f and κ guessed
    n_jᵀ E n_i = 0 ,   Σ w (n_jᵀ E n_i)² → min , w: Cauchy on Sampson's distance   (4)   eight-point algorithm (Hartley 1997)
    E = U diag(1, 1, 0) Vᵀ → (R, t) with the points in front of both cameras       (5)
    scale = L / median |A − B|                                                    (6)
    score = log CV(|A − B|) + ½ log(Sampson / px) − 4 log(fraction in front of both) (7)   CV: robust coefficient of variation
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import ClassVar

import numpy as np

from ..foundation.arrays import frozen
from ..geometry.camera import Camera
from ..geometry.fundamental import fundamental_matrix
from ..geometry.robust import mad_sigma
from ..geometry.small_matrices import invert_spd
from .network import BarNetwork

REWEIGHTINGS = 4  # of (4)
PAIR_TOLERANCE = 0.008  # of the image width: the points are still distorted
MAGSAC_ITERATIONS = 6000
MAX_POINTS = 400  # of MAGSAC
MIN_POINTS = 8
UNDISTORT_STEPS = 6


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PairGuesses:
    """H guesses of a pair of cameras, and the relative orientation x_j = R x_i + t that follows from each."""

    score: np.ndarray  # (H,) of (7), smaller is better
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
    found = fundamental_matrix(xi[some], xj[some], tolerance, 0.999, MAGSAC_ITERATIONS)
    return none if found is None else (sampson(found[0], xi, xj) < tolerance, found[0])


def sampson(F: np.ndarray, xi: np.ndarray, xj: np.ndarray) -> np.ndarray:
    """Sampson's distance (…, m) of points (…, m, 2) from x_jᵀ F x_i = 0, F (…, 3, 3)."""
    hi, hj = _homogeneous(xi), _homogeneous(xj)
    li, lj = hi @ np.swapaxes(F, -1, -2), hj @ F
    norm = li[..., 0] ** 2 + li[..., 1] ** 2 + lj[..., 0] ** 2 + lj[..., 1] ** 2
    return np.abs(np.sum(hj * li, axis=-1)) / np.sqrt(np.maximum(norm, 1e-30))


def undistorted(xy_px: np.ndarray, size_px: np.ndarray, kappa: float) -> np.ndarray:
    """Points (…, 2) relative to the image centre, without a radial distortion that is κ at the image corner.  (3)"""
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
    """Essential matrices (H, 3, 3) and the median Sampson distance [px] of each.  (4)"""
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
    """R, t of each E with most points in front of both cameras, their depths (H, m), and that fraction (H,).  (5)"""
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


TOLERANCE_PX = 4.0  # distance of an image point from the image of its end
LENGTH_TOLERANCE = 0.05  # of the length of the bar
MAX_FLIPPED_CAMERAS = 9  # with more cameras, each order is compared with the first camera only


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BarObservations:
    """N positions of a bar of known length in C cameras. `labelled`: end 0 is the same end in all cameras of a position."""

    names: tuple[str, ...]
    size_px: np.ndarray  # (C, 2) width, height
    xy_px: np.ndarray  # (N, C, 2 ends, 2) full-frame pixels, NaN: not visible
    length_m: float
    frames: np.ndarray  # (N,) frame numbers
    labelled: bool = True

    noun: ClassVar[str] = "bar"
    tested_together: ClassVar[tuple[int, ...]] = (1, 2)
    fewest_positions: ClassVar[int] = 10
    good_positions: ClassVar[int] = 100

    def __post_init__(self) -> None:
        C = len(self.names)
        object.__setattr__(self, "size_px", frozen(self.size_px, (C, 2), name="size_px"))
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (None, C, 2, 2), name="xy_px"))
        object.__setattr__(self, "frames", frozen(self.frames, (len(self.xy_px),), np.int64, "frames"))

    @property
    def visible(self) -> np.ndarray:
        """(N, C, 2) whether an end is visible."""
        return np.isfinite(self.xy_px).all(axis=-1)

    @property
    def complete(self) -> np.ndarray:
        """(N, C) whether both ends are visible."""
        return self.visible.all(axis=-1)

    @property
    def described(self) -> dict[str, float]:
        """The length, for files."""
        return {"bar_length_m": self.length_m}

    @property
    def tested_pairs(self) -> tuple[tuple[int, int, float], ...]:
        """The two ends and the length."""
        return ((0, 1, self.length_m),)

    def views(self, used: np.ndarray) -> np.ndarray:
        """(N, C) whether both ends are used."""
        return used.all(axis=2)

    def measured(self, used: np.ndarray) -> np.ndarray:
        """(N,) whether each end is used in two cameras at least."""
        return (used.sum(axis=1) >= 2).all(axis=1)

    def supported(self, used: np.ndarray) -> np.ndarray:
        """`used` without the ends that fewer than two cameras show."""
        return enough_rays(used)

    def meeting(self, cameras: tuple[Camera, ...], tolerance_px: float) -> np.ndarray:
        """The image points (N, C, 2) of ends whose rays meet within the tolerance."""
        return met_ends(cameras, self, tolerance_px)[1]

    def part(self, positions: np.ndarray | Sequence[int]) -> "BarObservations":
        """Some of the positions: indices or a mask (N,)."""
        return self.changed(self.xy_px[positions], self.frames[positions], self.labelled)

    def changed(self, xy_px: np.ndarray, frames: np.ndarray | None = None, labelled: bool = True) -> "BarObservations":
        """The same cameras and bar with other image points."""
        return BarObservations(
            names=self.names,
            size_px=self.size_px,
            xy_px=xy_px,
            length_m=self.length_m,
            frames=self.frames if frames is None else frames,
            labelled=labelled,
        )


def with_bars(network: BarNetwork, observations: BarObservations, tolerance_px: float = TOLERANCE_PX) -> tuple[BarNetwork, np.ndarray]:
    """The cameras of `network` with the bar positions of `observations`, and which image points (N, C, 2) fit them.

    As `met_ends`; a bar of the wrong length loses the end with fewer rays, or both.
    """
    ends, used = met_ends(network.cameras(observations.names, observations.size_px), observations, tolerance_px)
    return _bars(network, ends, _of_right_length(ends, used, network.length_m))


def met_ends(cameras: tuple[Camera, ...], observations: BarObservations, tolerance_px: float) -> tuple[np.ndarray, np.ndarray]:
    """The intersections (N, 2, 3) of the rays of the ends, and which image points (N, C, 2) lie within the tolerance, whatever the length.

    An end visible to fewer than two cameras is not used. Where the cameras disagree, an end is intersected from the pair of cameras with
    which most of the others agree.
    """
    visible = observations.visible
    used = visible & (visible.sum(axis=1, keepdims=True) >= 2)
    N = len(visible)
    rays = [_rays(camera, observations.xy_px[:, c].reshape(-1, 2)) for c, camera in enumerate(cameras)]
    centres = np.stack([c.centre_m for c in cameras])
    flat = np.moveaxis(used, 1, 2).reshape(2 * N, -1)  # (2 N, C)
    X = _meeting_points(centres, rays, flat)
    cost = _cost(cameras, observations, X, flat, tolerance_px)
    disputed = np.flatnonzero((cost > 1.0) & (flat.sum(axis=1) >= 3))
    for pair in combinations(range(len(cameras)), 2) if len(disputed) else ():
        only = np.zeros_like(flat[disputed])
        only[:, pair] = flat[disputed][:, pair]
        only[only.sum(axis=1) < 2] = False
        trial = _meeting_points(centres, [r[disputed] for r in rays], only)
        trial_cost = np.where(only.any(axis=1), _cost(cameras, observations, trial, flat, tolerance_px, disputed), np.inf)
        better = trial_cost < cost[disputed]
        X[disputed[better]], cost[disputed[better]] = trial[better], trial_cost[better]
    ends = X.reshape(N, 2, 3)
    return ends, _fitting(cameras, observations, ends, used, tolerance_px)


def _rays(camera: Camera, xy: np.ndarray) -> np.ndarray:
    d = camera.rays(np.where(np.isfinite(xy), xy, np.asarray(camera.size_px) / 2))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def _meeting_points(centres: np.ndarray, rays: list[np.ndarray], used: np.ndarray) -> np.ndarray:
    """(M, 3); far away where fewer than two rays are used.  (1)"""
    A, b = np.tile(np.eye(3)[..., None] * 1e-9, len(used)), np.zeros((3, len(used)))
    for c, d in enumerate(rays):
        across = (np.eye(3)[..., None] - d.T[:, None] * d.T) * used[:, c]
        A += across
        b += centres[c] @ across
    return np.einsum("nij,jn->ni", invert_spd(np.moveaxis(A, -1, 0)), b)


def _cost(
    cameras: tuple[Camera, ...],
    observations: BarObservations,
    X: np.ndarray,
    used: np.ndarray,
    width_px: float,
    rows: np.ndarray | None = None,
) -> np.ndarray:
    """Σ min(1, r² / width²) over the cameras (M,), for the ends `rows`."""
    total = np.zeros(len(X))
    for c, camera in enumerate(cameras):
        xy = observations.xy_px[:, c].reshape(-1, 2)
        xy, counts = (xy, used[:, c]) if rows is None else (xy[rows], used[rows, c])
        square = np.sum((xy - camera.project(X)) ** 2, axis=1) / width_px**2
        total += np.where(counts, np.where(np.isfinite(square), np.minimum(square, 1.0), 1.0), 0.0)
    return total


def _fitting(
    cameras: tuple[Camera, ...], observations: BarObservations, ends: np.ndarray, used: np.ndarray, tolerance_px: float
) -> np.ndarray:
    """The image points (N, C, 2) within the tolerance of the projected ends, where there are at least two."""
    near = np.stack([np.linalg.norm(observations.xy_px[:, c] - camera.project(ends), axis=-1) for c, camera in enumerate(cameras)], axis=1)
    with np.errstate(invalid="ignore"):
        return enough_rays(used & (near < tolerance_px))


def _of_right_length(ends: np.ndarray, used: np.ndarray, length_m: float) -> np.ndarray:
    off = np.abs(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / length_m - 1)
    rays = used.sum(axis=1)  # (N, 2)
    wrong = (off > LENGTH_TOLERANCE) & (rays > 0).all(axis=1)
    keep = np.ones_like(rays, dtype=bool)
    keep[wrong] = rays[wrong] > rays[wrong][:, ::-1]
    return used & keep[:, None, :]


def enough_rays(used: np.ndarray) -> np.ndarray:
    """`used` (N, C, 2) without the ends that fewer than two cameras show."""
    return used & (used.sum(axis=1, keepdims=True) >= 2)


def _bars(network: BarNetwork, ends: np.ndarray, used: np.ndarray) -> tuple[BarNetwork, np.ndarray]:
    """Middles and directions of ends (N, 2, 3); where only one end is known, the direction is arbitrary."""
    known = used.any(axis=1)  # (N, 2)
    difference = ends[:, 0] - ends[:, 1]
    difference[~known.all(axis=1)] = [1.0, 0.0, 0.0]
    norm = np.linalg.norm(difference, axis=1, keepdims=True)
    direction = np.where(norm > 1e-9, difference / np.maximum(norm, 1e-9), [1.0, 0.0, 0.0])
    half = direction * network.length_m / 2
    middle = np.where(known.all(axis=1)[:, None], ends.mean(axis=1), np.where(known[:, :1], ends[:, 0] - half, ends[:, 1] + half))
    middle[~known.any(axis=1)] = 0.0
    return replace(network, middle=middle, direction=direction), used


def labelled_ends(network: BarNetwork, observations: BarObservations, tolerance_px: float) -> BarObservations:
    """The observations with the ends in the same order in all cameras: at each position the order that fits the cameras best.  (2)"""
    cameras = network.cameras(observations.names, observations.size_px)
    C, N = len(cameras), len(observations.xy_px)
    pairs = {(i, j): _pair_cost(cameras, observations, i, j, tolerance_px) for i, j in combinations(range(C), 2)}
    if C > MAX_FLIPPED_CAMERAS:
        flips = np.stack([np.zeros(N, dtype=bool), *(pairs[0, j][:, 1] < pairs[0, j][:, 0] for j in range(1, C))], axis=1)
    else:
        orders = (np.arange(2 ** (C - 1))[:, None] >> np.arange(C - 1)) & 1
        orders = np.concatenate([np.zeros((len(orders), 1), dtype=int), orders], axis=1)
        total = np.stack([sum((pairs[i, j][:, o[i] ^ o[j]] for i, j in pairs), np.zeros(N)) for o in orders])
        flips = orders[np.argmin(total, axis=0)].astype(bool)
    xy = np.where(flips[..., None, None], observations.xy_px[:, :, ::-1], observations.xy_px)
    return observations.changed(xy)


def _pair_cost(cameras: tuple[Camera, ...], observations: BarObservations, i: int, j: int, tolerance_px: float) -> np.ndarray:
    """Cost (N, 2) of the same and of the swapped order of the ends in camera j.  (2)"""
    a, b = cameras[i], cameras[j]
    visible = observations.visible
    R = b.R_cam_world @ a.R_cam_world.T
    t = b.t_cam_world_m - R @ a.t_cam_world_m
    E = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ R
    xi, xj = (np.where(visible[:, c, :, None], observations.xy_px[:, c], np.asarray(cameras[c].size_px) / 2) for c in (i, j))
    ni, nj = a.directions(xi), b.directions(xj)
    focal = np.sqrt(a.focal_px * b.focal_px)
    cost = np.zeros((len(xi), 2))
    for other in (0, 1):
        mj, visible_j = (nj[:, ::-1], visible[:, j, ::-1]) if other else (nj, visible[:, j])
        both = visible[:, i] & visible_j
        distance = np.minimum(sampson(E, ni[..., :2], mj[..., :2]) * focal / tolerance_px, 1.0) ** 2
        cost[:, other] = np.sum(np.where(both, distance, 0.0), axis=1)
        off = np.abs(_lengths(ni @ R.T, mj, t) / observations.length_m - 1) / LENGTH_TOLERANCE
        cost[:, other] += np.where(both.all(axis=1), np.minimum(off, 1.0) ** 2, 0.0)
    return cost


def _lengths(hi: np.ndarray, hj: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Lengths (N,) of bars whose ends lie on rays (N, 2, 3) of two cameras; huge where a depth is negative."""
    aa, bb, ab = np.sum(hi * hi, -1), np.sum(hj * hj, -1), np.sum(hi * hj, -1)
    determinant = np.maximum(aa * bb - ab * ab, 1e-15)
    depth_i = (ab * (hj @ t) - bb * (hi @ t)) / determinant
    depth_j = (aa * (hj @ t) - ab * (hi @ t)) / determinant
    points = (hi * depth_i[..., None] + t + hj * depth_j[..., None]) / 2
    behind = ((depth_i <= 0) | (depth_j <= 0)).any(axis=1)
    return np.where(behind, 1e9, np.linalg.norm(points[:, 0] - points[:, 1], axis=1))
