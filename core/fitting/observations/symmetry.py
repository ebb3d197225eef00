"""Both sides of a body are alike: the logarithms of a length or radius on the left and on the right differ by 0 ± sigma.

People's bones do by 1 to 2 % at most (Auerbach & Ruff 2006, J. Hum. Evol. 50: 203-218), their flesh by more.
"""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState, shape_vector


@dataclass(frozen=True, eq=False, kw_only=True)
class Symmetry:
    """K pairs of shape parameters."""

    left: np.ndarray  # (K,) indices in the shape vector
    right: np.ndarray  # (K,)
    sigma: np.ndarray  # (K,)
    kind: str = ""
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(K,)"""
        value = shape_vector(state)
        return (value[self.left] - value[self.right]) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(K, D + S); zeros (K, D) without shape"""
        J = np.zeros((len(self.left), state.n_motion + (state.n_shape if shape else 0)))
        if shape:
            rows = np.arange(len(self.left))
            J[rows, state.n_motion + self.left], J[rows, state.n_motion + self.right] = 1 / self.sigma, -1 / self.sigma
        return J
