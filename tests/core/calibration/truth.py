"""A waved bar with its truth, and how far estimated cameras are from true ones."""

from collections.abc import Sequence

import numpy as np

from tricap.core.calibration.bars import BarObservations
from tricap.core.calibration.bundle import Unknowns, normal_equations, residuals
from tricap.core.calibration.network import BarNetwork
from tricap.core.calibration.precision import PredictedError, camera_covariance, predicted_error
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.intersection import forward_intersection
from tricap.core.synthetic.bar import WavedBar, bar_ends

TEST_BARS = bar_ends(800, np.random.default_rng(9), 0.5)
TEST_POINTS = TEST_BARS.reshape(-1, 3)


def observed(waved: WavedBar, labelled: bool = True) -> BarObservations:
    return BarObservations(
        names=tuple(c.name for c in waved.cameras),
        size_px=np.array([c.size_px for c in waved.cameras], dtype=float),
        xy_px=waved.xy_px,
        length_m=waved.length_m,
        frames=np.arange(len(waved.xy_px)),
        labelled=labelled,
    )


def true_network(waved: WavedBar) -> BarNetwork:
    C = len(waved.cameras)
    empty = BarNetwork(
        interior=np.zeros((C, 10)),
        R=np.zeros((C, 3, 3)),
        t=np.zeros((C, 3)),
        middle=waved.ends_m.mean(axis=1),
        direction=(waved.ends_m[:, 0] - waved.ends_m[:, 1]) / waved.length_m,
        length_m=waved.length_m,
    )
    return empty.with_cameras(waved.cameras)


def bound(waved: WavedBar, sigma_px: float, free: np.ndarray | None = None) -> PredictedError:
    """The Cramér–Rao bound over the volume: all right observations, no pseudo-observations."""
    network = true_network(waved)
    C = len(waved.cameras)
    unknowns = Unknowns(free=np.ones(10, bool) if free is None else free, expected=network.interior, sigma=np.full((C, 10), 1e6))
    xy = np.where(waved.swapped[..., None, None], waved.xy_px[:, :, ::-1], waved.xy_px)
    wrong = np.where(waved.swapped[..., None], waved.wrong[:, :, ::-1], waved.wrong)
    used = np.isfinite(xy).all(axis=-1) & ~wrong
    used &= used.sum(axis=1, keepdims=True) >= 2
    normals = normal_equations(network, residuals(network, xy), used.astype(float), unknowns, 1.0)
    covariance = camera_covariance(network, normals, unknowns) * sigma_px**2
    return predicted_error(waved.cameras, unknowns, covariance, TEST_BARS)


def rigid(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R, t of the rigid motion (no scale) from points a to points b."""
    A, B = a - a.mean(axis=0), b - b.mean(axis=0)
    U, _, Vt = np.linalg.svd(A.T @ B)
    R = (U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt).T
    return R, b.mean(axis=0) - R @ a.mean(axis=0)


def error_m(true: Sequence[Camera], estimated: Sequence[Camera], points: np.ndarray = TEST_POINTS) -> float:
    """RMS distance of points, seen by the true cameras without noise and intersected by the estimated ones, after rigid alignment."""
    xy = np.stack([c.project(points) for c in true], axis=1)
    inside = np.stack([c.sees(xy[:, n]) for n, c in enumerate(true)], axis=1)
    xy = np.where(inside[..., None], xy, np.nan)
    X = forward_intersection(estimated, xy, np.broadcast_to(np.eye(2), (*xy.shape, 2))).xyz_m
    ok = np.isfinite(X).all(axis=1)
    R, t = rigid(X[ok], points[ok])
    return float(np.sqrt(np.mean(np.sum((X[ok] @ R.T + t - points[ok]) ** 2, axis=1))))
