"""Which places of which limbs are near which other parts of the body, and are to stay outside of them (observations.apart)."""

import numpy as np

from ..body.skeleton import Skeleton
from .observations import Apart
from .state import BodyState

FRACTIONS = (0.65, 1.0)  # of a limb's bone: nearer its head it grows out of the others
SOFT = 0.8  # flesh gives way: of the limb's radius
SIGMA_M = 0.01
NEAR_M = 0.03


class LimbsApart:
    """The pairs of bones of one skeleton whose parts neither meet at a joint nor have a part between them that meets both."""

    def __init__(self, skeleton: Skeleton, bone_index: np.ndarray) -> None:
        fleshy = np.unique(bone_index)
        limbs = [int(b) for b in fleshy if len(skeleton.bones[b].dofs) and skeleton.bones[b].name.endswith((".L", ".R"))]
        meet = skeleton.neighbours.astype(int) @ skeleton.neighbours > 0  # with a part that meets the other's
        pairs = [(b, int(c)) for b in limbs for c in fleshy if not meet[b, c]]
        self._limb, self._other = (np.array(column, dtype=np.intp) for column in (zip(*pairs) if pairs else ((), ())))

    def observe(self, state: BodyState) -> list[Apart]:
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
        found = Apart(
            bone=bone[near], fraction=fraction[near], other=other[near], radius_m=SOFT * radius[bone[near]].min(axis=1), sigma_m=SIGMA_M
        )
        return [found.scaled(state)]


def _radii(state: BodyState) -> np.ndarray:
    """Smallest and largest visible radius (B, 2) of every bone, 0 where it has no balls."""
    radii = np.zeros((len(state.lengths_m), 2))
    for b, profile in state.profiles.items():
        radii[b] = profile.radii_m.min(), profile.radii_m.max()
    return radii
