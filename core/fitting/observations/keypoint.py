"""Imported keypoints in space: position of a joint = keypoint ± σ, each coordinate. (In images a keypoint is a clicked joint.)"""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class Keypoints:
    """K joints seen in space by another system (TRC, C3D, CSV)."""

    joint: np.ndarray  # (K,) index in Skeleton.joint_names
    xyz_m: np.ndarray  # (K, 3)
    sigma_m: np.ndarray  # (K,)
    kind: str = ""
    crowding: np.ndarray | float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(3K,)"""
        return ((state.joint_jacobian[0][self.joint] - self.xyz_m) / self.sigma_m[:, None]).ravel()

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(3K, D + S) or (3K, D)"""
        J = state.joint_jacobian[1][self.joint] / self.sigma_m[:, None, None]
        J = J.reshape(-1, J.shape[2])
        return J if shape else J[:, : state.n_motion]
