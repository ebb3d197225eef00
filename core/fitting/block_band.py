"""Normal equations of a sequence: poses in a band over time, bordered by the shape that all frames share.

    | A   B | |x|   |g|      A: block band, D×D blocks, coupled to the next two frames
    | Bᵀ  C | |s| = |h|

Cholesky of the band, Schur complement for the shape, and the blocks of the inverse that covariances need (Takahashi's recursion, 1973).
Cost and memory grow linearly with the number of frames.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(eq=False, kw_only=True, slots=True)
class NormalEquations:
    """T frames of D unknowns, S shared unknowns. `next1[t]` couples frame t+1 (rows) with t, `next2[t]` frame t+2 with t."""

    diagonal: np.ndarray  # (T, D, D)
    next1: np.ndarray  # (T-1, D, D)
    next2: np.ndarray  # (T-2, D, D)
    border: np.ndarray  # (T, D, S)
    corner: np.ndarray  # (S, S)
    g: np.ndarray  # (T, D)
    h: np.ndarray  # (S,)

    @staticmethod
    def empty(frames: int, motion: int, shape: int) -> "NormalEquations":
        """All zeros."""
        D, S = motion, shape
        return NormalEquations(diagonal=np.zeros((frames, D, D)), next1=np.zeros((max(frames - 1, 0), D, D)),
                               next2=np.zeros((max(frames - 2, 0), D, D)), border=np.zeros((frames, D, S)), corner=np.zeros((S, S)),
                               g=np.zeros((frames, D)), h=np.zeros(S))

    def solve(self, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """x (T, D) and s (S,), with the diagonal multiplied by 1 + damping (Marquardt).

        Raises:
            numpy.linalg.LinAlgError: the equations are not positive definite.
        """
        factor = Factor(self, damping)
        rhs = factor.solve(np.concatenate([self.g[..., None], self.border], axis=2))
        free, V = rhs[..., 0], rhs[..., 1:]
        schur = self.corner + damping * np.diag(np.diag(self.corner)) - np.einsum("tds,tdr->sr", self.border, V)
        s = np.linalg.solve(schur, self.h - np.einsum("tds,td->s", self.border, free)) if len(self.h) else np.zeros(0)
        return free - V @ s, s

    def covariance(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Blocks of the inverse: pose (T, D, D), pose with shape (T, D, S), shape (S, S)."""
        factor = Factor(self, 0.0)
        V = factor.solve(self.border)
        shape = np.linalg.inv(self.corner - np.einsum("tds,tdr->sr", self.border, V)) if len(self.h) else self.corner
        mixed = -V @ shape
        return factor.inverse_blocks() - mixed @ V.transpose(0, 2, 1), mixed, shape


class Factor:
    """Cholesky factor of the band: inverses of the diagonal blocks, and the two blocks below each."""

    def __init__(self, equations: NormalEquations, damping: float) -> None:
        e, T = equations, len(equations.diagonal)
        self.inverse, self.below1, self.below2 = np.empty_like(e.diagonal), np.empty_like(e.next1), np.empty_like(e.next2)
        for t in range(T):
            A = e.diagonal[t] + damping * np.diag(np.diag(e.diagonal[t]))
            if t > 0:
                A = A - self.below1[t - 1] @ self.below1[t - 1].T
            if t > 1:
                A = A - self.below2[t - 2] @ self.below2[t - 2].T
            self.inverse[t] = np.linalg.inv(np.linalg.cholesky(A))
            if t + 1 < T:
                coupled = e.next1[t] - (self.below2[t - 1] @ self.below1[t - 1].T if t > 0 else 0.0)
                self.below1[t] = coupled @ self.inverse[t].T
            if t + 2 < T:
                self.below2[t] = e.next2[t] @ self.inverse[t].T

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """A⁻¹ rhs for rhs (T, D, K)."""
        T, y = len(rhs), np.array(rhs, dtype=np.float64)
        for t in range(T):
            if t > 0:
                y[t] -= self.below1[t - 1] @ y[t - 1]
            if t > 1:
                y[t] -= self.below2[t - 2] @ y[t - 2]
            y[t] = self.inverse[t] @ y[t]
        for t in reversed(range(T)):
            if t + 1 < T:
                y[t] -= self.below1[t].T @ y[t + 1]
            if t + 2 < T:
                y[t] -= self.below2[t].T @ y[t + 2]
            y[t] = self.inverse[t].T @ y[t]
        return y

    def inverse_blocks(self) -> np.ndarray:
        """The diagonal blocks (T, D, D) of A⁻¹, from the last frame to the first."""
        T = len(self.inverse)
        Z = np.empty_like(self.inverse)
        Z1 = np.empty_like(self.below1)  # block (t+1, t) of the inverse
        for t in reversed(range(T)):
            up = self.inverse[t].T @ self.inverse[t]
            if t + 1 >= T:
                Z[t] = up
                continue
            low1 = self.below1[t] @ self.inverse[t]
            low2 = self.below2[t] @ self.inverse[t] if t + 2 < T else None
            Z1[t] = -Z[t + 1] @ low1
            Z[t] = up
            if low2 is not None:
                Z1[t] -= Z1[t + 1].T @ low2
                Z[t] = Z[t] + low2.T @ (Z1[t + 1] @ low1 + Z[t + 2] @ low2)
                Z[t] = Z[t] + low1.T @ (Z[t + 1] @ low1 + Z1[t + 1].T @ low2)
            else:
                Z[t] = Z[t] + low1.T @ Z[t + 1] @ low1
        return Z
