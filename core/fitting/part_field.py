"""The field of one body part at world points, and its derivatives with respect to the state (the chain rule of every surface observation).

The balls of bone j contribute the gradient g_j at X. DOF k moves them at X with the velocity a_k × (X − o_k), while X stays where it was
measured, so
    ∂F/∂θ_k = −Σ_j g_j · (a_k × (X − o_k))    over the bones j that k turns                              (1)
    ∂F/∂ln L_a = −L_a y_a · Σ_j g_j           over the bones j that L_a shifts, and, in bone a's own axes,
               + Σ_{i ∈ a} (∂F_i/∂ln l_y − ∇_local F_i · c_i)                                            (2)
    ∂F/∂ln l = 4 q² w exp(−2d) ,   ∂F/∂ln w = w exp(−2d)                                                 (3)

A part depends on few of the parameters: derivatives are given for its own columns only.
"""

from functools import cached_property

import numpy as np

from ..body.metaballs import VISIBLE
from .state import BodyState, Part

SMALLEST_FIELD = 1e-250  # keeps the logarithm finite far away from the body
SMALLEST_SUM = 1e-300  # keeps the shares finite where the field underflows
LINEAR = 0.03  # −½ ln F below which the root is continued by its tangent: deep inside, its derivative would grow without bound


def distance(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """D = √(−½ ln F) − √(½ ln 2) and dD/dF of field values (N,); inside, where −½ ln F < `LINEAR`, continued by the tangent."""
    F = np.maximum(F, SMALLEST_FIELD)
    u = -0.5 * np.log(F)
    root = np.sqrt(np.maximum(u, LINEAR))
    return root + np.minimum(u - LINEAR, 0.0) / (2 * np.sqrt(LINEAR)) - VISIBLE, -0.25 / (F * root)


class PartField:
    """The field of a part of one body at world points (N, 3), evaluated lazily, each quantity once."""

    def __init__(self, part: Part, state: BodyState, xyz_m: np.ndarray) -> None:
        self.part, self.state, self.xyz_m = part, state, xyz_m
        frames, shifts = state.ball_frames
        m = len(part.balls)
        self._W = frames[part.balls].transpose(1, 2, 0).reshape(3, 3 * m)  # columns: the balls' x axes, then y, then z, in units of 1/l
        self._q = xyz_m @ self._W - shifts[part.balls].T.ravel()  # (N, 3m)
        squares = self._q * self._q
        d = squares[:, :m] + squares[:, m : 2 * m] + squares[:, 2 * m :]
        self.terms = state.balls.weight[part.balls] * np.exp(-2 * d)

    @cached_property
    def F(self) -> np.ndarray:
        """(N,)"""
        return self.terms.sum(axis=1)

    @cached_property
    def distance(self) -> tuple[np.ndarray, np.ndarray]:
        """D (N,) and dD/dF (N,) of the values."""
        return distance(self.F)

    @cached_property
    def gradient(self) -> np.ndarray:
        """(N, 3) in the world's axes."""
        return np.asarray(np.add.reduce(self._bone_gradients, axis=1))

    @cached_property
    def shares(self) -> np.ndarray:
        """(N, m) each ball's share of F."""
        return self.terms / np.maximum(self.F, SMALLEST_SUM)[:, None]

    def jacobian(self, shape: bool) -> np.ndarray:
        """Derivative (N, c) of F with respect to the part's columns."""
        pose = self._pose_jacobian()
        return np.concatenate([pose, self._shape_jacobian()], axis=1) if shape else pose

    @cached_property
    def _bone_gradients(self) -> np.ndarray:
        """(N, k, 3) g_j: the contribution of each of the part's bones to the gradient."""
        (n, m), k = self.terms.shape, len(self.part.bones)
        pulls = (self._q.reshape(n, 3, m) * self.terms[:, None]).reshape(n, 3 * m)
        table = np.zeros((3, m, k, 3))
        table[:, np.arange(m), self.part.bone_of_ball] = -4 * self._W.reshape(3, 3, m).transpose(1, 2, 0)
        return (pulls @ table.reshape(3 * m, 3 * k)).reshape(-1, k, 3)

    def _pose_jacobian(self) -> np.ndarray:
        """(N, d) of (1), for all bones at once: the sum over the bones is a product with a table of the DOFs' screws."""
        part, X, (n, k, _) = self.part, self.xyz_m, self._bone_gradients.shape
        screws = self.state.screws[part.dofs].transpose(2, 1, 0)  # (3, 4, d)
        table = (part.tables[0][:, None, None] * screws).reshape(3 * k, -1)
        terms = (self._bone_gradients.reshape(n, 3 * k) @ table).reshape(n, 4, -1)
        J = terms[:, 0]
        for c in range(3):
            J = J + terms[:, 1 + c] * X[:, c, None]
        return np.asarray(J)

    def _shape_jacobian(self) -> np.ndarray:
        """(N, c − d) of (2) and (3)."""
        state, part = self.state, self.part
        n, m = self.terms.shape
        q = self._q.reshape(n, 3, m)
        stretch = state.lengths_m[part.lengths, None] * state.R[part.lengths, :, 1]
        table = np.einsum("kl,li->kil", part.tables[1], stretch).reshape(-1, len(part.lengths))
        lengths = -self._bone_gradients.reshape(n, -1) @ table
        centres = state.balls.centre[part.balls] * state.lengths_m[state.balls.bone_index[part.balls], None]
        offset = (centres / state.balls.radii_m[part.balls]).T  # (3, m)
        own = 4 * self.terms * (q[:, 1] ** 2 + (q * offset).sum(axis=1))
        for b, balls in part.bones:
            lengths[:, np.searchsorted(part.lengths, b)] += own[:, balls].sum(axis=1)  # (2)
        radii = 4 * self.terms[..., None] * np.stack([q[:, 0] ** 2, q[:, 2] ** 2], axis=2)  # (3)
        weights = self.terms if part.layout.free_weights else self.terms[:, :0]
        return np.concatenate([lengths, radii.reshape(n, -1), weights], axis=1)
