"""The world's frame: rigid, Z up, and where the user says it is."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.calibrating import calibrate_rig
from tricap.core.calibration.world_frame import WorldFrame, frame_of_cameras, frame_of_level_bar, frame_of_points, frame_on_floor
from tricap.core.errors import InputError
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.progress import Monitor
from tricap.core.synthetic.bar import BarNoise, bar_ends, benchmark_cameras, waved_bar

from .truth import observed

CAMERAS = benchmark_cameras()  # their y axes point down along +y of the world


def check_rigid(frame: WorldFrame) -> None:
    assert np.allclose(frame.R @ frame.R.T, np.eye(3)) and np.linalg.det(frame.R) == pytest.approx(1)
    points = bar_ends(10, np.random.default_rng(0), 0.5).reshape(-1, 3)
    for camera in CAMERAS:
        assert np.nanmax(np.abs(frame.camera(camera).project(frame.points(points)) - camera.project(points))) < 1e-8


def test_cameras_alone() -> None:
    points = np.random.default_rng(1).normal(0, 0.2, (50, 3)) + [0, 0, 2.5]
    frame = frame_of_cameras(CAMERAS, points)
    check_rigid(frame)
    assert np.abs(frame.points(np.median(points, axis=0))).max() < 1e-12
    assert frame.R[2] @ [0, -1, 0] > 0.999 and frame.R[1] @ [0, 0, 1] > 0.999


def test_three_points() -> None:
    frame = frame_of_points(np.array([1.0, 2, 3]), np.array([1.0, 4, 3]), np.array([0.0, 2, 3]))
    check_rigid(frame)
    assert frame.points(np.array([1.0, 4, 3])).tolist() == pytest.approx([2, 0, 0])
    assert frame.points(np.array([0.0, 2, 3])).tolist() == pytest.approx([0, 1, 0])
    with pytest.raises(InputError, match="one line"):
        frame_of_points(np.zeros(3), np.array([1.0, 0, 0]), np.array([2.0, 0, 0]))


def test_floor_is_below_the_cameras() -> None:
    rng = np.random.default_rng(0)
    floor = np.stack([rng.uniform(-1, 1, 9), np.full(9, 1.2), rng.uniform(2, 3, 9)], axis=-1)
    frame = frame_on_floor(floor, CAMERAS)
    check_rigid(frame)
    assert np.abs(frame.points(floor)[:, 2]).max() < 1e-9
    assert all(frame.camera(c).centre_m[2] == pytest.approx(1.2, abs=0.05) for c in CAMERAS)
    with pytest.raises(InputError, match="one line"):
        frame_on_floor(np.outer(np.arange(4), [1.0, 0, 0]), CAMERAS)
    with pytest.raises(InputError, match="at least three"):
        frame_on_floor(floor[:2], CAMERAS)


def test_level_bars_make_the_horizon() -> None:
    tilt = rotation_from_vector(np.array([0.1, 0.0, 0.05]))
    level = np.array([[1.0, 0, 0], [0, 0, 1.0], [0.7, 0, 0.7]]) @ tilt.T
    frame = frame_of_level_bar(level, CAMERAS, np.zeros(3))
    check_rigid(frame)
    assert np.abs((level @ frame.R.T)[:, 2]).max() < 1e-12
    with pytest.raises(InputError, match="parallel"):
        frame_of_level_bar(level[:1], CAMERAS, np.zeros(3))


def test_floor_frames_of_a_calibration() -> None:
    """Bars 5 and 40 lie on a floor at y = 0.6 of the truth; it becomes z = 0."""
    waved = waved_bar(CAMERAS, 80, np.random.default_rng(0), BarNoise(sigma_px=0.02, gross=0.0, missing=0.0))
    ends = waved.ends_m.copy()
    ends[5], ends[40] = [[-0.25, 0.6, 2.4], [0.25, 0.6, 2.4]], [[0.0, 0.6, 2.3], [0.0, 0.6, 2.8]]
    xy = np.stack([c.project(ends) for c in CAMERAS], axis=1) + np.random.default_rng(1).normal(0, 0.02, waved.xy_px.shape)
    laid = replace(waved, ends_m=ends, xy_px=xy)
    done = calibrate_rig(observed(laid), Monitor(), floor_frames=(5, 40))
    assert np.abs(done.calibration.network.ends_m[[5, 40]][..., 2]).max() < 2e-3
    assert all(c.centre_m[2] == pytest.approx(0.6, abs=0.05) for c in done.rig.cameras)
    with pytest.raises(InputError, match="Frame 999"):
        calibrate_rig(observed(laid), Monitor(), floor_frames=(999, 5))
