"""Jacobians in blocks: an observation of one body part knows few of the parameters; the zeros are not stored and not multiplied."""

from collections.abc import Iterator

import numpy as np

from ..state import BodyState

Block = tuple[np.ndarray, np.ndarray, np.ndarray]  # rows (n,), columns (c,) of D + S, values (n, c)


class FromBlocks:
    """An observation that gives its Jacobian in blocks; every row is in one block only."""

    __slots__ = ()

    @property
    def size(self) -> int:
        """Number of residuals."""
        raise NotImplementedError

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """The blocks of the derivative to motion and shape, or to motion."""
        raise NotImplementedError

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """The whole derivative (n, D + S), or (n, D) without shape."""
        J = np.zeros((self.size, state.n_motion + (state.n_shape if shape else 0)))
        for rows, columns, block in self.blocks(state, shape):
            J[rows[:, None], columns] = block
        return J
