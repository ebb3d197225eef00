"""A board held in front of synthetic cameras: its corners with noise, gaps and gross errors, and its pictures, for tests and benchmarks."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.rotation import rotation_from_vector
from .bar import VOLUME_CENTRE_M, VOLUME_SIZE_M

TILT = np.radians(45)  # of the board from the cameras, at most
OVERSAMPLED = 4


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HeldBoard:
    """The truth and the image points of a board with K corners."""

    cameras: tuple[Camera, ...]
    R: np.ndarray  # (N, 3, 3) board → world
    t_m: np.ndarray  # (N, 3)
    xy_px: np.ndarray  # (N, C, K, 2), NaN: missing
    wrong: np.ndarray  # (N, C, K) displaced

    def __post_init__(self) -> None:
        for name in ("R", "t_m", "xy_px", "wrong"):
            getattr(self, name).setflags(write=False)


def held_board(
    cameras: Sequence[Camera],
    corners_m: np.ndarray,
    positions: int,
    rng: np.random.Generator,
    *,
    sigma_px: float = 0.1,
    gross: float = 0.0,
    tilt: float = TILT,
) -> HeldBoard:
    """Hold a board with corners (K, 3) at random places of the volume, facing the cameras to within `tilt`, and take its image points."""
    reach = VOLUME_SIZE_M / 2 - np.ptp(corners_m, axis=0).max() / 3
    t = VOLUME_CENTRE_M + rng.uniform(-1, 1, (positions, 3)) * np.maximum(reach, 0.05)
    axis = rng.normal(0, 1, (positions, 3)) * [1, 1, 0]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    R = rotation_from_vector(axis * rng.uniform(0, tilt, (positions, 1)))
    R = R @ rotation_from_vector(rng.uniform(-np.pi, np.pi, (positions, 1)) * [0.0, 0.0, 1.0] * (tilt > 0))
    points = np.einsum("nij,kj->nki", R, corners_m) + t[:, None]
    return _observed(cameras, [points] * len(cameras), R, t, rng, sigma_px, gross)


def waved_board(
    cameras: Sequence[Camera],
    corners_m: np.ndarray,
    positions: int,
    rng: np.random.Generator,
    *,
    delay_images: Sequence[float],
    pace: float = 0.5,
    sigma_px: float = 0.1,
) -> HeldBoard:
    """Wave a board smoothly through the volume; camera c takes its images `delay_images[c]` later. The truth is that of no delay."""
    phase, rate = rng.uniform(0, 2 * np.pi, 6), np.array([0.18, 0.28, 0.13, 0.23, 0.17, 0.11]) * rng.uniform(0.85, 1.15, 6)
    reach = np.maximum(VOLUME_SIZE_M / 2 - np.ptp(corners_m, axis=0).max() / 3, 0.05)

    def pose(delay: float) -> tuple[np.ndarray, np.ndarray]:
        wave = np.sin(rate * pace * (np.arange(positions) + delay)[:, None] + phase)
        return rotation_from_vector(wave[:, 3:] * [TILT, TILT, 1.5]), VOLUME_CENTRE_M + wave[:, :3] * reach

    taken = [np.einsum("nij,kj->nki", R, corners_m) + t[:, None] for R, t in map(pose, delay_images)]
    return _observed(cameras, taken, *pose(0.0), rng, sigma_px, 0.0)


def _observed(
    cameras: Sequence[Camera], points_m: Sequence[np.ndarray], R: np.ndarray, t_m: np.ndarray, rng: np.random.Generator,
    sigma_px: float, gross: float,
) -> HeldBoard:  # fmt: skip
    """What the cameras see of the corners (N, K, 3) that each of them has before it."""
    xy = np.stack([c.project(points) for c, points in zip(cameras, points_m)], axis=1)
    inside = np.stack([c.sees(xy[:, i]) for i, c in enumerate(cameras)], axis=1)
    wrong = rng.random(inside.shape) < gross
    angle, far = rng.uniform(0, 2 * np.pi, inside.shape), rng.uniform(5, 200, inside.shape)
    xy = xy + rng.normal(0, sigma_px, xy.shape)
    xy += wrong[..., None] * far[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    xy[~inside.all(axis=2)] = np.nan  # a chessboard must be visible as a whole
    return HeldBoard(cameras=tuple(cameras), R=R, t_m=t_m, xy_px=xy, wrong=wrong)


def picture_of_board(
    camera: Camera, picture: np.ndarray, side_px: float, square_m: float, R: np.ndarray, t_m: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The image (h, w) uint8 of a board whose `picture` has squares of `side_px` and its middle at the board's origin; with blur and noise.

    Every pixel is the mean of a finer grid of points of the plane of the board.
    """
    w, h = camera.size_px
    rays = camera.rays(np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (R[:, 2] @ (t_m - camera.centre_m)) / (rays @ R[:, 2])
        at = (camera.centre_m + rays * depth[..., None] - t_m) @ R[:, :2] / square_m * side_px
    at = np.where((depth > 0)[..., None], at, -1e6) + (np.array(picture.shape[::-1]) - 1) / 2
    fine = cv2.resize(at.astype(np.float32), (w * OVERSAMPLED, h * OVERSAMPLED), interpolation=cv2.INTER_LINEAR)
    seen = cv2.remap(picture.astype(np.float32), fine, None, cv2.INTER_LINEAR, borderValue=90.0)
    image = seen.reshape(h, OVERSAMPLED, w, OVERSAMPLED).mean(axis=(1, 3)) * 0.7 + 30
    image = cv2.GaussianBlur(image, (0, 0), 0.6) + rng.normal(0, 1.0, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)
