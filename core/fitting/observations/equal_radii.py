"""Limbs are nearly round: ln l_x − ln l_z = ε for every ball, σ about 10 %. Points seen from one side cannot tell depth from thickness."""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class EqualRadii:
    """One observation for each of the M balls."""

    sigma: float
    robust: bool = False
    crowding: float = 1.0

    def residual(self, state: BodyState) -> np.ndarray:
        """(M,)"""
        return np.log(state.balls.radii_m[:, 0] / state.balls.radii_m[:, 2]) / self.sigma

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(M, D + S); zeros (M, D) without shape"""
        m = len(state.balls.weight)
        J = np.zeros((m, state.n_motion + (state.n_shape if shape else 0)))
        if shape:
            rows, first = np.arange(m), state.n_motion + len(state.lengths_m) + 2 * np.arange(m)
            J[rows, first], J[rows, first + 1] = 1 / self.sigma, -1 / self.sigma
        return J
