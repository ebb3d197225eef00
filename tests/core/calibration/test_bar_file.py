"""The bar beside its rig: where it was, in whatever world the cameras stand now, and never with other cameras."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.take.bar_file import bar_path, read_bar, write_bar

FRAMES = np.array([0, 3, 4])
ENDS = np.random.default_rng(2).uniform(-1, 1, (3, 2, 3))
ROUNDED_M = 2e-6


def rig() -> Rig:
    """Three cameras that look at the origin from different sides."""
    cameras = []
    for k, name in enumerate("LCR"):
        R = rotation_from_vector(np.array([0.1 * k, 0.4 * (k - 1), 0.05]))
        cameras.append(
            Camera(
                name=name,
                size_px=(640, 480),
                matrix=np.diag([500.0, 500.0, 1.0]),
                distortions=np.zeros(5),
                R_cam_world=R,
                t_cam_world_m=np.array([0.1 * k, 0.0, 3.0]),
            )
        )
    return Rig(cameras=tuple(cameras))


def moved(camera: Camera, R: np.ndarray, shift: np.ndarray) -> Camera:
    """The camera in a world whose points are R X + shift."""
    turned = camera.R_cam_world @ R.T
    return replace(camera, R_cam_world=turned, t_cam_world_m=camera.t_cam_world_m - turned @ shift)


def test_there_and_back_also_in_another_world(tmp_path: Path) -> None:
    path = write_bar(tmp_path / "rig.toml", rig(), FRAMES, ENDS)
    assert path == tmp_path / "rig_bar.csv" == bar_path(tmp_path / "rig.toml")
    frames, ends = read_bar(tmp_path / "rig.toml", rig()) or (None, None)
    assert frames.tolist() == FRAMES.tolist()  # type: ignore[union-attr]
    np.testing.assert_allclose(ends, ENDS, atol=ROUNDED_M)  # type: ignore[arg-type]
    R, shift = rotation_from_vector(np.array([0.3, -1.0, 2.0])), np.array([1.0, 2.0, -0.5])
    other = Rig(cameras=tuple(moved(camera, R, shift) for camera in rig().cameras[1:]))
    found = read_bar(tmp_path / "rig.toml", other)
    assert found is not None
    np.testing.assert_allclose(found[1], ENDS @ R.T + shift, atol=ROUNDED_M)


def test_no_bar_a_damaged_one_and_that_of_other_cameras(tmp_path: Path) -> None:
    assert read_bar(tmp_path / "rig.toml", rig()) is None
    path = write_bar(tmp_path / "rig.toml", rig(), FRAMES, ENDS)
    first, *rest = rig().cameras
    strangers = (Rig(cameras=(replace(first, t_cam_world_m=first.t_cam_world_m + 0.01), *rest)), Rig(cameras=(replace(first, name="X"),)))
    for other in strangers:
        with pytest.raises(InputError, match="of another calibration"):
            read_bar(tmp_path / "rig.toml", other)
    path.write_text(path.read_text()[:200])
    with pytest.raises(InputError):
        read_bar(tmp_path / "rig.toml", rig())
