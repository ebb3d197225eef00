"""Observations of joints X: clicked in the views, or located by another system, and those of standing feet.

    (projection(X) − click) / σ = ε ,    σ about 5 px                                                     (1)
    (X − keypoint) / σ = ε ,             each coordinate                                                  (2)
    (up · X − floor − h) / σ = ε                                                                          (3)

(1) is the initialisation of D'Apuzzo et al. 1999, §3.3; keypoints of other systems in images are observed in the same way. (2) is for
keypoints in space. (3) is optional: a standing foot neither sinks into the floor nor hovers, its joints have given heights h above it.
"""

from dataclasses import dataclass

import numpy as np

from ...geometry.camera import Camera
from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class ClickedJoints:
    """K clicks, each of one joint in one camera.  (1)"""

    cameras: tuple[Camera, ...]  # K
    joint: np.ndarray  # (K,) index in Skeleton.joint_names
    xy_px: np.ndarray  # (K, 2) full-frame pixels
    sigma_px: np.ndarray | float  # (K,) or for all
    kind: str = ""
    variance_inflation: np.ndarray | float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(2K,)"""
        X = state.joint_jacobian[0]
        rows = [(camera.project(X[j]) - xy) / s for camera, j, xy, s in zip(self.cameras, self.joint, self.xy_px, self._sigmas)]
        return np.concatenate(rows) if rows else np.zeros(0)

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(2K, D + S) or (2K, D)"""
        X, dX = state.joint_jacobian
        n = state.layout.size(shape)
        rows = [camera.project_with_jacobian(X[j])[1] @ dX[j, :, :n] / s for camera, j, s in zip(self.cameras, self.joint, self._sigmas)]
        return np.concatenate(rows) if rows else np.zeros((0, n))

    @property
    def _sigmas(self) -> np.ndarray:
        return np.broadcast_to(self.sigma_px, (len(self.joint),))


@dataclass(frozen=True, eq=False, kw_only=True)
class Keypoints:
    """K joints located in space by another system (TRC, C3D, CSV).  (2)"""

    joint: np.ndarray  # (K,) index in Skeleton.joint_names
    xyz_m: np.ndarray  # (K, 3)
    sigma_m: np.ndarray  # (K,)
    kind: str = ""
    variance_inflation: np.ndarray | float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(3K,)"""
        return ((state.joint_jacobian[0][self.joint] - self.xyz_m) / self.sigma_m[:, None]).ravel()

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(3K, D + S) or (3K, D)"""
        J = state.joint_jacobian[1][self.joint] / self.sigma_m[:, None, None]
        J = J.reshape(-1, J.shape[2])
        return J[:, : state.layout.size(shape)]


@dataclass(frozen=True, eq=False, kw_only=True)
class FootOnFloor:
    """K joints at given heights above a plane. `up` is the plane's unit normal, `floor_m` its height along `up`.  (3)"""

    joint: np.ndarray  # (K,) index in Skeleton.joint_names
    height_m: np.ndarray  # (K,) of the joint's centre above the floor when the foot stands
    floor_m: float
    sigma_m: float
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(K,)"""
        X = state.joint_jacobian[0][self.joint]
        return (X @ np.array(self.up) - self.floor_m - self.height_m) / self.sigma_m

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(K, D + S) or (K, D)"""
        J = np.einsum("i,kic->kc", np.array(self.up), state.joint_jacobian[1][self.joint]) / self.sigma_m
        return J[:, : state.layout.size(shape)]
