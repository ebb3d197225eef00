"""Tracked points stay where they are in their limb from one frame to the next: p(t+1) − p(t) = ε with p = Rᵀ(X − head) in the bone's axes.

They show what a surface of revolution cannot: twist, and sliding along the bone; and, over time, where the joints are, because a joint
is the point that moves with both its limbs. Differences of successive frames leave no nuisance unknowns and keep the normal equations in
their band; as long as the same points are seen the errors telescope, so little is lost against places common to all frames. The sigma
is 1–10 mm (skin slides).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..part_field import cross
from ..state import Block, BodyState, FromBlocks


@dataclass(frozen=True, eq=False, kw_only=True)
class MaterialSteps:
    """N points seen in two frames, a and b."""

    from_m: np.ndarray  # (N, 3) world, in frame a
    to_m: np.ndarray  # (N, 3) world, in frame b
    bone: np.ndarray  # (N,)
    sigma_m: np.ndarray  # (N,) of one coordinate of the difference
    variance_inflation: np.ndarray | float = 1.0  # (3N,) as in SurfacePoints

    def residual(self, a: BodyState, b: BodyState) -> np.ndarray:
        """(3N,)"""
        difference = _local(b, self.bone, self.to_m) - _local(a, self.bone, self.from_m)
        return (difference / self.sigma_m[:, None]).ravel()

    def blocks(self, a: BodyState, b: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, limb by limb, to the motion of frame a, of frame b, and (columns from 2 D on) to the shape that both share."""
        D = a.n_motion
        for limb in np.unique(self.bone).tolist():
            own = np.flatnonzero(self.bone == limb)
            dofs, lengths = a.parts[limb].chain
            at_a, at_b = -_derivative(a, limb, self.from_m[own]), _derivative(b, limb, self.to_m[own])
            d = len(dofs)
            parts = [at_a[..., :d], at_b[..., :d], *([at_a[..., d:] + at_b[..., d:]] if shape else [])]
            J = np.concatenate(parts, axis=2) / self.sigma_m[own, None, None]
            columns = np.concatenate([dofs, D + dofs, *([2 * D + lengths] if shape else [])])
            yield (3 * own[:, None] + np.arange(3)).ravel(), columns, J.reshape(3 * len(own), -1)

    def jacobian(self, a: BodyState, b: BodyState) -> np.ndarray:
        """(3N, D + D + S): derivatives to the motion of frame a, of frame b, and to the shape that both share."""
        J = np.zeros((3 * len(self.bone), 2 * a.n_motion + a.n_shape))
        for rows, columns, block in self.blocks(a, b):
            J[rows[:, None], columns] = block
        return J


@dataclass(frozen=True, eq=False, kw_only=True)
class StepsFromFixed(FromBlocks):
    """The same observations for one body `b`, while the other frame's body is held."""

    steps: MaterialSteps
    other: BodyState
    backwards: bool = False  # the held body is frame b, the observed one frame a
    kind: str = "steps"

    @property
    def variance_inflation(self) -> np.ndarray | float:
        """As in the steps."""
        return self.steps.variance_inflation

    @property
    def size(self) -> int:
        """3N."""
        return 3 * len(self.steps.bone)

    def residual(self, state: BodyState) -> np.ndarray:
        """(3N,)"""
        return self.steps.residual(state, self.other) if self.backwards else self.steps.residual(self.other, state)

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, limb by limb; to the shape, which both bodies have."""
        D, first = state.n_motion, 0 if self.backwards else state.n_motion
        for rows, columns, J in self.steps.blocks(*((state, self.other) if self.backwards else (self.other, state)), shape):
            mine = ((columns >= first) & (columns < first + D)) | (columns >= 2 * D)
            own = columns[mine]
            yield rows, np.where(own < 2 * D, own - first, own - D), J[:, mine]


def _local(state: BodyState, bone: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    return np.einsum("nij,ni->nj", state.R[bone], xyz_m - state.head_m[bone])


def _derivative(state: BodyState, bone: int, xyz_m: np.ndarray) -> np.ndarray:
    """Of the local points of one bone, to the DOFs and lengths of its chain (N, 3, d + l)."""
    sk = state.skeleton
    dofs, lengths = state.parts[bone].chain
    turns = cross(state.axes[dofs], xyz_m[:, None] - state.head_m[sk.dof_bone[dofs]])
    turns[:, : len(sk.base_dofs)] = np.eye(3)
    stretch = state.lengths_m[lengths, None] * state.R[lengths, :, 1]
    moves = np.concatenate([turns, np.broadcast_to(stretch, (len(xyz_m), *stretch.shape))], axis=1)
    return -(moves @ state.R[bone]).transpose(0, 2, 1)
