"""Parameters believed to lie near a value: (θ − mean) / σ. Used for the prediction 2θ_i − θ_{i−1}, for weak beliefs about twist, for
bone lengths and radii (in logarithms, so that σ is relative)."""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState, shape_vector


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionPrior:
    """Mean and sigma of every DOF (D,), rad or metres; an infinite sigma believes nothing."""

    mean: np.ndarray
    sigma: np.ndarray
    robust: bool = False
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(D,)"""
        return (state.motion - self.mean) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(D, D + S) or (D, D)"""
        J = np.zeros((state.n_motion, state.n_motion + (state.n_shape if shape else 0)))
        J[:, : state.n_motion] = np.diag(1 / np.broadcast_to(self.sigma, state.motion.shape))
        return J


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapePrior:
    """Mean and sigma of the shape vector (S,): logarithms of lengths and cross radii."""

    mean: np.ndarray
    sigma: np.ndarray
    robust: bool = False
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(S,)"""
        return (shape_vector(state) - self.mean) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(S, D + S); zeros (S, D) without shape"""
        J = np.zeros((state.n_shape, state.n_motion + (state.n_shape if shape else 0)))
        if shape:
            J[:, state.n_motion :] = np.diag(1 / self.sigma)
        return J
