"""Where a search view sees what lies on the reference view's rays: equation (2) of `object_space`."""

import numpy as np

from ..geometry.camera import Camera
from ..images.fields import RowGrid


class Epipolar:
    """N rays of the reference view and their images in one search view: (2), with lens distortion linear over a patch."""

    def __init__(self, base: Camera, camera: Camera, rows: RowGrid, xy: np.ndarray) -> None:
        self._camera, self._rows = camera, rows
        frame = rows.to_frame(xy)
        q = base.directions(frame)
        tip = base.directions(frame[:, None] + [[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        Q = np.stack([tip[:, 0] - tip[:, 1], (tip[:, 2] - tip[:, 3]) * rows.step], axis=2)  # ∂q/∂(u, v) (N, 3, 2)
        rotation = camera.R_cam_world @ base.R_cam_world.T
        self._h0, self._H = q @ rotation.T, rotation @ Q
        self.shift = camera.R_cam_world @ base.centre_m + camera.t_cam_world_m  # t_k (3,)

    def centre(self, theta: np.ndarray, rows: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Image (m, 2) of the patch's middle, ∂x/∂w (m, 2), A (m, 2, 2) and the distortion's slope L (m, 2, 2). Rows' pixels."""
        h = self._h0[rows] + theta[:, :1] * self.shift
        X = (h - self._camera.t_cam_world_m) @ self._camera.R_cam_world
        frame, J = self._camera.project_with_jacobian(X)
        J = (J @ self._camera.R_cam_world.T) / np.array([1.0, self._rows.step])[:, None]  # ∂x/∂h
        A = J @ (self._H[rows] + self.shift[:, None] * theta[:, None, 1:3])
        return self._rows.from_frame(frame), J @ self.shift, A, J[:, :, :2] * h[:, 2, None, None]

    def warp(
        self, theta: np.ndarray, monomials: np.ndarray, rows: np.ndarray | slice, at: np.ndarray, slope: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns and rows (m, n) float32 of x(u, v), with middle `at` (m, 2) and distortion's slope `slope` (m, 2, 2).  (2)

        h_k is linear in the monomials, and so is L h_k: one product with the pixels, and a division by the third row.
        """
        h = theta[:, None, :] * self.shift[:, None]  # (m, 3, P)
        h[:, :, 0] += self._h0[rows]
        middle = h[:, :2, 0] / h[:, 2:, 0]
        h[:, :, 1:3] += self._H[rows]
        h[:, :2] = slope @ h[:, :2]
        c = (at - np.einsum("nij,nj->ni", slope, middle)).astype(np.float32)
        x, y, z = np.matmul(h.transpose(1, 0, 2).astype(np.float32), monomials.T)
        x /= z
        x += c[:, :1]
        y /= z
        y += c[:, 1:]
        return x, y
