"""Tracked points are fixed in their segment: X(t) = head_b + R_b q + ε, with q known from other frames, σ 3–10 mm (skin slides).

They add what surfaces of revolution cannot show: twist, and sliding along the bone.
"""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class MaterialPoints:
    """N tracked points and their places in the bones' axes."""

    xyz_m: np.ndarray  # (N, 3) world
    bone: np.ndarray  # (N,)
    local: np.ndarray  # (N, 3) bone axes, from the head; y in bone lengths, x and z in metres
    sigma_m: np.ndarray  # (N,)
    robust: bool = True

    def residual(self, state: BodyState) -> np.ndarray:
        """(3N,)"""
        return ((self._model(state) - self.xyz_m) / self.sigma_m[:, None]).ravel()

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(3N, D + S) or (3N, D)"""
        sk, b, X = state.skeleton, self.bone, self._model(state)
        J = np.zeros((len(b), 3, state.n_motion + (state.n_shape if shape else 0)))
        turns = np.cross(state.axes, X[:, None] - state.head_m[sk.dof_bone])
        turns[:, : len(sk.base_dofs)] = np.eye(3)
        J[:, :, : state.n_motion] = np.where(sk.moved_by[b][..., None], turns, 0.0).transpose(0, 2, 1)
        if shape:
            n, L = len(state.lengths_m), state.lengths_m
            share = sk.offset_by[b].astype(float)
            share[np.arange(len(b)), b] = self.local[:, 1]
            J[:, :, state.n_motion : state.n_motion + n] = (share[..., None] * (L[:, None] * state.R[:, :, 1])).transpose(0, 2, 1)
        return (J / self.sigma_m[:, None, None]).reshape(3 * len(b), -1)

    def _model(self, state: BodyState) -> np.ndarray:
        place = self.local * np.stack([np.ones(len(self.bone)), state.lengths_m[self.bone], np.ones(len(self.bone))], axis=1)
        return state.head_m[self.bone] + np.einsum("nij,nj->ni", state.R[self.bone], place)
