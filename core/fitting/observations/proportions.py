"""What is believed of the bone lengths together, as a person's proportions: ln L ~ N(mean, covariance).  (`bone_lengths`)"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class Proportions:
    """Mean (B,) and covariance (B, B) of the logarithms of the bone lengths [m]."""

    mean: np.ndarray
    covariance: np.ndarray
    kind: str = ""
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(B,) W (ln L − mean), with WᵀW the inverse of the covariance."""
        return np.asarray(self._root @ (np.log(state.lengths_m) - self.mean))

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(B, D + S); zeros (B, D) without shape"""
        b = len(self.mean)
        J = np.zeros((b, state.n_motion + (state.n_shape if shape else 0)))
        if shape:
            J[:, state.n_motion : state.n_motion + b] = self._root
        return J

    @cached_property
    def _root(self) -> np.ndarray:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)))
