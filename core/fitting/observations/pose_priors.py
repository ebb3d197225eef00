"""Priors of the pose: Gaussian ones, and joint limits as soft one-sided observations.

    (θ − mean) / σ = ε                                                                                    (1)
    max(0, θ − θ_max) / σ = ε ,    min(0, θ − θ_min) / σ = ε ,    σ about 2°                              (2)

(1) is for the prediction 2θ_i − θ_{i−1}, and for DOFs that observations hardly constrain (twist).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..state import Block, BodyState, FromBlocks


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
class JointLimits(FromBlocks):
    """Lowest and highest value of every DOF (D,); infinite: free.  (2)"""

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
