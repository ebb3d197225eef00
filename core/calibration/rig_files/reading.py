"""Parsing shared by the readers of other tools' files: checked text and numbers, with a one-sentence error otherwise.

A camera in another tool's model: the parameters with which that model comes closest to ours over the whole image.

Most files have no shear, some no k3, and OpenPTV distorts about the sensor's middle. The parameters are fitted to rays of a grid of pixels;
a small turn of the camera is free as well, since a shear is half a turn.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...foundation import bounded
from ...foundation.errors import InputError
from ...geometry.camera import LARGEST_SKEW, Camera, is_camera_matrix
from ...geometry.rig import LARGEST_NUMBER
from ...geometry.rotation import rotation_from_vector

LARGEST_PX = 100_000
NAMED = 20  # cameras in a remark
NO_UNIT = "the file has no unit, so its lengths were taken as metres"


def text_of(path: Path) -> str:
    """The text of a file.

    Raises:
        InputError: it is missing, too large, or no text.
    """
    try:
        text = bounded.text_of(path, bounded.CALIBRATION_BYTES, errors="replace")
    except OSError as error:
        raise InputError(f"Cannot read the calibration {path}: {error.strerror or error}.") from error
    if "\0" in text[:4096]:
        raise InputError(f"{path} is no calibration file (it is not text).")
    return text


def left_out(cameras: Sequence[str], why: str) -> tuple[str, ...]:
    """The remark on a rig that names cameras of a file that were left out; none if none was."""
    return (f"Left out, because {why}: {', '.join(cameras[:NAMED])}{' …' if len(cameras) > NAMED else ''}.",) if cameras else ()


def numbers(values: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Finite numbers of a shape; a -1 in the shape stands for any length.

    Raises:
        InputError: they are not.
    """
    try:
        array = np.array(values, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} must be {'×'.join('n' if s < 0 else str(s) for s in shape)} numbers; the file is damaged.") from error
    if not (np.abs(array) <= LARGEST_NUMBER).all():
        raise InputError(f"{what} has numbers that are not finite, or beyond {LARGEST_NUMBER:.0e}; the file is damaged.")
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
    fisheye: bool = False,
) -> Camera:
    """A camera, checked.

    Raises:
        InputError: it is impossible: its focal length, size, skew or rotation is none that a camera has.
    """
    if not is_camera_matrix(matrix) or not 8 <= min(size_px) <= max(size_px) <= LARGEST_PX:
        raise InputError(
            f"Camera “{name}” has an impossible matrix or size: focal lengths must be positive, the last row 0, 0, 1, and the skew at most "
            f"{LARGEST_SKEW:g} of the focal length."
        )
    matrix = np.vstack([np.triu(matrix)[:2], [0.0, 0.0, 1.0]])  # without what was rounded
    if np.abs(R_cam_world @ R_cam_world.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R_cam_world) < 0:
        raise InputError(f"The rotation of camera “{name}” is not a rotation; the file is damaged or mirrored.")
    return Camera(
        name=name,
        size_px=(round(size_px[0]), round(size_px[1])),
        matrix=matrix,
        distortions=distortions,
        affinity=np.zeros(2) if affinity is None else affinity,
        R_cam_world=R_cam_world,
        t_cam_world_m=t_cam_world_m,
        fisheye=fisheye,
    )


GRID = 30

Model = Callable[[np.ndarray, np.ndarray], np.ndarray]  # parameters (q,), points in the camera's frame (M, 3) -> pixels (M, 2)


def grid_of(camera: Camera) -> np.ndarray:
    """Pixels (GRID², 2) over the whole image."""
    w, h = camera.size_px
    x, y = np.meshgrid(np.linspace(0, w - 1, GRID), np.linspace(0, h - 1, GRID))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def fitted(camera: Camera, model: Model, start: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Parameters of `model`, the camera's rotation, and the largest distance left [px]. `scale` are magnitudes of the parameters."""
    from scipy.optimize import least_squares

    xy = grid_of(camera)
    rays = camera.directions(xy)

    def residual(p: np.ndarray) -> np.ndarray:
        turned = rays @ rotation_from_vector(p[:3] * 1e-3).T
        return (model(start + p[3:] * scale, turned) - xy).ravel()

    found = least_squares(residual, np.zeros(3 + len(start)), method="lm", xtol=1e-14, ftol=1e-14)
    left = float(np.linalg.norm(found.fun.reshape(-1, 2), axis=1).max())
    return start + found.x[3:] * scale, rotation_from_vector(found.x[:3] * 1e-3), left


def turned(camera: Camera, turn: np.ndarray) -> Camera:
    """The camera turned about its projection centre."""
    return replace(camera, R_cam_world=turn @ camera.R_cam_world, t_cam_world_m=turn @ camera.t_cam_world_m)


def plain(camera: Camera, k3: bool = True) -> Camera:
    """The camera without affinity (fx and fy take the scale), and without k3 on request; exact where there is no shear and no k3."""
    fx, fy = camera.matrix[0, 0] * (1 + camera.affinity[0]), camera.matrix[1, 1]
    shear = camera.matrix[0, 0] * camera.affinity[1] + camera.matrix[0, 1]
    cx, cy = camera.matrix[:2, 2]
    simple = replace(camera, matrix=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), affinity=np.zeros(2))
    if not shear and (k3 or not camera.distortions[4]):
        return simple

    def with_parameters(p: np.ndarray) -> Camera:
        d = np.append(p[4:], 0.0) if not k3 else p[4:]
        matrix = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])
        return replace(simple, matrix=matrix, distortions=d, R_cam_world=np.eye(3), t_cam_world_m=np.zeros(3))

    if camera.fisheye and not shear:
        return simple
    start = np.array([fx, fy, cx, cy, *camera.distortions[: 5 if k3 else 4]])
    scale = np.array([1.0, 1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-5, 1e-5, 1e-3])[: len(start)]
    p, turn, _ = fitted(camera, lambda p, rays: with_parameters(p).project(rays), start, scale)
    fit = with_parameters(p)
    return turned(replace(simple, matrix=fit.matrix, distortions=fit.distortions), turn)
