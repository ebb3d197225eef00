"""Joint limits as soft one-sided observations: r = max(0, θ − θ_max) / σ and r = max(0, θ_min − θ) / σ, σ about 2°."""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class JointLimits:
    """Lowest and highest value of every DOF (D,); infinite: free."""

    low: np.ndarray
    high: np.ndarray
    sigma: float
    robust: bool = False
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(D,)"""
        return (np.maximum(state.motion - self.high, 0.0) + np.minimum(state.motion - self.low, 0.0)) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(D, D + S) or (D, D)"""
        beyond = (state.motion > self.high) | (state.motion < self.low)
        J = np.zeros((state.n_motion, state.n_motion + (state.n_shape if shape else 0)))
        J[:, : state.n_motion] = np.diag(beyond / self.sigma)
        return J
