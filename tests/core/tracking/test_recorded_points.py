"""Key points on recordings: corners of a board moved by hand before webcams, six frames a second (../shared/takes)."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.rig_files import read_any
from tricap.core.images.fields import Instants
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.progress import Monitor
from tricap.core.tracking.key_points import KeyPoints, track_key_points
from tricap.core.tracking.settings import TrackingSettings, TrackStatus
from tricap.core.tracking.step import TrackingView

VIEWS = (0, 3, 2)  # of four; neighbours, the middle one in the middle
SQUARES, SQUARE_M = (4, 5), 0.054
FIRST, LAST = 69, 78  # the board is shown to all three, and turned


def board_images(folder: Path) -> list[list[np.ndarray]]:
    """Grey images (h, w) float32 of the three views in each of the frames."""
    views = []
    for number in VIEWS:
        movie = cv2.VideoCapture(str(folder / f"cam_{number}.mp4"))
        frames = [movie.read()[1] for _ in range(LAST + 1)][FIRST:]
        views.append([cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY).astype(np.float32) for frame in frames])
    return [list(images) for images in zip(*views)]


def detected(images: list[np.ndarray]) -> dict[int, dict[int, np.ndarray]]:
    """The board's corners in each view: corner → view → pixel."""
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE_M, 0.75 * SQUARE_M, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000))
    corners: dict[int, dict[int, np.ndarray]] = {}
    for k, image in enumerate(images):
        xy, number, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(255 - image.astype(np.uint8))
        for n, at in zip(np.ravel(number), np.reshape(xy, (-1, 2))):
            corners.setdefault(int(n), {})[k] = at.astype(np.float64)
    return corners


def side_errors_m(points: KeyPoints, numbers: list[int]) -> np.ndarray:
    """By how much neighbouring corners' distances differ from the squares' side, wherever both were seen."""
    across = SQUARES[0] - 1
    pairs = [(i, j) for i, a in enumerate(numbers) for j, b in enumerate(numbers) if b == a + across or (b == a + 1 and b % across)]
    seen = points.status == TrackStatus.MEASURED
    parts = [np.linalg.norm(points.xyz_m[:, i] - points.xyz_m[:, j], axis=1)[seen[:, i] & seen[:, j]] - SQUARE_M for i, j in pairs]
    return np.concatenate(parts)


@pytest.mark.slow
def test_corners_of_a_board_keep_their_distances(shared_takes: Path) -> None:
    folder = shared_takes / "upperbody_4cam_charuco_caliscope"
    rig = read_any(folder / "camera_array.toml")
    images = board_images(folder)
    corners = {n: views for n, views in detected(images[0]).items() if len(views) == len(VIEWS)}
    view = TrackingView(
        cameras=tuple(rig.cameras[n] for n in VIEWS), reference=1, instants=Instants(), matching=MatchingSettings(patch_px=21),
        tracking=TrackingSettings(box_px=48, max_residual_px=3.0, max_speed=20.0), limit_px=3.0, dt_s=1 / 6,
    )  # fmt: skip
    names = [camera.name for camera in view.cameras]
    clicks = {str(n): {names[k]: at for k, at in views.items()} for n, views in corners.items()}
    points = track_key_points(lambda t: images[t], range(len(images)), clicks, view, Monitor())
    errors = side_errors_m(points, list(corners))
    assert np.sqrt(np.mean(errors**2)) < 1e-3
    assert (points.status == TrackStatus.MEASURED).mean() > 0.85
