"""Joints clicked in the views: projection(joint) = click + ε, σ about 5 px (SCIENCE: observation 3 of the papers' initialisation)."""

from dataclasses import dataclass

import numpy as np

from ...geometry.camera import Camera
from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class ClickedJoints:
    """K clicks, each of one joint in one camera."""

    cameras: tuple[Camera, ...]  # K
    joint: np.ndarray  # (K,) index in Skeleton.joint_names
    xy_px: np.ndarray  # (K, 2) full-frame pixels
    sigma_px: float
    robust: bool = False
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(2K,)"""
        X = state.joint_jacobian[0]
        rows = [(camera.project(X[j]) - xy) / self.sigma_px for camera, j, xy in zip(self.cameras, self.joint, self.xy_px)]
        return np.concatenate(rows) if rows else np.zeros(0)

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(2K, D + S) or (2K, D)"""
        X, dX = state.joint_jacobian
        n = dX.shape[2] if shape else state.n_motion
        rows = [camera.project_with_jacobian(X[j])[1] @ dX[j, :, :n] / self.sigma_px for camera, j in zip(self.cameras, self.joint)]
        return np.concatenate(rows) if rows else np.zeros((0, n))
