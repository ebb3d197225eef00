"""The world's frame: rigid, Z up, and where the user says it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.__main__ import main
from tricap.core.calibration.calibrate import calibrate_rig
from tricap.core.calibration.world_frame import (
    WorldChoice,
    WorldFrame,
    frame_like,
    frame_of_cameras,
    frame_of_clicks,
    frame_of_level_bar,
    frame_of_points,
    frame_on_floor,
)
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rig import Rig, read_rig, write_rig
from tricap.core.geometry.rotation import rotation_from_vector
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


@pytest.mark.parametrize("count", [3, 1])
def test_cameras_stay_where_others_of_their_names_are(count: int) -> None:
    moved = WorldFrame(R=rotation_from_vector(np.array([0.4, -1.1, 2.0])), shift_m=np.array([3.0, -1.0, 0.5]))
    there = [moved.camera(camera) for camera in CAMERAS[:count]]
    frame = frame_like(CAMERAS, there)
    check_rigid(frame)
    np.testing.assert_allclose(frame.R, moved.R, atol=1e-9)
    np.testing.assert_allclose(frame.shift_m, moved.shift_m, atol=1e-9)
    with pytest.raises(InputError, match="give them the same names"):
        frame_like(CAMERAS, [replace(there[0], name="X")])
    if count > 1:
        with pytest.raises(InputError, match="moved or swapped"):
            frame_like(CAMERAS, [replace(there[0], name="R"), replace(there[2], name="L")])


def test_the_command_keeps_the_world(tmp_path: Path) -> None:
    moved = WorldFrame(R=rotation_from_vector(np.array([0.4, -1.1, 2.0])), shift_m=np.array([3.0, -1.0, 0.5]))
    write_rig(tmp_path / "new.toml", Rig(cameras=CAMERAS))
    write_rig(tmp_path / "old.toml", Rig(cameras=tuple(map(moved.camera, CAMERAS)), metadata={"floor": True}))
    new, old, out = (str(tmp_path / f"{name}.toml") for name in ("new", "old", "o"))
    assert main(["calibrate", "--import", new, "--like", old, "--out", out, "--quiet"]) == 0
    rig = read_rig(tmp_path / "o.toml")
    assert rig.metadata["floor"] is True
    for a, b in zip(rig.cameras, map(moved.camera, CAMERAS)):
        np.testing.assert_allclose(a.centre_m, b.centre_m, atol=1e-9)


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
    done = calibrate_rig(observed(laid), Monitor(), world=WorldChoice(floor_frames=(5, 40)))
    assert np.abs(done.calibration.network.ends_m[[5, 40]][..., 2]).max() < 2e-3
    assert all(c.centre_m[2] == pytest.approx(0.6, abs=0.05) for c in done.rig.cameras)
    level = calibrate_rig(observed(laid), Monitor(), world=WorldChoice(level_frames=(5, 40)))
    assert np.abs(np.diff(level.calibration.network.ends_m[[5, 40]][..., 2])).max() < 2e-3
    assert done.rig.metadata["floor"] is True and level.rig.metadata["floor"] is False
    with pytest.raises(InputError, match="Frame 999"):
        calibrate_rig(observed(laid), Monitor(), world=WorldChoice(floor_frames=(999, 5)))


CLICKED = {"origin": [0.2, 0.5, 2.5], "x": [0.9, 0.5, 2.6], "y": [0.1, 0.5, 3.2]}


def clicks(error_px: float = 0.0) -> dict[str, dict[str, list[float]]]:
    pixels = {name: {c.name: c.project(np.array([at]))[0].tolist() for c in CAMERAS} for name, at in CLICKED.items()}
    pixels["y"][CAMERAS[0].name][0] += error_px
    return pixels


def test_three_clicked_points_are_the_frame() -> None:
    frame = frame_of_clicks(CAMERAS, clicks())
    check_rigid(frame)
    origin, x, y = (frame.points(np.array(at)) for at in CLICKED.values())
    assert np.abs(origin).max() < 1e-6 and np.abs(x[1:]).max() < 1e-6 < x[0] and abs(y[2]) < 1e-6 < y[1]


@pytest.mark.parametrize(
    "points, said",
    [
        ({k: v for k, v in clicks().items() if k != "x"}, "“x” of the world's frame is clicked in 0 view"),
        (clicks() | {"x": {CAMERAS[0].name: [1.0, 2.0]}}, "“x” of the world's frame is clicked in 1 view"),
        (clicks() | {"x": {"none": [1.0, 2.0]}}, "view “none”, which the rig does not have"),
        (clicks(80.0), "clicks of the point “y” of the world's frame miss each other by"),
        (clicks() | {"y": clicks()["x"]}, "lie on one line"),
    ],
)
def test_clicked_points_that_make_no_frame(points: dict[str, dict[str, list[float]]], said: str) -> None:
    with pytest.raises(InputError, match=said):
        frame_of_clicks(CAMERAS, points)
    with pytest.raises(InputError, match="given twice"):
        WorldChoice(points=points, floor_frames=(1, 2))


def test_an_imported_rig_gets_the_clicked_frame(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    write_rig(rig, Rig(cameras=tuple(CAMERAS)))
    rows = [f"{name},{view},{x},{y}" for name, at in clicks().items() for view, (x, y) in at.items()]
    (tmp_path / "world é.csv").write_text("\n".join(["point,view,x,y", *rows]), encoding="utf-8")
    out, points = tmp_path / "out.toml", str(tmp_path / "world é.csv")
    assert main(["calibrate", "--import", str(rig), "--points", points, "--out", str(out), "--quiet"]) == 0
    moved = read_rig(out)
    assert moved.metadata["floor"] is True
    for camera in CAMERAS:
        expected = frame_of_clicks(CAMERAS, clicks()).camera(camera)
        np.testing.assert_allclose(moved[camera.name].centre_m, expected.centre_m, atol=1e-9)
    assert main(["calibrate", "--import", str(rig), "--floor", "1,2", "--out", str(out), "--quiet"]) == 2
