"""Tracked points stay where they are in their limb from one frame to the next: p(t+1) − p(t) = ε with p = Rᵀ(X − head) in the bone's axes.

They show what a surface of revolution cannot: twist, and sliding along the bone; and, over time, where the joints are, because a joint
is the point that moves with both its limbs. Differences of successive frames leave no nuisance unknowns and keep the normal equations in
their band; as long as the same points are seen the errors telescope, so little is lost against places common to all frames. The sigma
is 1–10 mm (skin slides).
"""

from dataclasses import dataclass

import numpy as np

from ..state import BodyState


@dataclass(frozen=True, eq=False, kw_only=True)
class MaterialSteps:
    """N points seen in two frames, a and b."""

    from_m: np.ndarray  # (N, 3) world, in frame a
    to_m: np.ndarray  # (N, 3) world, in frame b
    bone: np.ndarray  # (N,)
    sigma_m: np.ndarray  # (N,) of one coordinate of the difference
    crowding: np.ndarray | float = 1.0  # (3N,) as in SurfacePoints

    def residual(self, a: BodyState, b: BodyState) -> np.ndarray:
        """(3N,)"""
        difference = _local(b, self.bone, self.to_m) - _local(a, self.bone, self.from_m)
        return (difference / self.sigma_m[:, None]).ravel()

    def jacobian(self, a: BodyState, b: BodyState) -> np.ndarray:
        """(3N, D + D + S): derivatives to the motion of frame a, of frame b, and to the shape that both share."""
        D = a.n_motion
        at_a, at_b = -_derivative(a, self.bone, self.from_m), _derivative(b, self.bone, self.to_m)
        J = np.concatenate([at_a[..., :D], at_b[..., :D], at_a[..., D:] + at_b[..., D:]], axis=2)
        return (J / self.sigma_m[:, None, None]).reshape(3 * len(self.bone), -1)


@dataclass(frozen=True, eq=False, kw_only=True)
class StepsFromFixed:
    """The same observations for one body `b`, while the other frame's body is held."""

    steps: MaterialSteps
    other: BodyState
    backwards: bool = False  # the held body is frame b, the observed one frame a
    robust: bool = True

    @property
    def crowding(self) -> np.ndarray | float:
        """As in the steps."""
        return self.steps.crowding

    def residual(self, state: BodyState) -> np.ndarray:
        """(3N,)"""
        return self.steps.residual(state, self.other) if self.backwards else self.steps.residual(self.other, state)

    def jacobian(self, state: BodyState, shape: bool = True) -> np.ndarray:
        """(3N, D); with shape (3N, D + S), where both bodies have it."""
        a, b = (state, self.other) if self.backwards else (self.other, state)
        D, J = state.n_motion, self.steps.jacobian(a, b)
        motion = J[:, :D] if self.backwards else J[:, D : 2 * D]
        return np.concatenate([motion, J[:, 2 * D :]], axis=1) if shape else motion


def _local(state: BodyState, bone: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    return np.einsum("nij,ni->nj", state.R[bone], xyz_m - state.head_m[bone])


def _derivative(state: BodyState, bone: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    """Of the local points, to motion and shape (N, 3, D + S)."""
    sk, n = state.skeleton, len(state.lengths_m)
    moves = np.zeros((len(bone), state.n_motion + state.n_shape, 3))
    turns = np.cross(state.axes, xyz_m[:, None] - state.head_m[sk.dof_bone])
    turns[:, : len(sk.base_dofs)] = np.eye(3)
    moves[:, : state.n_motion] = np.where(sk.moved_by[bone][..., None], turns, 0.0)
    moves[:, state.n_motion : state.n_motion + n] = sk.offset_by[bone][..., None] * (state.lengths_m[:, None] * state.R[:, :, 1])
    return -np.einsum("nij,nki->njk", state.R[bone], moves)
