"""What all readers of other tools' files need: text that is there, numbers that are numbers, and one sentence when they are not."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...geometry.camera import Camera

LARGEST_FILE, LARGEST_PX = 50_000_000, 100_000
NO_UNIT = "the file has no unit, so its lengths were taken as metres"


def text_of(path: Path) -> str:
    """The text of a file.

    Raises:
        InputError: it is missing, too large, or no text.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"Cannot read the calibration {path}: {error.strerror or error}.") from error
    if len(data) > LARGEST_FILE or b"\0" in data[:4096]:
        raise InputError(f"{path} is no calibration file (it is {'too large' if len(data) > LARGEST_FILE else 'not text'}).")
    return data.decode("utf-8", errors="replace")


def numbers(values: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Finite numbers of a shape; a -1 in the shape stands for any length.

    Raises:
        InputError: they are not.
    """
    try:
        array = np.array(values, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} must be {'×'.join('n' if s < 0 else str(s) for s in shape)} numbers; the file is damaged.") from error
    if not np.isfinite(array).all():
        raise InputError(f"{what} holds numbers that are not finite; the file is damaged.")
    return array


def five(values: Sequence[float] | np.ndarray, what: str) -> np.ndarray:
    """Distortions k1 k2 p1 p2 k3 from four or more in OpenCV's order.

    Raises:
        InputError: there are higher terms, which this camera model does not have.
    """
    given = numbers(values, (-1,), what)
    if np.any(given[5:]):
        raise InputError(f"{what} has more than k1, k2, p1, p2, k3; calibrate again without the rational or prism model.")
    distortions = np.zeros(5)
    distortions[: min(5, len(given))] = given[:5]
    return distortions


def make_camera(
    name: str,
    size_px: Sequence[float],
    matrix: np.ndarray,
    distortions: np.ndarray,
    R_cam_world: np.ndarray,
    t_cam_world_m: np.ndarray,
    affinity: np.ndarray | None = None,
) -> Camera:
    """A camera, checked.

    Raises:
        InputError: it is impossible: no focal length, no size, a matrix that does not turn.
    """
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or not 8 <= min(size_px) <= max(size_px) <= LARGEST_PX:
        raise InputError(f"Camera “{name}” has an impossible matrix or size; the file is damaged.")
    if np.abs(R_cam_world @ R_cam_world.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R_cam_world) < 0:
        raise InputError(f"The rotation of camera “{name}” is none; the file is damaged or mirrored.")
    return Camera(
        name=name,
        size_px=(round(size_px[0]), round(size_px[1])),
        matrix=matrix,
        distortions=distortions,
        affinity=np.zeros(2) if affinity is None else affinity,
        R_cam_world=R_cam_world,
        t_cam_world_m=t_cam_world_m,
    )
