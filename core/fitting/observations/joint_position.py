"""Joints whose position in space is known to some accuracy: joint = X + ε. NaN rows count for nothing."""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class JointPositions:
    """Positions of all J joints (NaN: unknown) with one sigma, or one for each."""

    xyz_m: np.ndarray  # (J, 3) in the order of Skeleton.joint_names
    sigma_m: float | np.ndarray
    robust: bool = False
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(3J,)"""
        return self._per_sigma(state.joint_jacobian[0] - self.xyz_m).ravel()

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(3J, D + S) or (3J, D)"""
        dX = state.joint_jacobian[1][..., : None if shape else state.n_motion]
        known = np.isfinite(self.xyz_m).all(axis=1)[:, None, None]
        return np.where(known, dX / np.reshape(self.sigma_m, (-1, 1, 1)), 0.0).reshape(-1, dX.shape[2])

    def _per_sigma(self, difference: np.ndarray) -> np.ndarray:
        known = np.isfinite(self.xyz_m).all(axis=1)[:, None]
        return np.where(known, difference / np.reshape(self.sigma_m, (-1, 1)), 0.0)
