"""Limbs are nearly round, trunks as flat as the model's: ln l_x − ln l_z = ln of the model's ratio + ε for every ball, σ about 10 %.

Points seen from one side cannot tell depth from thickness.
"""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class EqualRadii:
    """One observation for each of the M balls."""

    sigma: float
    log_ratio: np.ndarray | float = 0.0  # (M,) the model's ln l_x − ln l_z
    kind: str = ""
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(M,)"""
        return (np.log(state.balls.radii_m[:, 0] / state.balls.radii_m[:, 2]) - self.log_ratio) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(M, D + S); zeros (M, D) without shape"""
        m = len(state.balls.weight)
        J = np.zeros((m, state.n_motion + (state.n_shape if shape else 0)))
        if shape:
            rows, first = np.arange(m), state.n_motion + len(state.lengths_m) + 2 * np.arange(m)
            J[rows, first], J[rows, first + 1] = 1 / self.sigma, -1 / self.sigma
        return J
