"""Parameters believed to lie near a value: (θ − mean) / σ. Used for the prediction 2θ_i − θ_{i−1}, for weak priors about twist, and
for radii (in logarithms, so that σ is relative).

Joint limits as soft one-sided observations: r = max(0, θ − θ_max) / σ and r = max(0, θ_min − θ) / σ, σ about 2°.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..state import Block, BodyState, FromBlocks, shape_vector


@dataclass(frozen=True, eq=False, kw_only=True)
class PosePrior(FromBlocks):
    """Mean and sigma of every DOF (D,), rad or metres; an infinite sigma believes nothing."""

    mean: np.ndarray
    sigma: np.ndarray
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(D,)"""
        return (state.motion - self.mean) / self.sigma

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Diagonal, to the motion."""
        every = np.arange(state.n_motion)
        yield every, every, np.diag(1 / np.broadcast_to(self.sigma, state.motion.shape))

    @property
    def size(self) -> int:
        """D."""
        return len(self.mean)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapePrior:
    """Mean and sigma of the shape vector (S,), logarithms of lengths and cross radii; an infinite sigma believes nothing."""

    mean: np.ndarray
    sigma: np.ndarray
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(S,)"""
        return (shape_vector(state) - self.mean) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(S, D + S); zeros (S, D) without shape"""
        J = np.zeros((state.n_shape, state.n_motion + (state.n_shape if shape else 0)))
        if shape:
            J[:, state.n_motion :] = np.diag(1 / self.sigma)
        return J


@dataclass(frozen=True, eq=False, kw_only=True)
class JointLimits(FromBlocks):
    """Lowest and highest value of every DOF (D,); infinite: free."""

    low: np.ndarray
    high: np.ndarray
    sigma: float
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(D,)"""
        return (np.maximum(state.motion - self.high, 0.0) + np.minimum(state.motion - self.low, 0.0)) / self.sigma

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Diagonal, for the DOFs that are beyond a limit."""
        beyond = np.flatnonzero((state.motion > self.high) | (state.motion < self.low))
        yield beyond, beyond, np.eye(len(beyond)) / self.sigma

    @property
    def size(self) -> int:
        """D."""
        return len(self.low)
