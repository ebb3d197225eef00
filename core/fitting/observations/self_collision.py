"""No self-collision: a place on a limb's axis stays the limb's radius away from another part's surface.

    r = max(0, ρ − D(F(X)) / |∇D|) / σ ,    D = √(−½ ln F) − √(½ ln 2)                                     (1)

X lies at a fraction of a bone, F is the field of the other part; |∇D| and the radius ρ are constants, evaluated at a reference state. A
limb that the trunk occludes is measured by nothing; this at least keeps it out of the trunk.

`CollisionPairs` finds the places on limbs that are near other parts of the body.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...body.skeleton import Skeleton
from ..part_field import PartField
from ..state import Block, BodyState, FromBlocks

FRACTIONS = (0.65, 1.0)  # of a limb's bone: nearer its head it joins the others
SOFTNESS = 0.8  # of the limb's radius: flesh is compressed
SIGMA_M = 0.01  # of (1)
NEAR_M = 0.03  # between the surfaces, for an observation
LEAST_SLOPE = 0.3  # of |∇D|, in units of 1 / (mean l of the part): on a limb's axis it vanishes


@dataclass(frozen=True, eq=False, kw_only=True)
class SelfCollision(FromBlocks):
    """N places on limbs, each with the part of another bone to stay out of.  (1)"""

    bone: np.ndarray  # (N,) of the limb
    fraction: np.ndarray  # (N,) of the bone's length
    other: np.ndarray  # (N,) bone of the other part
    radius_m: np.ndarray  # (N,) of the limb there
    sigma_m: float
    slope: np.ndarray  # (N,) |∇D| at the reference state, 1/m
    kind: str = ""
    variance_inflation: float = 1.0

    @staticmethod
    def about(
        reference: BodyState, *, bone: np.ndarray, fraction: np.ndarray, other: np.ndarray, radius_m: np.ndarray, sigma_m: float
    ) -> "SelfCollision":
        """The observations of places, with |∇D| of a reference state."""
        X, slope = _places(reference, bone, fraction), np.empty(len(bone))
        for c in np.unique(other).tolist():
            rows = np.flatnonzero(other == c)
            field = PartField(reference.parts[c], reference, X[rows])
            steep = np.linalg.norm(field.gradient, axis=1) * np.abs(field.distance[1])
            slope[rows] = np.maximum(steep, LEAST_SLOPE / reference.balls.radii_m[field.part.balls].mean())
        return SelfCollision(bone=bone, fraction=fraction, other=other, radius_m=radius_m, sigma_m=sigma_m, slope=slope)

    @property
    def size(self) -> int:
        """N."""
        return len(self.bone)

    def residual(self, state: BodyState) -> np.ndarray:
        """(N,)"""
        X, missing = _places(state, self.bone, self.fraction), np.empty(len(self.bone))
        for c in np.unique(self.other).tolist():
            rows = np.flatnonzero(self.other == c)
            missing[rows] = self.radius_m[rows] - PartField(state.parts[c], state, X[rows]).distance[0] / self.slope[rows]
        return np.maximum(missing, 0.0) / self.sigma_m

    def blocks(self, state: BodyState, shape: bool = True) -> Iterator[Block]:
        """Derivatives, place by place, of those that are too near; the radii of the limbs are constants."""
        near = np.flatnonzero(self.residual(state) > 0)
        X, at = _places(state, self.bone, self.fraction), state.layout
        for row in near.tolist():
            part = state.parts[int(self.other[row])]
            field = PartField(part, state, X[row : row + 1])
            own, J = part.columns(shape), field.jacobian(shape)[0]
            dofs, lengths = state.parts[int(self.bone[row])].chain
            moved, stretched = self._derivative(state, row, X[row])
            full = np.zeros(at.size(shape))
            full[own] = J
            full[dofs] += field.gradient[0] @ moved
            if shape:
                full[at.lengths(lengths)] += field.gradient[0] @ stretched
                full[at.lengths(self.bone[row])] += field.gradient[0] @ self._along(state, row)
            columns = np.flatnonzero(full)
            yield np.array([row]), columns, (-field.distance[1][0] / self.slope[row] / self.sigma_m * full[columns])[None]

    def _along(self, state: BodyState, row: int) -> np.ndarray:
        b = int(self.bone[row])
        return np.asarray(self.fraction[row] * state.lengths_m[b] * state.R[b][:, 1])

    def _derivative(self, state: BodyState, row: int, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the place with respect to the DOFs (3, d) and to ln of the lengths before it (3, l)."""
        skeleton = state.skeleton
        dofs, lengths = state.parts[int(self.bone[row])].chain
        turns = np.cross(state.axes[dofs], X - state.head_m[skeleton.dof_bone[dofs]])
        turns[: len(skeleton.base_dofs)] = np.eye(3)
        return turns.T, (state.lengths_m[lengths, None] * state.R[lengths, :, 1]).T


def _places(state: BodyState, bone: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """X of (1): places (N, 3) at fractions (N,) of bones (N,)."""
    along = fraction * state.lengths_m[bone]
    return np.asarray(state.head_m[bone] + along[:, None] * state.R[bone][:, :, 1])


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
        found = SelfCollision.about(
            state,
            bone=bone[near],
            fraction=fraction[near],
            other=other[near],
            radius_m=SOFTNESS * radius[bone[near]].min(axis=1),
            sigma_m=SIGMA_M,
        )
        return [found]


def _radii(state: BodyState) -> np.ndarray:
    """Smallest and largest visible radius (B, 2) of every bone, 0 where it has no balls."""
    radii = np.zeros((len(state.lengths_m), 2))
    for b, profile in state.profiles.items():
        radii[b] = profile.radii_m.min(), profile.radii_m.max()
    return radii
