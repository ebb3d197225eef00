"""Footage as it is: views of other exposure, gain and white balance than their neighbours are measured as well as like ones."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.geometry.rotation import rotation_from_vector

COARSE = {"growing": {"spacing_px": 10}}


def darker(grey: np.ndarray) -> np.ndarray:
    return 0.55 * grey + 12


def steeper(grey: np.ndarray) -> np.ndarray:
    return 255 * (grey / 255) ** 0.7


def warm(grey: np.ndarray) -> np.ndarray:
    """Blue, green and red of a lamp's light."""
    return np.stack([0.6 * grey, 0.9 * grey, 1.1 * grey + 5], axis=2)


def changed(take: Path, view: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    for path in sorted((take / view).iterdir()):
        grey = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE).astype(float)
        path.write_bytes(cv2.imencode(".png", np.clip(np.rint(change(grey)), 0, 255).astype(np.uint8))[1].tobytes())


def figures(scenes: Any, take: Path, out: Path) -> tuple[int, float, int]:
    """Points of the second frame, the median of their distances [m] from the plane, and points tracked into it."""
    plane = scenes.Body(half_m=(0.26, 0.2), R=rotation_from_vector(np.array([0.1, 0.25, 0.0])))
    body = plane.moved(rotation_from_vector(np.array([0.0, 0.0, 0.026])), [0.007, -0.003, 0.0])
    measured = scenes.measure(take, out, COARSE)
    tracked = scenes.track(take, out, measured, COARSE)
    cloud = measured[1].cloud
    return len(cloud.xyz_m), float(np.median(np.abs(body.distance_m(cloud.xyz_m)))), int(np.isfinite(tracked[1].xyz_m[:, 0]).sum())


@pytest.fixture(scope="module")
def two_frames(plane_take: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    take = Path(shutil.copytree(plane_take, tmp_path_factory.mktemp("unlike") / "take"))
    for view in "LCR":
        for number in (2, 3):
            (take / view / f"{number:04d}.png").unlink()
    return take


def test_exposure_and_white_balance_may_differ(two_frames: Path, tmp_path: Path, scenes: Any) -> None:
    """One view at half the light, one with another tone curve, one in warm colour: as many points, as near to the plane."""
    alike = figures(scenes, two_frames, tmp_path / "alike")
    take = Path(shutil.copytree(two_frames, tmp_path / "take"))
    for view, change in (("L", darker), ("C", steeper), ("R", warm)):
        changed(take, view, change)
    points, distance_m, tracked = figures(scenes, take, tmp_path / "unlike")
    assert points > 0.97 * alike[0] and distance_m < 1.25 * alike[1] and tracked > 0.95 * alike[2]
