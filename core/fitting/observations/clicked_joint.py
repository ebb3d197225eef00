"""Joints clicked in the views, or found in them by another system: projection(joint) = click + ε, σ about 5 px (the papers'
initialisation)."""

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
    sigma_px: np.ndarray | float  # (K,) or for all
    kind: str = ""
    crowding: np.ndarray | float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(2K,)"""
        X = state.joint_jacobian[0]
        rows = [(camera.project(X[j]) - xy) / s for camera, j, xy, s in zip(self.cameras, self.joint, self.xy_px, self._sigmas)]
        return np.concatenate(rows) if rows else np.zeros(0)

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(2K, D + S) or (2K, D)"""
        X, dX = state.joint_jacobian
        n = dX.shape[2] if shape else state.n_motion
        rows = [camera.project_with_jacobian(X[j])[1] @ dX[j, :, :n] / s for camera, j, s in zip(self.cameras, self.joint, self._sigmas)]
        return np.concatenate(rows) if rows else np.zeros((0, n))

    @property
    def _sigmas(self) -> np.ndarray:
        return np.broadcast_to(self.sigma_px, (len(self.joint),))
