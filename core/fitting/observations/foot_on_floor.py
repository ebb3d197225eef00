"""A standing foot neither sinks into the floor nor hovers: the height of its joints above the floor = a given height ± σ (optional)."""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class FootOnFloor:
    """K joints at known heights above a plane. `up` is the plane's unit normal, `floor_m` its height along `up`."""

    joint: np.ndarray  # (K,) index in Skeleton.joint_names
    height_m: np.ndarray  # (K,) of the joint's centre above the floor when the foot stands
    floor_m: float
    sigma_m: float
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    kind: str = ""
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(K,)"""
        X = state.joint_jacobian[0][self.joint]
        return (X @ np.array(self.up) - self.floor_m - self.height_m) / self.sigma_m

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(K, D + S) or (K, D)"""
        J = np.einsum("i,kic->kc", np.array(self.up), state.joint_jacobian[1][self.joint]) / self.sigma_m
        return J if shape else J[:, : state.n_motion]
