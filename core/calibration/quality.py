"""The quality of a calibration: the error predicted from the covariance over the volume, and the lengths of bars that were left out.

    predicted 3-D error      (`precision`) at a grid over the box in which the bar was waved
    held-out lengths         five times a fifth of the positions is left out, the rest adjusted, the left-out ends intersected    (1)
                             for bars that passed data snooping, which uses the length, and for all bars whose rays meet
    direction scatter        eigenvalues of mean(d dᵀ); the smallest decides whether the focal lengths are determined            (2)
    mirrored solution        depth reversed about the centre of the volume, and adjusted again; it must fit much worse            (3)

Small residuals in the images prove nothing: they may hide errors a hundred times larger in space.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..foundation.progress import Monitor
from ..geometry.camera import INTERIOR, Camera
from ..geometry.intersection import forward_intersection
from ..geometry.robust import finite_median
from .bundle import LevenbergMarquardt, Unknowns, adjust
from .network import Network, Observations
from .precision import PredictedError, predicted_error
from .self_calibration import GROSS, Calibration

FOLDS = 5  # of (1)
CELLS = (8, 6)  # of an image, for its coverage
VOLUME_CELLS = 4  # along each side of the box
GRID = 9  # test bars along each side of the box
BOX_PERCENTILES = [1, 99]  # of the ends of the bar, along each side of the box
DEPTH_PERCENTILES = (2, 98)  # of the depths of the ends, for their ratio
MIRROR_POSITIONS = 80
HIGH_CORRELATION = 0.95
FEWEST_LENGTHS = 8  # for a drift


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Lengths:
    """Lengths less the known length, from points intersected without using it: (n,) [m], and the middles between these points (n, 3)."""

    residual_m: np.ndarray
    sigma_per_px_m: np.ndarray  # (n,) sigma of each for image points of sigma 1 px and cameras without error
    middle_m: np.ndarray
    frames: np.ndarray

    @property
    def mean_m(self) -> float:
        """Bias of the length."""
        return float(self.residual_m.mean()) if len(self.residual_m) else np.nan

    @property
    def rms_m(self) -> float:
        """Root mean square, bias included."""
        return float(np.sqrt(np.mean(self.residual_m**2))) if len(self.residual_m) else np.nan

    @property
    def median_m(self) -> float:
        """Median of the magnitudes."""
        return finite_median(np.abs(self.residual_m))

    @property
    def drift_m(self) -> np.ndarray:
        """(3,) change of the length from one end of the volume to the other along x, y, z, by linear regression."""
        if len(self.residual_m) < FEWEST_LENGTHS:
            return np.full(3, np.nan)
        A = np.concatenate([self.middle_m - self.middle_m.mean(axis=0), np.ones((len(self.middle_m), 1))], axis=1)
        return np.linalg.lstsq(A, self.residual_m, rcond=None)[0][:3] * np.ptp(self.middle_m, axis=0)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Quality:
    """All figures about one calibration."""

    predicted: PredictedError  # over the box in which the bar was waved
    box_m: np.ndarray  # (2, 3) smallest and largest corner
    used_lengths: Lengths
    held_out: Lengths
    held_out_untested: Lengths  # with the bars rejected as outliers although their rays meet
    scatter: np.ndarray  # (3,) eigenvalues, ascending
    missing_direction: np.ndarray  # (3,) world, in which the bar points least
    coverage: np.ndarray  # (C, 6, 8) image points in each cell
    depth_ratio: np.ndarray  # (C,) largest by smallest depth of the bar's ends
    rms_px: np.ndarray  # (C,) of image coordinates
    shared: np.ndarray  # (C, C) bars with both ends visible to two cameras
    visited: float  # part of the cells of the box that contain an end of the bar
    seen_by_two: float  # part of the box visible to two cameras; the predicted error is that of this part
    rejected: int  # positions complete in two cameras with an end rejected as an outlier
    mirror: float  # sum of squares of the mirrored solution over that of this one
    correlations: tuple[tuple[str, str, str, float], ...]  # camera, unknown, unknown, correlation beyond HIGH_CORRELATION

    @property
    def covered(self) -> np.ndarray:
        """(C,) part of the cells of each image in which the bar is visible."""
        return (self.coverage > 0).mean(axis=(1, 2))


def assess(calibration: Calibration, monitor: Monitor) -> Quality:
    """The quality of a calibration, which should be in its final world frame."""
    observations, network, used, other = calibration.observations, calibration.network, calibration.used, calibration.other
    cameras = network.cameras(observations.names, observations.size_px)
    points = network.points_m
    ends = points[used.any(axis=1)]
    box = np.percentile(ends, BOX_PERCENTILES, axis=0)
    values, axes = _scatter(calibration)
    monitor.step("quality", 0, 3)
    held_out, untested = held_out_lengths(calibration)
    monitor.step("quality", 1, 3)
    mirror = _least_mirrored(calibration)
    monitor.step("quality", 2, 3)
    count = np.maximum(used.sum(axis=(0, 2)), 1)
    square = np.sum(np.where(used[..., None], calibration.residual_px, 0.0) ** 2, axis=(0, 2, 3))
    depth = _depth_ratios(points, used, cameras)
    if other is not None:
        there = other.network.cameras(observations.names, observations.size_px)
        depth = np.maximum(depth, _depth_ratios(other.network.points_m, other.used, there))
    both = observations.views(used).astype(int)
    tests = test_bars(box, observations.length_m)
    predicted = predicted_error(cameras, calibration.every_unknown, calibration.considered, tests)
    whole = observations.measured(used)
    quality = Quality(
        predicted=predicted,
        box_m=box,
        visited=_visited(points[whole].reshape(-1, 3), box),
        seen_by_two=len(predicted.xyz_m) / (2 * len(tests)),
        rejected=int(((observations.views(observations.visible).sum(axis=1) >= 2) & ~whole).sum()),
        used_lengths=lengths_of(observations, used, cameras, np.ones(len(used), dtype=bool)),
        held_out=held_out,
        held_out_untested=untested,
        scatter=values,
        missing_direction=axes[:, 0],
        coverage=_coverage(calibration),
        depth_ratio=depth,
        rms_px=np.sqrt(square / (2 * count)),
        shared=both.T @ both,
        mirror=mirror,
        correlations=_correlations(calibration),
    )
    monitor.step("quality", 3, 3)
    return quality


def _scatter(calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """The eigenvalues (3,) of the directions, ascending, and the axes (3, 3); of bar or board, whichever points into more directions."""
    found = []
    for part in (calibration, calibration.other):
        if part is not None:
            used = part.used
            measured = part.observations.views(used).any(axis=1) if part is calibration.other else part.observations.measured(used)
            values, axes = np.linalg.eigh(part.network.spread[measured].sum(axis=0) / max(int(measured.sum()), 1))
            found.append((values, axes))
    return max(found, key=lambda pair: float(pair[0][0]))


def _coverage(calibration: Calibration) -> np.ndarray:
    """(C, 6, 8) image points used in each cell."""
    parts = [part for part in (calibration, calibration.other) if part is not None]
    size = calibration.observations.size_px
    each = [[_cells(part.observations.xy_px[:, c][part.used[:, c]], size[c]) for c in range(len(size))] for part in parts]
    return np.sum(each, axis=0)


def _depth_ratios(points_m: np.ndarray, used: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    return np.array([_ratio(camera.to_camera(points_m[used[:, c]])[:, 2]) for c, camera in enumerate(cameras)])


def _ratio(depth: np.ndarray) -> float:
    """The largest by the smallest depth, less the extremes; 1 without any."""
    low, high = DEPTH_PERCENTILES
    return float(np.percentile(depth, high) / np.percentile(depth, low)) if len(depth) else 1.0


def _visited(ends_m: np.ndarray, box_m: np.ndarray) -> float:
    cells, _ = np.histogramdd(ends_m, bins=VOLUME_CELLS, range=list(zip(*box_m)))
    return float((cells > 0).mean())


def test_bars(box_m: np.ndarray, length_m: float) -> np.ndarray:
    """Bars (K, 2, 3) over a box: one end at a grid of points, pointing along the three axes in turn, back into the box."""
    axes = [np.linspace(box_m[0, k], box_m[1, k], GRID) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    turn = np.arange(len(points)) % 3
    inward = np.where(points > box_m.mean(axis=0), -1.0, 1.0) * np.eye(3)[turn]
    return np.stack([points, points + inward * length_m], axis=1)


def lengths_of(observations: Observations, used: np.ndarray, cameras: tuple[Camera, ...], which: np.ndarray) -> Lengths:
    """Lengths of the positions `which` (N,) from the image points `used` (N, C, K), each point intersected independently.  (1)"""
    pairs = observations.tested_pairs
    points = sorted({k for pair in pairs for k in pair[:2]})
    rows = np.flatnonzero(which)
    keep = used[rows][:, :, points]
    xy = np.where(keep[..., None], observations.xy_px[rows][:, :, points], np.nan)
    flat = np.moveaxis(xy, 2, 1).reshape(-1, len(cameras), 2)
    found = forward_intersection(cameras, flat, np.broadcast_to(np.eye(2), (*flat.shape, 2)))
    xyz, Q = found.xyz_m.reshape(len(rows), -1, 3), found.covariance_m2.reshape(len(rows), -1, 3, 3)
    a, b = (np.searchsorted(points, [pair[end] for pair in pairs]) for end in (0, 1))
    difference = xyz[:, a] - xyz[:, b]  # (n, pairs, 3)
    length = np.linalg.norm(difference, axis=-1)
    along = difference / np.maximum(length, 1e-12)[..., None]
    variance = np.einsum("npi,npij,npj->np", along, Q[:, a] + Q[:, b], along)
    there = np.isfinite(length).T  # pair by pair
    return Lengths(
        residual_m=(length - [pair[2] for pair in pairs]).T[there],
        sigma_per_px_m=np.sqrt(variance.T[there]),
        middle_m=((xyz[:, a] + xyz[:, b]) / 2).swapaxes(0, 1)[there],
        frames=np.broadcast_to(observations.frames[rows], there.shape)[there],
    )


def held_out_lengths(calibration: Calibration) -> tuple[Lengths, Lengths]:
    """Lengths of the positions, each from cameras adjusted without it: of those used, and of all whose rays meet.  (1)"""
    observations = calibration.observations
    parts, untested = [], []
    for fold in range(FOLDS):
        out = np.unique(observations.frames, return_inverse=True)[1] % FOLDS == fold
        done = adjust(
            calibration.network.at(~out),
            observations.part(~out).xy_px,
            calibration.used[~out],
            calibration.unknowns.in_step,
            unit_px=calibration.sigma0_px,
            iteration=LevenbergMarquardt(max_iterations=6, tolerance=1e-2),
        )
        cameras = done.network.cameras(observations.names, observations.size_px)
        parts.append(lengths_of(observations, calibration.used, cameras, out))
        left = observations.part(out)
        meet = left.meeting(cameras, GROSS * calibration.sigma0_px)
        untested.append(lengths_of(left, meet, cameras, np.ones(len(meet), dtype=bool)))
    return _together(parts), _together(untested)


def _together(parts: list[Lengths]) -> Lengths:
    return Lengths(
        residual_m=np.concatenate([p.residual_m for p in parts]),
        sigma_per_px_m=np.concatenate([p.sigma_per_px_m for p in parts]),
        middle_m=np.concatenate([p.middle_m for p in parts]),
        frames=np.concatenate([p.frames for p in parts]),
    )


def _least_mirrored(calibration: Calibration) -> float:
    """That of the object which distinguishes better; lenses that a board gives are known."""
    other, unknowns = calibration.other, calibration.unknowns.in_step.alone
    focal = ("f",) if other is None else ()
    found = mirrored(calibration.observations, calibration.network, calibration.used, unknowns, calibration.sigma0_px, focal)
    if other is None or other.lenses_only:
        return found
    return max(found, mirrored(other.observations, other.network, other.used, unknowns, other.sigma_px, focal))


def mirrored(
    observations: Observations, network: Network, used: np.ndarray, unknowns: Unknowns, sigma: float, focal: Sequence[str] = ("f",)
) -> float:
    """Sum of squares of the solution with reversed depth over that of this one: far above 1 where perspective distinguishes them.  (3)"""
    some = np.unique(np.linspace(0, len(used) - 1, MIRROR_POSITIONS).astype(int))
    part, used, network = observations.part(some), used[some], network.at(some)
    middle = network.points_m[used.any(axis=1)].mean(axis=0)
    view = network.R[:, 2].mean(axis=0)
    view /= np.linalg.norm(view)
    H = np.eye(3) - 2 * np.outer(view, view)
    R = np.diag([1.0, 1.0, -1.0]) @ network.R @ H
    start = replace(network.transformed(H, middle - H @ middle), R=R, t=network.R @ middle + network.t - R @ middle)
    other = adjust(
        start, part.xy_px, used, unknowns.only(*focal), unit_px=sigma, iteration=LevenbergMarquardt(max_iterations=15, tolerance=1.0)
    )
    this = adjust(network, part.xy_px, used, unknowns, unit_px=sigma, iteration=LevenbergMarquardt(max_iterations=2))
    return other.cost / max(this.cost, 1e-12)


def _cells(xy_px: np.ndarray, size_px: np.ndarray) -> np.ndarray:
    counts, _, _ = np.histogram2d(xy_px[:, 1], xy_px[:, 0], bins=(CELLS[1], CELLS[0]), range=((0, size_px[1]), (0, size_px[0])))
    return counts.astype(int)


def _correlations(calibration: Calibration) -> tuple[tuple[str, str, str, float], ...]:
    free = np.flatnonzero(calibration.unknowns.free)
    p = len(calibration.unknowns.columns)
    high = []
    for c, name in enumerate(calibration.observations.names):
        Q = calibration.covariance[c * p : c * p + len(free), c * p : c * p + len(free)]
        sigma = np.sqrt(np.maximum(np.diag(Q), 1e-30))
        rho = Q / np.outer(sigma, sigma)
        for i, j in zip(*np.nonzero(np.triu(np.abs(rho) > HIGH_CORRELATION, 1))):
            high.append((name, INTERIOR[free[i]], INTERIOR[free[j]], float(rho[i, j])))
    return tuple(high)
