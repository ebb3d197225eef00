"""Derivatives of the camera's equations with respect to its own unknowns: 10 of the interior and 6 of the exterior orientation.

With the camera's equations (1)–(5) of `camera`, fx = fy = f (the difference is the affinity b1), and a small turn ω about the
projection centre followed by a shift δ,

    X_c ← exp([ω]×) X_c + δ                                                    (6)
    ∂X_c/∂ω = −[X_c]× ,   ∂X_c/∂δ = I                                          (7)

The interior unknowns are those of Brown (1971) with affinity and shear, in the order of `INTERIOR`.
"""

import numpy as np

from .camera import Camera
from .rotation import cross_matrix

INTERIOR = ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2")
EXTERIOR = ("turn x", "turn y", "turn z", "shift x", "shift y", "shift z")


def interior_of(camera: Camera) -> np.ndarray:
    """The ten interior unknowns (10,) of a camera, in the order of `INTERIOR`; pixels for f, cx, cy."""
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    k1, k2, p1, p2, k3 = camera.distortions
    b1 = fx * (1 + camera.affinity[0]) / fy - 1
    b2 = (fx * camera.affinity[1] + camera.matrix[0, 1]) / fy
    return np.array([fy, camera.matrix[0, 2], camera.matrix[1, 2], k1, k2, k3, p1, p2, b1, b2])


def camera_of(name: str, size_px: tuple[int, int], interior: np.ndarray, R_cam_world: np.ndarray, t_cam_world_m: np.ndarray) -> Camera:
    """The camera with these interior unknowns (10,) and pose."""
    f, cx, cy, k1, k2, k3, p1, p2, b1, b2 = interior
    return Camera(
        name=name,
        size_px=size_px,
        matrix=np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]]),
        distortions=np.array([k1, k2, p1, p2, k3]),
        affinity=np.array([b1, b2]),
        R_cam_world=R_cam_world,
        t_cam_world_m=t_cam_world_m,
    )


def image_of(interior: np.ndarray, xyz_cam_m: np.ndarray) -> np.ndarray:
    """Pixels (…, M, 2) of points (…, M, 3) in the frames of cameras with interior unknowns (…, 10)."""
    f, cx, cy, k1, k2, k3, p1, p2, b1, b2 = np.moveaxis(interior, -1, 0)[..., None]
    a, b = xyz_cam_m[..., 0] / xyz_cam_m[..., 2], xyz_cam_m[..., 1] / xyz_cam_m[..., 2]
    r2, ab2 = a * a + b * b, 2 * a * b
    L = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    a1 = a * L + p1 * ab2 + p2 * (r2 + 2 * a * a)
    b1_ = b * L + p1 * (r2 + 2 * b * b) + p2 * ab2
    return np.stack([f * ((1 + b1) * a1 + b2 * b1_) + cx, f * b1_ + cy], axis=-1)


def image_with_derivatives(interior: np.ndarray, xyz_cam_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (…, M, 2), their derivatives to the interior unknowns (…, M, 2, 10) and to the points (…, M, 2, 3), analytic.

    `interior` (…, 10), `xyz_cam_m` (…, M, 3) before the cameras (z > 0).
    """
    image, J, G = columns_of_derivatives(interior, np.moveaxis(xyz_cam_m, -1, -2))
    return np.moveaxis(image, -1, -2), np.moveaxis(J, -1, -3).swapaxes(-1, -2), np.moveaxis(G, -1, -3)


def columns_of_derivatives(interior: np.ndarray, xyz_cam_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same with the points last, so that all work runs over them: from (…, 3, M) the pixels (…, 2, M), (…, 10, 2, M), (…, 2, 3, M)."""
    f, cx, cy, k1, k2, k3, p1, p2, b1, b2 = np.moveaxis(interior, -1, 0)[..., None]
    w = 1 / xyz_cam_m[..., 2, :]
    a, b = xyz_cam_m[..., 0, :] * w, xyz_cam_m[..., 1, :] * w
    aa, bb, ab2 = a * a, b * b, 2 * a * b
    r2 = aa + bb
    L = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    a1 = a * L + p1 * ab2 + p2 * (r2 + 2 * aa)
    b1_ = b * L + p1 * (r2 + 2 * bb) + p2 * ab2
    fs, fb = f * (1 + b1), f * b2
    x0 = (1 + b1) * a1 + b2 * b1_
    J = np.zeros((*a.shape[:-1], len(INTERIOR), 2, a.shape[-1]))
    x, y = J[..., 0, :], J[..., 1, :]
    x[..., 0, :], y[..., 0, :] = x0, b1_
    x[..., 1, :] = y[..., 2, :] = 1.0
    x[..., 3, :], y[..., 3, :] = (fs * a + fb * b) * r2, f * b * r2
    for column in (4, 5):
        np.multiply(J[..., column - 1, :, :], r2[..., None, :], out=J[..., column, :, :])
    x[..., 6, :], y[..., 6, :] = fs * ab2 + fb * (r2 + 2 * bb), f * (r2 + 2 * bb)
    x[..., 7, :], y[..., 7, :] = fs * (r2 + 2 * aa) + fb * ab2, f * ab2
    x[..., 8, :], x[..., 9, :] = f * a1, f * b1_
    dL = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    cross = a * b * dL + 2 * p1 * a + 2 * p2 * b
    da_a, db_b = L + aa * dL + 2 * p1 * b + 6 * p2 * a, L + bb * dL + 6 * p1 * b + 2 * p2 * a
    G = np.empty((*a.shape[:-1], 2, 3, a.shape[-1]))
    G[..., 0, 0, :], G[..., 0, 1, :] = (fs * da_a + fb * cross) * w, (fs * cross + fb * db_b) * w
    G[..., 1, 0, :], G[..., 1, 1, :] = f * cross * w, f * db_b * w
    G[..., 2, :] = -(a[..., None, :] * G[..., 0, :] + b[..., None, :] * G[..., 1, :])
    return np.stack([f * x0 + cx, f * b1_ + cy], axis=-2), J, G


def exterior_derivatives(G: np.ndarray, xyz_cam_m: np.ndarray) -> np.ndarray:
    """Derivatives (…, 2, 6) of pixels to turn and shift (6), from those to the point in the camera's frame (…, 2, 3).  (7)"""
    return np.concatenate([-G @ cross_matrix(xyz_cam_m), G], axis=-1)


def columns_of_exterior(G: np.ndarray, xyz_cam_m: np.ndarray) -> np.ndarray:
    """The same with the points last: (…, 6, 2, M) from (…, 2, 3, M) and (…, 3, M)."""
    x, y, z = (xyz_cam_m[..., None, n, :] for n in range(3))
    gx, gy, gz = (G[..., n, :] for n in range(3))
    return np.stack([y * gz - z * gy, z * gx - x * gz, x * gy - y * gx, gx, gy, gz], axis=-3)  # −g [X]× = X × g
