"""Cameras that are not in step: image points of a moving object at the instants of the frames, and how late each camera is.

Camera c takes image n at the instant n + d_c, in images; camera 0 sets the clock, d_0 = 0. Its point at the instant n is interpolated:

    x_c(n) = p(−d_c) ,   p(τ) = Σ a_m τᵐ through image n and those of n − 3 … n + 3 in which the point is known                  (1)
    ∂v / ∂d_c = −p'(−d_c)                                                                                                       (2)

The first d_c come from pairs of cameras, without knowing the cameras: the delay at which one fundamental matrix fits best.      (3)
Pairs that contradict one another are compared by how well all pairs fit.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..foundation.arrays import frozen
from ..geometry.fundamental import fundamental_matrix
from .bars import sampson

STEPS = np.arange(-3, 4)  # images of (1), as far as they are known
FEWEST_STEPS = 4  # of them
NEAR = 2  # images: the nearest on each side
STILL = 1e-4  # images: a point is not interpolated for less, which would lose those without neighbours
SEARCHED = np.arange(-8.0, 8.01, 0.5)  # images, of (3)
REFINED = np.arange(-0.5, 0.51, 0.1)
NEARBY = 0.2  # images: where neither this delay nor its opposite fits better than none, no other is tried
FITS = 0.3  # of WIDTH: a board that fits less well at once may be many images apart, and all delays are tried
CLEAR = 0.7  # of the distance without a delay: what fits less well is none
WIDTH = 0.01  # of the image width: points further from their line count as that far
SEARCH_POSITIONS = 200
ITERATIONS = 500
JUMP = 8.0  # times the median: further from the path through its neighbours, a point is wrong
JUMP_ROUNDS = 6
FEWEST_AROUND, MOST_AROUND = 3, 4  # points from which one is predicted
FEWEST_POINTS = 24  # of a pair of cameras
AGREE = 0.3  # images: delays of pairs that differ by less
LEAST_SHARE = 0.4  # of the positions that the pair shares at once: fewer fit by chance


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MovingPoints:
    """Image points of N positions, K points each, in C cameras, as functions of the cameras' delays.  (1)"""

    frames: np.ndarray  # (N,)
    coefficients: np.ndarray  # (7, N, C, K, 2), lowest first; NaN beyond the first where too few neighbours are known
    expected_images: np.ndarray  # (C,) delays before the adjustment

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", frozen(self.coefficients, (len(STEPS), len(self.frames), None, None, 2)))
        object.__setattr__(self, "expected_images", frozen(self.expected_images, self.coefficients.shape[2:3]))

    def at(self, delay_images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Image points (N, C, K, 2) at the instants of the frames, NaN where they are not known, and their velocity [px / image]."""
        xy = np.empty(self.coefficients.shape[1:])
        velocity = np.empty_like(xy)
        for c, delay in enumerate(delay_images):
            whole = int(np.rint(-delay))
            a = self.coefficients[:, :, c]
            if whole:
                rows, known = self.rows(whole)
                a = np.where(known[:, None, None], a[:, rows], np.nan)
            tau = -float(delay) - whole
            powers = tau ** np.arange(len(a))
            velocity[:, c] = np.nan_to_num(np.tensordot(powers[:-1] * np.arange(1, len(a)), a[1:], axes=1))
            xy[:, c] = a[0] + tau * velocity[:, c] if abs(tau) < STILL else np.tensordot(powers, a, axes=1)
        return xy, velocity

    def shifted(self, whole: int) -> np.ndarray:
        """The image points (N, C, K, 2) that many images later."""
        rows, known = self.rows(whole)
        return np.where(known[:, None, None, None], self.coefficients[0, rows], np.nan)

    def rows(self, whole: int) -> tuple[np.ndarray, np.ndarray]:
        """The positions (N,) that many images later, and whether there is one."""
        order = np.argsort(self.frames, kind="stable")
        at = order[np.minimum(np.searchsorted(self.frames, self.frames + whole, sorter=order), len(order) - 1)]
        return at, self.frames[at] == self.frames + whole


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlacedPoints(MovingPoints):
    """The same for N positions of which several may be of one frame; the frames of `frames` are different ones."""

    of: np.ndarray  # (N,) indices of the frames
    shown: np.ndarray  # (N, C) which cameras show the position

    def at(self, delay_images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Image points (N, C, K, 2) and their velocities."""
        xy, velocity = MovingPoints.at(self, delay_images)
        return np.where(self.shown[..., None, None], xy[self.of], np.nan), velocity[self.of]


def placed_points(moving: MovingPoints, frames: np.ndarray, shown: np.ndarray) -> PlacedPoints:
    """Moving points for positions in these frames (N,) that some cameras (N, C) show."""
    of = np.searchsorted(moving.frames, frames)
    return PlacedPoints(
        frames=moving.frames, coefficients=moving.coefficients, expected_images=moving.expected_images, of=of, shown=shown
    )  # fmt: skip


def moving_points(frames: np.ndarray, xy_px: np.ndarray, expected_images: np.ndarray | None = None) -> MovingPoints:
    """Points (N, C, K, 2) of frames (N,) with the polynomials through their neighbours in time.  (1)"""
    still = _still(frames, xy_px, expected_images)
    near = np.stack([still.shifted(int(s)) for s in STEPS], axis=-2)  # (N, C, K, 7, 2)
    known = np.isfinite(near[..., 0])
    fits = _interpolations()[known @ (1 << np.arange(len(STEPS)))]  # (N, C, K, 7, 7)
    coefficients = np.moveaxis(fits @ np.nan_to_num(near), -2, 0)
    coefficients[0] = xy_px
    return MovingPoints(frames=frames, coefficients=coefficients, expected_images=still.expected_images)


@lru_cache(maxsize=1)
def _interpolations() -> np.ndarray:
    """The coefficients of the polynomial from the points at STEPS (128, 7, 7), for each subset of them that is known; NaN: too few."""
    fits = np.full((1 << len(STEPS), len(STEPS), len(STEPS)), np.nan)
    for subset in range(len(fits)):
        known = np.flatnonzero(subset >> np.arange(len(STEPS)) & 1)
        steps = STEPS[known]
        if 0 in steps and len(steps) >= FEWEST_STEPS and (-NEAR <= steps[steps < 0]).any() and (steps[steps > 0] <= NEAR).any():
            fits[subset] = 0.0
            fits[subset, : len(steps), known] = np.linalg.inv(np.vander(steps, increasing=True)).T
    return fits


def _still(frames: np.ndarray, xy_px: np.ndarray, expected_images: np.ndarray | None = None) -> MovingPoints:
    coefficients = np.concatenate([xy_px[None], np.full((len(STEPS) - 1, *xy_px.shape), np.nan)])
    expected = np.zeros(xy_px.shape[1]) if expected_images is None else expected_images
    return MovingPoints(frames=frames, coefficients=coefficients, expected_images=expected)


def without_jumps(frames: np.ndarray, xy_px: np.ndarray) -> np.ndarray:
    """The points (N, C, K, 2) without those that jump out of their path through the images before and after.

    Each point is predicted from the two nearest ones before it and after it, or from three. The distance is compared with its median in
    the camera, for four and for three points apart, and with that of the neighbours, which a wrong point spoils.
    """
    xy = xy_px.copy()
    weights, noise, count = _predictions()
    for _ in range(JUMP_ROUNDS):
        held = _still(frames, xy)
        near = np.stack([held.shifted(int(s)) for s in STEPS], axis=-2)  # (N, C, K, 7, 2)
        subset = np.isfinite(near[..., 0]) @ (1 << np.arange(len(STEPS)))
        predicted = np.einsum("ncks,ncksx->nckx", weights[subset], np.nan_to_num(near))
        off = np.nan_to_num(np.linalg.norm(xy - predicted, axis=-1) / noise[subset])
        limit = np.full(off.shape, np.inf)
        for c in range(off.shape[1]):
            for number in FEWEST_AROUND, MOST_AROUND:
                of_kind = (count[subset[:, c]] == number) & (off[:, c] > 0)
                if of_kind.any():
                    limit[:, c][of_kind] = JUMP * np.median(off[:, c][of_kind])
        around = np.max([np.where(known[:, None, None], off[at], 0.0) for at, known in map(held.rows, (-2, -1, 1, 2))], axis=0)
        wrong = (off > limit) & (off >= around)
        if not wrong.any():
            break
        xy[wrong] = np.nan
    return xy


@lru_cache(maxsize=1)
def _predictions() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each of the 128 subsets of STEPS that may be known: the weights (128, 7) that predict the point at 0 from the others, the sigma
    (128,) of the difference for points of sigma 1, and how many points predict it; NaN and 0 where there are too few."""
    subsets = 1 << len(STEPS)
    weights, noise, count = np.full((subsets, len(STEPS)), np.nan), np.full(subsets, np.nan), np.zeros(subsets, dtype=int)
    for subset in range(subsets):
        known = np.flatnonzero(subset >> np.arange(len(STEPS)) & 1)
        before, after = known[STEPS[known] < 0][-NEAR:], known[STEPS[known] > 0][:NEAR]
        some = np.concatenate([before, after])
        if len(before) and len(after) and len(some) >= FEWEST_AROUND:
            weights[subset], count[subset] = 0.0, len(some)
            weights[subset, some] = np.linalg.inv(np.vander(STEPS[some], increasing=True))[0]
            noise[subset] = np.sqrt(1 + np.sum(weights[subset] ** 2))
    return weights, noise, count


def first_delays(moving: MovingPoints, size_px: np.ndarray, labelled: bool) -> np.ndarray:
    """Delays (C,) of all cameras behind the first, from pairs of them; 0 where no delay clearly fits better.  (3)"""
    C = len(size_px)
    shown = np.isfinite(moving.coefficients[0, ..., 0]).any(axis=-1)
    shared = shown.T.astype(int) @ shown
    delay, placed = np.zeros(C), [0]
    while len(placed) < C:
        left = [c for c in range(C) if c not in placed]
        i, j = max(((i, j) for i in placed for j in left), key=lambda pair: shared[pair])
        delay[j] = delay[i] + _delay_between(moving, size_px, (i, j), labelled)
        placed.append(j)
    return delay


def agreeing_delays(moving: MovingPoints, size_px: np.ndarray, labelled: bool) -> np.ndarray:
    """`first_delays`; where pairs of cameras contradict one another, of the delays behind each camera those at which all pairs fit best."""
    late, C = first_delays(moving, size_px, labelled), len(size_px)
    between = np.zeros((C, C))
    for i in range(C):
        for j in range(i + 1, C):
            between[i, j] = _delay_between(moving, size_px, (i, j), labelled)
            between[j, i] = -between[i, j]
    if np.abs(late - late[:, None] - between).max() < AGREE:
        return late
    return min([late, *(row - row[0] for row in between)], key=lambda found: misfit(moving, size_px, found, labelled))


def misfit(moving: MovingPoints, size_px: np.ndarray, delay_images: np.ndarray, labelled: bool) -> float:
    """Mean distance of the points of all pairs of cameras from their epipolar lines, in image widths, at these delays.  (3)"""
    C = len(size_px)
    pairs = [(i, j) for i in range(C) for j in range(i + 1, C)]
    every = [_distance(moving, size_px, pair, float(delay_images[pair[1]] - delay_images[pair[0]]), labelled) for pair in pairs]
    return float(np.mean([min(distance, WIDTH) for distance in every]))


def _delay_between(moving: MovingPoints, size_px: np.ndarray, pair: tuple[int, int], labelled: bool) -> float:
    """By how many images the second camera is later than the first."""
    at_once, earlier, later = (_distance(moving, size_px, pair, d, labelled) for d in (0.0, -NEARBY, NEARBY))
    bar = moving.coefficients.shape[3] == 2  # whose few points fit at many delays by chance
    if at_once <= min(earlier, later) and (bar or at_once < FITS * WIDTH):
        return 0.0
    coarse = min(SEARCHED, key=lambda d: _distance(moving, size_px, pair, d, labelled))
    best = min(coarse + REFINED, key=lambda d: _distance(moving, size_px, pair, d, labelled))
    return float(best) if _distance(moving, size_px, pair, best, labelled) < CLEAR * at_once else 0.0


def _distance(moving: MovingPoints, size_px: np.ndarray, pair: tuple[int, int], delay: float, labelled: bool) -> float:
    """Mean distance of the points of two cameras from their epipolar lines, in image widths, at a delay of the second."""
    i, j = pair
    delays = np.zeros(len(size_px))
    delays[j] = delay
    xy = moving.at(delays)[0]
    some = np.flatnonzero(np.isfinite(xy[:, [i, j]]).all(axis=(1, 2, 3)))
    some = some[np.unique(np.linspace(0, max(len(some) - 1, 0), SEARCH_POSITIONS).astype(int))] if len(some) else some
    at_once = np.isfinite(moving.coefficients[0][:, [i, j]]).all(axis=(1, 2, 3)).sum()
    if len(some) * xy.shape[2] < FEWEST_POINTS or len(some) < LEAST_SHARE * min(at_once, SEARCH_POSITIONS):
        return np.inf
    ni, nj = ((xy[some, c] - size_px[c] / 2) / size_px[i, 0] for c in pair)
    orders = (nj,) if labelled or xy.shape[2] != 2 else (nj, nj[:, ::-1])
    return min(_of_one_matrix(ni.reshape(-1, 2), other.reshape(-1, 2)) for other in orders)


def _of_one_matrix(ni: np.ndarray, nj: np.ndarray) -> float:
    found = fundamental_matrix(ni, nj, WIDTH / 2, 0.99, ITERATIONS)
    return WIDTH if found is None else float(np.minimum(sampson(found[0], ni, nj), WIDTH).mean())


def in_order(moving_px: np.ndarray, moved_px: np.ndarray, labelled_px: np.ndarray, delay_images: np.ndarray) -> np.ndarray:
    """Raw image points (N, C, 2, 2) of a bar with its ends in the order that they have in `labelled_px`, at the instants of the frames.

    `moved_px` are the raw points at these instants, in the order of the raw points.
    """
    xy, N = moving_px.copy(), len(moving_px)
    swapped = np.nan_to_num(moved_px[:, :, 0]) != np.nan_to_num(labelled_px[:, :, 0])
    for c, delay in enumerate(delay_images):
        known = np.flatnonzero(np.isfinite(moved_px[:, c]).any(axis=(1, 2)))
        if not len(known):
            continue
        nearest = known[np.clip(np.searchsorted(known, np.arange(N) + int(np.rint(delay))), 0, len(known) - 1)]
        turn = swapped[nearest, c].any(axis=1)
        xy[turn, c] = xy[turn, c, ::-1]
    return xy
