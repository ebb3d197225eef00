"""Normal equations of a sequence: poses in a band over time, bordered by the shape that all frames share.

    | A   B | |x|   |g|      A: block band, D×D blocks, coupled to the next two frames
    | Bᵀ  C | |s| = |h|

Cholesky of the band, Schur complement for the shape, and the blocks of the inverse for covariances. Cost and memory grow linearly with
the number of frames.
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
        return NormalEquations(
            diagonal=np.zeros((frames, D, D)),
            next1=np.zeros((max(frames - 1, 0), D, D)),
            next2=np.zeros((max(frames - 2, 0), D, D)),
            border=np.zeros((frames, D, S)),
            corner=np.zeros((S, S)),
            g=np.zeros((frames, D)),
            h=np.zeros(S),
        )

    def fix(self, dofs: np.ndarray) -> None:
        """Take some of the D unknowns (K,) out of every frame: they keep their values. Their variance in the inverse is 1."""
        if not len(dofs):
            return
        for blocks in (self.diagonal, self.next1, self.next2):
            blocks[:, dofs, :] = 0.0
            blocks[:, :, dofs] = 0.0
        self.diagonal[:, dofs, dofs] = 1.0
        self.border[:, dofs] = 0.0
        self.g[:, dofs] = 0.0

    def solve(self, damping: float = 0.0, absolute: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """x (T, D) and s (S,), with the diagonal multiplied by 1 + damping (Marquardt), plus an `absolute` damping (T,) (Levenberg).

        Raises:
            numpy.linalg.LinAlgError: the equations are not positive definite.
        """
        factor = Factor(self, damping, absolute)
        rhs = factor.solve(np.concatenate([self.g[..., None], self.border], axis=2))
        free, V = rhs[..., 0], rhs[..., 1:]
        schur = self.corner + damping * np.diag(np.diag(self.corner)) - np.einsum("tds,tdr->sr", self.border, V)
        s = np.linalg.solve(schur, self.h - np.einsum("tds,td->s", self.border, free)) if len(self.h) else np.zeros(0)
        return free - V @ s, s

    def covariance(self, shape: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Blocks of the inverse: pose (T, D, D), pose with shape (T, D, S), shape (S, S).

        With the covariance (S, S) of a `shape` that was estimated elsewhere, the other blocks follow from it.
        """
        V = Factor(self, 0.0).solve(self.border)
        if shape is None:
            shape = np.linalg.inv(self.corner - np.einsum("tds,tdr->sr", self.border, V)) if len(self.h) else self.corner
        mixed = -V @ shape
        return inverse_blocks(self) - mixed @ V.transpose(0, 2, 1), mixed, shape


def reversed_in_time(equations: NormalEquations) -> NormalEquations:
    """The same equations with the last frame first."""
    e = equations
    return NormalEquations(
        diagonal=e.diagonal[::-1],
        next1=e.next1[::-1].transpose(0, 2, 1),
        next2=e.next2[::-1].transpose(0, 2, 1),
        border=e.border[::-1],
        corner=e.corner,
        g=e.g[::-1],
        h=e.h,
    )


def eliminated(equations: NormalEquations, frames: int) -> NormalEquations:
    """The reduced equations after elimination of the first `frames`, at most T − 2 (Schur complement)."""
    e = equations
    A, C, border, g = e.diagonal.copy(), e.next1.copy(), e.border.copy(), e.g.copy()
    corner, h, D = e.corner.copy(), e.h.copy(), e.g.shape[1]
    for t in range(frames):
        below = np.concatenate([C[t], e.next2[t]])  # couples frames t + 1 and t + 2 (rows) with t
        K = np.linalg.solve(A[t], np.concatenate([below.T, border[t], g[t][:, None]], axis=1))
        ahead, shape, free = K[:, : 2 * D], K[:, 2 * D : -1], K[:, -1]
        less = below @ ahead
        A[t + 1] -= less[:D, :D]
        A[t + 2] -= less[D:, D:]
        C[t + 1] -= less[D:, :D]
        border[t + 1 : t + 3] -= (below @ shape).reshape(2, D, -1)
        g[t + 1 : t + 3] -= (below @ free).reshape(2, D)
        corner -= border[t].T @ shape
        h -= border[t].T @ free
    return NormalEquations(
        diagonal=A[frames:], next1=C[frames:], next2=e.next2[frames:], border=border[frames:], corner=corner, g=g[frames:], h=h
    )


class Factor:
    """Cholesky factor of the band: inverses of the diagonal blocks, and the two blocks below each."""

    def __init__(self, equations: NormalEquations, damping: float, absolute: np.ndarray | None = None) -> None:
        e, T = equations, len(equations.diagonal)
        self.inverse, self.below1, self.below2 = np.empty_like(e.diagonal), np.empty_like(e.next1), np.empty_like(e.next2)
        for t in range(T):
            A = e.diagonal[t] + np.diag(damping * np.diag(e.diagonal[t]) + (0.0 if absolute is None else absolute[t]))
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


def inverse_blocks(equations: NormalEquations) -> np.ndarray:
    """The diagonal blocks (T, D, D) of A⁻¹, by elimination from both ends: Z_k = (S_k + U_k − A_k)⁻¹ for block-tridiagonal A.

    S_k is the Schur complement of A_k after elimination of all before it, U_k of all after it. Two frames make one block. (The recursion
    over the factor's columns, Takahashi 1973, needs half the work but loses all digits in long gaps without points.)
    """
    A, C, D = *_pairs(equations), equations.g.shape[1]
    S, U = A.copy(), A.copy()
    for k in range(1, len(A)):
        S[k] -= C[k - 1] @ np.linalg.solve(S[k - 1], C[k - 1].T)
    for k in reversed(range(len(A) - 1)):
        U[k] -= C[k].T @ np.linalg.solve(U[k + 1], C[k])
    Z = np.linalg.inv(S + U - A)
    both = np.stack([Z[:, :D, :D], Z[:, D:, D:]], axis=1).reshape(-1, D, D)[: len(equations.g)]
    return (both + both.transpose(0, 2, 1)) / 2


def _pairs(equations: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
    """The band as blocks of two frames: diagonal (K, 2D, 2D) and the coupling of block k + 1 (rows) with k (K−1, 2D, 2D)."""
    e, (T, D) = equations, equations.g.shape
    K = (T + 1) // 2
    A, C = np.zeros((K, 2 * D, 2 * D)), np.zeros((K - 1, 2 * D, 2 * D))
    A[:, D:, D:] = np.eye(D)  # the partner of an odd last frame
    A[:, :D, :D] = e.diagonal[::2]
    A[: T // 2, D:, D:] = e.diagonal[1::2]
    A[: T // 2, D:, :D] = e.next1[::2]
    A[: T // 2, :D, D:] = e.next1[::2].transpose(0, 2, 1)
    C[:, :D, D:] = e.next1[1::2]
    C[: len(e.next2[::2]), :D, :D] = e.next2[::2]
    C[: len(e.next2[1::2]), D:, D:] = e.next2[1::2]
    return A, C
