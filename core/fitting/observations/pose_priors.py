"""Gaussian priors of parameters:

    (θ − mean) / σ = ε                                                                                    (1)

For the prediction 2θ_i − θ_{i−1}, for DOFs that observations hardly constrain (twist), and for radii (in logarithms, so that σ is
relative).

Joint limits as soft one-sided observations:

max(0, θ − θ_max) / σ = ε ,    min(0, θ − θ_min) / σ = ε ,    σ about 2°                              (1)
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..state import Block, BodyState, FromBlocks, shape_vector


@dataclass(frozen=True, eq=False, kw_only=True)
class PosePrior(FromBlocks):
    """Mean and sigma of every DOF (D,), rad or metres; with an infinite sigma there is no prior.  (1)"""

    mean: np.ndarray
    sigma: np.ndarray
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(D,)"""
        return (state.motion - self.mean) / self.sigma

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Diagonal, with respect to the pose."""
        every = np.arange(state.layout.n_pose)
        yield every, every, np.diag(1 / np.broadcast_to(self.sigma, state.motion.shape))

    @property
    def size(self) -> int:
        """D."""
        return len(self.mean)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapePrior:
    """Mean and sigma of the shape vector (S,), logarithms of lengths and cross radii; with an infinite sigma there is no prior.  (1)"""

    mean: np.ndarray
    sigma: np.ndarray
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(S,)"""
        return (shape_vector(state) - self.mean) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(S, D + S); zeros (S, D) without shape"""
        J = state.layout.empty_jacobian(state.layout.n_shape, shape)
        if shape:
            J[:, state.layout.columns("shape")] = np.diag(1 / self.sigma)
        return J


@dataclass(frozen=True, eq=False, kw_only=True)
class JointLimits(FromBlocks):
    """Lowest and highest value of every DOF (D,); infinite: free.  (1)"""

    low: np.ndarray
    high: np.ndarray
    sigma: float
    kind: str = ""
    variance_inflation: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(D,)"""
        return (np.maximum(state.motion - self.high, 0.0) + np.minimum(state.motion - self.low, 0.0)) / self.sigma

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Diagonal, for the DOFs beyond a limit."""
        beyond = np.flatnonzero((state.motion > self.high) | (state.motion < self.low))
        yield beyond, beyond, np.eye(len(beyond)) / self.sigma

    @property
    def size(self) -> int:
        """D."""
        return len(self.low)
