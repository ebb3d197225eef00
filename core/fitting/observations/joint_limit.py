"""Joint limits as soft one-sided observations: r = max(0, θ − θ_max) / σ and r = max(0, θ_min − θ) / σ, σ about 2°."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..state import BodyState
from .blocks import Block, FromBlocks


@dataclass(frozen=True, eq=False, kw_only=True)
class JointLimits(FromBlocks):
    """Lowest and highest value of every DOF (D,); infinite: free."""

    low: np.ndarray
    high: np.ndarray
    sigma: float
    kind: str = ""
    crowding: float = 1.0

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
