"""Limbs do not go through each other or the trunk: a place on a limb's axis keeps the limb's radius away from another part's surface.

    r = max(0, ρ − D(F(X)) / |∇D|) / σ ,    D = √(−½ ln F) − √(½ ln 2)                                     (1)

X lies at a fraction of a bone, F is the field of the other part, |∇D| and the radius ρ are those of the state of `scaled`. What is hidden
behind the trunk is measured by nothing; that it is not inside the trunk is known all the same.

Which places of which limbs are near which other parts of the body, and are to stay outside of them (observations.apart).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...body.skeleton import Skeleton
from ..part_field import PartField
from ..state import Block, BodyState, FromBlocks


@dataclass(frozen=True, eq=False, kw_only=True)
class SelfCollision(FromBlocks):
    """N places on limbs, each beside another bone's part."""

    bone: np.ndarray  # (N,) of the limb
    fraction: np.ndarray  # (N,) of the bone's length
    other: np.ndarray  # (N,) bone of the other part
    radius_m: np.ndarray  # (N,) of the limb there
    sigma_m: float
    slope: np.ndarray | None = None  # (N,) |∇D| at the state of `scaled`, 1/m
    kind: str = ""
    variance_inflation: float = 1.0

    def scaled(self, state: BodyState) -> "SelfCollision":
        """The same places with |∇D| of this state."""
        X, slope = self._places(state), np.empty(len(self.bone))
        for c in np.unique(self.other).tolist():
            rows = np.flatnonzero(self.other == c)
            field = PartField(state.parts[c], state, X[rows])
            steep = np.linalg.norm(field.gradient, axis=1) * np.abs(field.distance[1])
            slope[rows] = np.maximum(steep, 0.3 / state.balls.radii_m[field.part.balls].mean())
        return replace(self, slope=slope)

    @property
    def size(self) -> int:
        """N."""
        return len(self.bone)

    def residual(self, state: BodyState) -> np.ndarray:
        """(N,)"""
        X, missing = self._places(state), np.empty(len(self.bone))
        for c in np.unique(self.other).tolist():
            rows = np.flatnonzero(self.other == c)
            missing[rows] = self.radius_m[rows] - PartField(state.parts[c], state, X[rows]).distance[0] / self._slope[rows]
        return np.maximum(missing, 0.0) / self.sigma_m

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, place by place that is too near; the radii of the limbs are held."""
        near = np.flatnonzero(self.residual(state) > 0)
        X = self._places(state)
        for row in near.tolist():
            part = state.parts[int(self.other[row])]
            field = PartField(part, state, X[row : row + 1])
            own, J = part.columns(shape), field.jacobian(shape)[0]
            dofs, lengths = state.parts[int(self.bone[row])].chain
            moved, stretched = self._derivative(state, row, X[row])
            full = np.zeros(state.n_motion + (state.n_shape if shape else 0))
            full[own] = J
            full[dofs] += field.gradient[0] @ moved
            if shape:
                full[state.n_motion + lengths] += field.gradient[0] @ stretched
                full[state.n_motion + self.bone[row]] += field.gradient[0] @ self._along(state, row)
            columns = np.flatnonzero(full)
            yield np.array([row]), columns, (-field.distance[1][0] / self._slope[row] / self.sigma_m * full[columns])[None]

    @property
    def _slope(self) -> np.ndarray:
        if self.slope is None:
            raise ValueError("limbs apart need `scaled(state)` first")
        return self.slope

    def _places(self, state: BodyState) -> np.ndarray:
        along = self.fraction * state.lengths_m[self.bone]
        return np.asarray(state.head_m[self.bone] + along[:, None] * state.R[self.bone][:, :, 1])

    def _along(self, state: BodyState, row: int) -> np.ndarray:
        b = int(self.bone[row])
        return np.asarray(self.fraction[row] * state.lengths_m[b] * state.R[b][:, 1])

    def _derivative(self, state: BodyState, row: int, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the place to the DOFs (3, d) and to ln of the lengths before it (3, l)."""
        skeleton = state.skeleton
        dofs, lengths = state.parts[int(self.bone[row])].chain
        turns = np.cross(state.axes[dofs], X - state.head_m[skeleton.dof_bone[dofs]])
        turns[: len(skeleton.base_dofs)] = np.eye(3)
        return turns.T, (state.lengths_m[lengths, None] * state.R[lengths, :, 1]).T


FRACTIONS = (0.65, 1.0)  # of a limb's bone: nearer its head it grows out of the others
SOFT = 0.8  # flesh gives way: of the limb's radius
SIGMA_M = 0.01
NEAR_M = 0.03


class CollisionPairs:
    """The pairs of bones of one skeleton whose parts neither meet at a joint nor have a part between them that meets both."""

    def __init__(self, skeleton: Skeleton, bone_index: np.ndarray) -> None:
        fleshy = np.unique(bone_index)
        limbs = [int(b) for b in fleshy if len(skeleton.bones[b].dofs) and skeleton.bones[b].name.endswith((".L", ".R"))]
        meet = skeleton.neighbours.astype(int) @ skeleton.neighbours > 0  # with a part that meets the other's
        pairs = [(b, int(c)) for b in limbs for c in fleshy if not meet[b, c]]
        self._limb, self._other = (np.array(column, dtype=np.intp) for column in (zip(*pairs) if pairs else ((), ())))

    def observe(self, state: BodyState) -> list[SelfCollision]:
        """The places that are near another part in this state."""
        bone, other = np.repeat(self._limb, len(FRACTIONS)), np.repeat(self._other, len(FRACTIONS))
        if not len(bone):
            return []
        fraction = np.tile(FRACTIONS, len(self._limb))
        radius = _radii(state)
        X = state.head_m[bone] + (fraction * state.lengths_m[bone])[:, None] * state.R[bone][:, :, 1]
        w, axis = X - state.head_m[other], state.R[other][:, :, 1]
        along = np.clip(np.einsum("ni,ni->n", w, axis), 0.0, state.lengths_m[other])
        away = np.linalg.norm(w - along[:, None] * axis, axis=1)
        near = np.flatnonzero(away < radius[bone].min(axis=1) + radius[other].max(axis=1) + NEAR_M)
        if not len(near):
            return []
        found = SelfCollision(
            bone=bone[near], fraction=fraction[near], other=other[near], radius_m=SOFT * radius[bone[near]].min(axis=1), sigma_m=SIGMA_M
        )
        return [found.scaled(state)]


def _radii(state: BodyState) -> np.ndarray:
    """Smallest and largest visible radius (B, 2) of every bone, 0 where it has no balls."""
    radii = np.zeros((len(state.lengths_m), 2))
    for b, profile in state.profiles.items():
        radii[b] = profile.radii_m.min(), profile.radii_m.max()
    return radii
