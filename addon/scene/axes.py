"""The one place where axes are converted between Tricap, Blender and libmv.

World: Tricap's world is Blender's (metres, right-handed, Z up); nothing is converted.

Camera: OpenCV's camera looks along +z, x right, y down; Blender's looks along −z, x right, y up:

    R_world_cam(Blender) = R_cam_world(OpenCV)ᵀ · diag(1, −1, −1)                                  (1)

Image: Tricap's pixels have the centre of the top-left pixel at (0, 0); Blender's images run over [0, 1] from the outer
edge of the bottom-left pixel, so that

    u = (x + ½) / w ,   v = 1 − (y + ½) / h                                                        (2)

Lens: with the sensor fitted to the width, Blender shifts the picture in units of the width, and the pixel aspect is its
only means to distinguish fx from fy:

    lens = fx · sensor_width / w ,  aspect_y / aspect_x = fx / fy                                  (3)
    shift_x = ½ − u(cx) ,  shift_y = (½ − v(cy)) · (h / w) · (fx / fy)                             (4)

Brown's decentring: libmv, Blender's tracker, exchanges p1 and p2 and has y upwards:

    p1(libmv) = p2(OpenCV) ,  p2(libmv) = −p1(OpenCV)                                              (5)
"""

from dataclasses import dataclass

import numpy as np

from ...core.geometry.camera import Camera
from ...core.geometry.rotation import rotation_from_vector, vector_from_rotation
from .fisheye import nearest_brown

FLIP = np.diag([1.0, -1.0, -1.0])
SENSOR_WIDTH_MM = 36.0


@dataclass(frozen=True, kw_only=True)
class Lens:
    """The lens of a Blender camera that projects like `Camera` without distortion; lengths in millimetres."""

    lens_mm: float
    sensor_width_mm: float
    shift_x: float
    shift_y: float
    pixel_aspect_y: float  # of the scene; x is 1


def camera_to_world(camera: Camera) -> np.ndarray:
    """matrix_world (4, 4) of the Blender camera.  (1)"""
    matrix = np.eye(4)
    R = rotation_from_vector(vector_from_rotation(camera.R_cam_world))  # orthonormal to the last bit
    matrix[:3, :3] = R.T @ FLIP
    matrix[:3, 3] = -R.T @ camera.t_cam_world_m
    return matrix


def camera_from_world(matrix_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_cam_world (3, 3) and t_cam_world_m (3,) of OpenCV's camera from a Blender camera's matrix_world (4, 4)."""
    matrix = np.asarray(matrix_world, dtype=np.float64)
    R_cam_world = FLIP @ (matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)).T
    return R_cam_world, -R_cam_world @ matrix[:3, 3]


def uv_from_pixel(xy_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Blender's image coordinates (…, 2) of pixels (…, 2).  (2)"""
    xy = np.asarray(xy_px, dtype=np.float64)
    w, h = size_px
    return np.stack([(xy[..., 0] + 0.5) / w, 1.0 - (xy[..., 1] + 0.5) / h], axis=-1)


def pixel_from_uv(uv: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Pixels (…, 2) of Blender's image coordinates (…, 2); the inverse of `uv_from_pixel`."""
    uv = np.asarray(uv, dtype=np.float64)
    w, h = size_px
    return np.stack([uv[..., 0] * w - 0.5, (1.0 - uv[..., 1]) * h - 0.5], axis=-1)


def lens(camera: Camera) -> Lens:
    """Focal length, shift and pixel aspect of the ideal camera, sensor fitted horizontally.  (3), (4)"""
    w, h = camera.size_px
    fx, fy = camera.matrix[0, 0] * (1.0 + camera.affinity[0]), camera.matrix[1, 1]
    u, v = uv_from_pixel(camera.matrix[:2, 2], camera.size_px)
    aspect = fx / fy
    return Lens(
        lens_mm=fx * SENSOR_WIDTH_MM / w,
        sensor_width_mm=SENSOR_WIDTH_MM,
        shift_x=0.5 - u,
        shift_y=(0.5 - v) * h / w * aspect,
        pixel_aspect_y=aspect,
    )


def principal_point_bottom_up_px(camera: Camera) -> tuple[float, float]:
    """The principal point in pixels from the outer edge of the bottom-left pixel, as Blender's tracker expects it.  (2)"""
    w, h = camera.size_px
    u, v = uv_from_pixel(camera.matrix[:2, 2], camera.size_px)
    return float(u * w), float(v * h)


def brown_coefficients(camera: Camera) -> dict[str, float]:
    """The coefficients of the tracker's Brown model under its own names; of a fisheye lens, the nearest ones.  (5)"""
    if camera.fisheye:
        nearest = [float(value) for value in nearest_brown(camera)[0]]
        return dict(zip(("brown_k1", "brown_k2", "brown_k3", "brown_k4"), nearest), brown_p1=0.0, brown_p2=0.0)
    k1, k2, p1, p2, k3 = (float(value) for value in camera.distortions)
    return dict(brown_k1=k1, brown_k2=k2, brown_k3=k3, brown_k4=0.0, brown_p1=p2, brown_p2=-p1)
