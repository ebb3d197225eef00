"""Points on recordings (../shared/takes): corners of a board moved by hand, a cylinder under load, a desk that a hand passes over."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.calibration.rig_files import read_any
from tricap.core.cli.main import main
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.images.interlace import FieldLayout
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.tracking.key_points import KeyPoints, track_key_points
from tricap.core.tracking.point_tables import read_planar
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
    """Differences of neighbouring corners' distances from the squares' side, where both are visible."""
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
        cameras=tuple(rig.cameras[n] for n in VIEWS), reference=1, field_layout=FieldLayout(), matching=MatchingSettings(patch_px=21),
        tracking=TrackingSettings(box_px=48, max_residual_px=3.0, max_speed=20.0), limit_px=3.0, dt_s=1 / 6,
    )  # fmt: skip
    names = [camera.name for camera in view.cameras]
    clicks = {str(n): {names[k]: at for k, at in views.items()} for n, views in corners.items()}
    points = track_key_points(lambda t: images[t], range(len(images)), clicks, view, Monitor())
    errors = side_errors_m(points, list(corners))
    assert np.sqrt(np.mean(errors**2)) < 1e-3
    assert (points.status == TrackStatus.MEASURED).mean() > 0.85


STEPS, RADIUS_M = 5, 0.0502  # of load; of the unloaded cylinder, by its speckles' meeting points
MARGIN_PX = 120


def windows(folder: Path, about_m: np.ndarray) -> tuple[list[Camera], list[list[np.ndarray]]]:
    """Both cameras at half resolution, cut to what lies about the points (N, 3), and their images [step][camera]."""
    cameras, images = [], []
    for told in json.loads((folder / "calibration.json").read_text(encoding="utf-8"))["cameras"]:
        matrix = np.array(told["K"])
        matrix[:2] /= 2
        matrix[:2, 2] -= 0.25
        w, h = (n // 2 for n in told["size"])
        whole = Camera(name=told["name"], size_px=(w, h), matrix=matrix, distortions=np.array([*told["D"], *[0.0] * (5 - len(told["D"]))]),
                       R_cam_world=np.array(told["R"]), t_cam_world_m=np.array(told["t"]) / 1000)  # fmt: skip
        at = whole.project(about_m)
        (left, top), (right, bottom) = (np.rint(edge).astype(int) for edge in (at.min(axis=0) - MARGIN_PX, at.max(axis=0) + MARGIN_PX))
        matrix[:2, 2] -= left, top
        cameras.append(replace(whole, size_px=(int(right - left), int(bottom - top)), matrix=matrix))
        paths = [str(folder / f"{told['name']}_{step}.jpg") for step in range(1, STEPS + 1)]
        halves = [cv2.resize(cv2.imread(path, cv2.IMREAD_GRAYSCALE), (w, h), interpolation=cv2.INTER_AREA) for path in paths]
        images.append([half[top:bottom, left:right].astype(np.float32) for half in halves])
    return cameras, [list(step) for step in zip(*images)]


@pytest.mark.slow
def test_a_cylinder_under_load_is_tracked_through_its_steps(shared_takes: Path) -> None:
    """It shrinks by 0.4 to 0.5 mm a step, and its points stay on it; tracked back they return to their start."""
    angle, z = np.meshgrid(np.radians(np.linspace(45, 105, 15)), np.linspace(0.06, 0.15, 13))
    about = np.stack([RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), z], axis=-1).reshape(-1, 3)
    cameras, images = windows(shared_takes / "cylinder_2cam_multidic", about)
    view = TrackingView(cameras=tuple(cameras), reference=0, field_layout=FieldLayout(), matching=MatchingSettings(patch_px=21),
                        tracking=TrackingSettings(max_residual_px=2.0), limit_px=2.0, dt_s=1.0)  # fmt: skip
    clicks = {str(n): {c.name: c.project(X) for c in cameras} for n, X in enumerate(about)}
    there = track_key_points(lambda t: images[t], range(STEPS), clicks, view, Monitor())
    through = (there.status == TrackStatus.MEASURED).all(axis=0)
    assert through.mean() > 0.98
    from_axis = np.hypot(there.xyz_m[..., 0], there.xyz_m[..., 1])[:, through]
    shrinking = -np.diff(from_axis, axis=0)
    assert (np.abs(shrinking.mean(axis=1) - 0.43e-3) < 0.1e-3).all() and shrinking.std(axis=1).max() < 0.05e-3
    clicks = {str(n): {c.name: there.xy_px[-1, n, k] for k, c in enumerate(cameras)} for n in np.flatnonzero(through)}
    back = track_key_points(lambda t: images[t], range(STEPS - 1, -1, -1), clicks, view, Monitor())
    away = np.linalg.norm(back.xy_px[-1, :, 0] - there.xy_px[0, through, 0], axis=1)
    assert np.isfinite(away).mean() > 0.98 and np.nanpercentile(away, 95) < 0.1


@pytest.mark.slow
def test_points_of_a_desk_stay_while_a_hand_passes(shared_takes: Path, tmp_path: Path) -> None:
    """The 2-D mode on one camera: visible points of the desk rest, and points under the hand are lost, not moved along."""
    movie, first, last = shared_takes / "arm_hand_2cam_handpose3d" / "cam0_test.mp4", 110, 126
    video = cv2.VideoCapture(str(movie))
    image = [cv2.cvtColor(video.read()[1], cv2.COLOR_BGR2GRAY) for _ in range(first + 1)][-1]
    desk = np.zeros_like(image)
    desk[350:690, 30:690] = 255
    corners = cv2.goodFeaturesToTrack(image, 30, 0.02, 20, mask=desk)[:, 0]
    points, out = tmp_path / "points.csv", tmp_path / "tracks.csv"
    points.write_text("point,x,y\n" + "".join(f"{n},{x},{y}\n" for n, (x, y) in enumerate(corners)), encoding="utf-8")
    command = ["track2d", str(movie), "--points", str(points), "--out", str(out), "--frames", f"{first}:{last}", "--quiet"]
    assert main([*command, "--set", "matching.patch_px=21"]) == 0
    xy = read_planar(out).xy_px
    seen, off = np.isfinite(xy).all(axis=2), np.linalg.norm(xy - corners, axis=2)
    assert seen[0].all() and seen.mean() > 0.6 and (seen[:-1] & ~seen[1:]).sum() >= 3
    assert np.median(off[seen]) < 0.1 and (off[seen] > 1).mean() < 0.03
