"""Tracked points stay at the same place of their limb from one frame to the next:

    (p(t+1) − p(t)) / σ = ε ,    p = Rᵀ (X − head)    in the bone's axes                                  (1)

They constrain what a surface of revolution cannot: twist, and sliding along the bone; and, over time, the places of the joints, because a
joint is the point that moves with both its limbs. Differences of successive frames introduce no nuisance unknowns and leave the normal
equations in their band. While the same points are tracked the errors telescope, so little is lost against places common to all frames.
The sigma is 1–10 mm (skin slides).

A point that was tracked in one view only has no place in space. It lies where its ray meets the body in one frame; carried along with its
limb, it must be on its ray in the other:

    E (head' + R' Rᵀ (X − head) − q) / σ = ε ,    E (2, 3) across the ray, q on it                          (2)

X moves on its ray as the body does, which changes (2) only in the second order.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...geometry.rotation import cross
from ..state import Block, BodyState, FromBlocks


class Steps(Protocol):
    """Points that were tracked from frame a to frame b."""

    @property
    def size(self) -> int:
        """The number of residuals."""

    @property
    def variance_inflation(self) -> np.ndarray | float:
        """As in SurfacePoints."""

    def residual(self, a: BodyState, b: BodyState) -> np.ndarray:
        """(size,)"""

    def blocks(self, a: BodyState, b: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, limb by limb; the columns are those of two frames (`ParameterLayout`)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MaterialSteps:
    """N points tracked from frame a to frame b.  (1)"""

    from_m: np.ndarray  # (N, 3) world, in frame a
    to_m: np.ndarray  # (N, 3) world, in frame b
    bone: np.ndarray  # (N,)
    sigma_m: np.ndarray  # (N,) of one coordinate of the difference
    variance_inflation: np.ndarray | float = 1.0  # (3N,) as in SurfacePoints

    @property
    def size(self) -> int:
        """3N."""
        return 3 * len(self.bone)

    def residual(self, a: BodyState, b: BodyState) -> np.ndarray:
        """(3N,)"""
        difference = _local(b, self.bone, self.to_m) - _local(a, self.bone, self.from_m)
        return (difference / self.sigma_m[:, None]).ravel()

    def blocks(self, a: BodyState, b: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, limb by limb; the columns are those of two frames (`ParameterLayout`)."""
        for limb in np.unique(self.bone).tolist():
            own = np.flatnonzero(self.bone == limb)
            dofs, lengths = a.parts[limb].chain
            at_a, at_b = -_derivative(a, limb, self.from_m[own]), _derivative(b, limb, self.to_m[own])
            d = len(dofs)
            parts = [at_a[..., :d], at_b[..., :d], *([at_a[..., d:] + at_b[..., d:]] if shape else [])]
            J = np.concatenate(parts, axis=2) / self.sigma_m[own, None, None]
            columns = a.layout.two_frames(dofs, lengths, shape)
            yield (3 * own[:, None] + np.arange(3)).ravel(), columns, J.reshape(3 * len(own), -1)

    def jacobian(self, a: BodyState, b: BodyState) -> np.ndarray:
        """(3N, D + D + S): derivatives with respect to the poses in frames a and b, and to the shape that both share."""
        J = np.zeros((3 * len(self.bone), a.layout.n_pose + a.layout.size()))
        for rows, columns, block in self.blocks(a, b):
            J[rows[:, None], columns] = block
        return J


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageSteps:
    """N points that were tracked in single views from frame a to frame b.  (2)"""

    from_m: np.ndarray  # (N, 3) world, where the rays in frame a meet the body
    ray_m: np.ndarray  # (N, 3) a point of each ray in frame b
    across: np.ndarray  # (N, 2, 3) unit vectors across it
    bone: np.ndarray  # (N,)
    sigma_m: np.ndarray  # (N,) of one coordinate
    variance_inflation: np.ndarray | float = 1.0  # (2N,) as in SurfacePoints

    @property
    def size(self) -> int:
        """2N."""
        return 2 * len(self.bone)

    def residual(self, a: BodyState, b: BodyState) -> np.ndarray:
        """(2N,)"""
        beside = np.einsum("nki,ni->nk", self.across, self._carried(a, b) - self.ray_m)
        return (beside / self.sigma_m[:, None]).ravel()

    def blocks(self, a: BodyState, b: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, limb by limb; the columns are those of two frames (`ParameterLayout`)."""
        carried = self._carried(a, b)
        for limb in np.unique(self.bone).tolist():
            own = np.flatnonzero(self.bone == limb)
            dofs, lengths = a.parts[limb].chain
            across = self.across[own] / self.sigma_m[own, None, None]
            at_a = across @ b.R[limb] @ _derivative(a, limb, self.from_m[own])
            at_b = across @ _moves(b, limb, carried[own]).transpose(0, 2, 1)
            d = len(dofs)
            J = np.concatenate([at_a[..., :d], at_b[..., :d], *([at_a[..., d:] + at_b[..., d:]] if shape else [])], axis=2)
            yield (2 * own[:, None] + np.arange(2)).ravel(), a.layout.two_frames(dofs, lengths, shape), J.reshape(2 * len(own), -1)

    def _carried(self, a: BodyState, b: BodyState) -> np.ndarray:
        """Where the points (N, 3) of frame a are in frame b, as parts of their limbs."""
        return np.asarray(b.head_m[self.bone] + np.einsum("nij,nj->ni", b.R[self.bone], _local(a, self.bone, self.from_m)))


@dataclass(frozen=True, eq=False, kw_only=True)
class StepsFromFixed(FromBlocks):
    """The same observations for one body, while the pose of the other frame's is fixed."""

    steps: Steps
    other: BodyState
    backwards: bool = False  # the fixed body is that of frame b, the observed one that of frame a
    kind: str = "steps"

    @property
    def variance_inflation(self) -> np.ndarray | float:
        """That of the steps."""
        return self.steps.variance_inflation

    @property
    def size(self) -> int:
        """That of the steps."""
        return self.steps.size

    def residual(self, state: BodyState) -> np.ndarray:
        """(size,)"""
        return self.steps.residual(state, self.other) if self.backwards else self.steps.residual(self.other, state)

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, limb by limb; the shape moves both bodies."""
        for rows, columns, J in self.steps.blocks(*((state, self.other) if self.backwards else (self.other, state)), shape):
            own, columns = state.layout.one_of_two(columns, second=not self.backwards)
            yield rows, columns, J[:, own]


def _local(state: BodyState, bone: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    return np.einsum("nij,ni->nj", state.R[bone], xyz_m - state.head_m[bone])


def _derivative(state: BodyState, bone: int, xyz_m: np.ndarray) -> np.ndarray:
    """Derivative (N, 3, d + l) of points in one bone's axes with respect to the DOFs and lengths of its chain."""
    return -(_moves(state, bone, xyz_m) @ state.R[bone]).transpose(0, 2, 1)


def _moves(state: BodyState, bone: int, xyz_m: np.ndarray) -> np.ndarray:
    """Derivative (N, d + l, 3) of points that move with one bone with respect to the DOFs and lengths of its chain."""
    sk = state.skeleton
    dofs, lengths = state.parts[bone].chain
    turns = cross(state.axes[dofs], xyz_m[:, None] - state.head_m[sk.dof_bone[dofs]])
    turns[:, : len(sk.base_dofs)] = np.eye(3)
    stretch = state.lengths_m[lengths, None] * state.R[lengths, :, 1]
    return np.concatenate([turns, np.broadcast_to(stretch, (len(xyz_m), *stretch.shape))], axis=1)
