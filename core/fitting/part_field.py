"""The field of one body part at world points, and its derivatives to the whole state (the chain rule of every surface observation).

A bone j whose balls give the gradient g_j at X moves under DOF k with the velocity a_k × (X − o_k); X stays where it was measured, so
    ∂F/∂θ_k = −Σ_j g_j · (a_k × (X − o_k))    over the bones j that k turns                              (1)
    ∂F/∂ln L_a = −L_a y_a · Σ_j g_j           over the bones j that L_a shifts, and, in bone a's own axes,
               + Σ_{i ∈ a} (∂F_i/∂ln l_y − ∇_local F_i · c_i)                                            (2)
    ∂F/∂ln l = 4 q² w exp(−2d)                                                                           (3)
"""

from dataclasses import dataclass

import numpy as np

from ..body.metaballs import Metaballs, ball_terms
from .state import CROSS, BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """The balls that make the surface of one bone's part: its own, its parent's and its children's."""

    balls: Metaballs
    columns: np.ndarray  # (m,) their places among all balls

    @staticmethod
    def of(state: BodyState, bone: int) -> "Part":
        """The part of a bone (index)."""
        b = state.balls
        columns = np.flatnonzero(state.skeleton.neighbours[bone, b.bone_index])
        return Part(columns=columns, balls=Metaballs(bone_index=b.bone_index[columns], centre=b.centre[columns],
                                                     radii_m=b.radii_m[columns], weight=b.weight[columns]))

    def field(self, state: BodyState, xyz_m: np.ndarray) -> np.ndarray:
        """F (N,) at world points (N, 3)."""
        return self._terms(state, xyz_m)[1].sum(axis=1)

    def gradient(self, state: BodyState, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F (N,) and its gradient in space (N, 3)."""
        q, terms = self._terms(state, xyz_m)
        return terms.sum(axis=1), sum(self._bone_gradients(state, q, terms)[1])  # type: ignore[return-value]

    def shares(self, state: BodyState, xyz_m: np.ndarray) -> np.ndarray:
        """Which part (N, m) of F at each point comes from which of the balls."""
        terms = self._terms(state, xyz_m)[1]
        return terms / np.maximum(terms.sum(axis=1, keepdims=True), 1e-300)

    def jacobian(self, state: BodyState, xyz_m: np.ndarray, shape: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """F (N,) and its derivative (N, D + S) to motion and shape, or (N, D) to motion."""
        q, terms = self._terms(state, xyz_m)
        bones, gradients = self._bone_gradients(state, q, terms)
        motion = self._to_motion(state, xyz_m, bones, gradients)
        F = terms.sum(axis=1)
        if not shape:
            return F, motion
        out = np.zeros((len(xyz_m), state.n_motion + state.n_shape))
        out[:, : state.n_motion] = motion
        self._to_shape(state, bones, gradients, q, terms, out[:, state.n_motion :])
        return F, out

    def _terms(self, state: BodyState, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bones, which = np.unique(self.balls.bone_index, return_inverse=True)
        local = np.stack([(xyz_m - state.head_m[b]) @ state.R[b] for b in bones], axis=1)
        near = Metaballs(bone_index=which.ravel(), centre=self.balls.centre, radii_m=self.balls.radii_m, weight=self.balls.weight)
        return ball_terms(near, state.lengths_m[bones], local)

    def _bone_gradients(self, state: BodyState, q: np.ndarray, terms: np.ndarray) -> tuple[list[int], list[np.ndarray]]:
        bones = np.unique(self.balls.bone_index).tolist()
        local = (-4 * terms)[..., None] * q / self.balls.radii_m
        return bones, [local[:, self.balls.bone_index == b].sum(axis=1) @ state.R[b].T for b in bones]

    def _to_motion(self, state: BodyState, xyz_m: np.ndarray, bones: list[int], gradients: list[np.ndarray]) -> np.ndarray:
        sk, n = state.skeleton, len(state.skeleton.base_dofs)
        wrench = np.concatenate([part for g in gradients for part in (g, np.cross(xyz_m, g))], axis=1)  # force and moment of each bone
        lever = np.cross(state.axes, state.head_m[sk.dof_bone])  # a_k × o_k
        table = np.zeros((2 * len(bones), 3, state.n_motion))
        for i, b in enumerate(bones):
            moved = sk.moved_by[b]
            table[2 * i] = np.where(moved, lever.T, 0.0)
            table[2 * i + 1] = np.where(moved, -state.axes.T, 0.0)
            table[2 * i, :, :n], table[2 * i + 1, :, :n] = -state.axes[:n].T, 0.0
        return wrench @ table.reshape(-1, state.n_motion)  # (1): −a·((X − o) × g) = −a·(X × g) + (a × o)·g

    def _to_shape(self, state: BodyState, bones: list[int], gradients: list[np.ndarray], q: np.ndarray, terms: np.ndarray,
                  out: np.ndarray) -> None:
        sk, L, n = state.skeleton, state.lengths_m, len(state.lengths_m)
        stretch = L[:, None] * state.R[:, :, 1]
        for b, g in zip(bones, gradients):
            out[:, :n] -= g @ np.where(sk.offset_by[b][:, None], stretch, 0.0).T
        own = 4 * terms * (q[..., 1] ** 2 + np.einsum("nmi,mi->nm", q, self.balls.centres_m(L) / self.balls.radii_m))
        for b in bones:
            out[:, b] += own[:, self.balls.bone_index == b].sum(axis=1)  # (2)
        cross = 4 * terms[..., None] * q[..., CROSS] ** 2  # (3)
        out[:, n + 2 * self.columns[:, None] + np.arange(2)] = cross
