"""A hand with its fingers: the metaballs of a hand are flat, end at the knuckles, and do not show where its thumb is.

Tapered capsules in the axes of the hand's bone, as in `body.skin.hand_template`: three along the palm, and for searches one for each finger
and the thumb, for their measured points one for each of their bones.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ..body.skeleton import Skeleton
from ..body.skin.hand_template import BENDS, FINGERS, RELAXED, THUMB, UNIT_MM, finger_frames

HAND = "hand"
PALM = ((0.20, 0.265, 0.155), (0.0, -0.06, 0.165), (-0.18, -0.375, 0.150))  # x at the wrist, x at the knuckles, half thickness
BACK = -BENDS[0]  # the parameter of the fit is ln (bend + BACK)
BEND_SIGMA = 0.6  # of that logarithm, about a relaxed hand's
REACH = 2.2  # lengths of the bone, from the wrist to beyond the fingers


def is_hand(name: str) -> bool:
    """Whether a bone of this name is a left or right hand."""
    return name in (f"{HAND}.L", f"{HAND}.R")


def hands_of(skeleton: Skeleton) -> tuple[int, ...]:
    """The bones that are hands."""
    return tuple(b for b, bone in enumerate(skeleton.bones) if is_hand(bone.name))


@lru_cache(maxsize=32)
def hand_capsules(left: bool, bend: float = RELAXED) -> tuple[np.ndarray, np.ndarray]:
    """The ends (K, 2, 3) and the radii (K, 2) of a hand's capsules with one for each finger, in lengths of its bone."""
    hand, n = Fingers.bent(left, bend), len(PALM)
    of_fingers = (np.stack([table[n::3, 0], table[n + 2 :: 3, 1]], axis=1) for table in (hand.ends, hand.radii))
    ends, radii = (np.concatenate([table[:n], fingers]) for table, fingers in zip((hand.ends, hand.radii), of_fingers))
    return ends, radii


def thumb_side(left: bool) -> np.ndarray:
    """A place (3,) beside the palm, where the thumb's joint is, in lengths of the bone: it shows how a hand is turned about itself."""
    return np.array([-0.6 if left else 0.6, 0.6, 0.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Fingers:
    """The K capsules of a hand whose fingers are bent, one for each of their bones, in lengths of the hand's bone and its axes."""

    ends: np.ndarray  # (K, 2, 3)
    axis: np.ndarray  # (K, 3) unit
    length: np.ndarray  # (K,)
    radii: np.ndarray  # (K, 2) at both ends
    by_bend: np.ndarray  # (K, 2, 3) derivative of both ends

    @staticmethod
    @lru_cache(maxsize=16)
    def bent(left: bool, bend: float) -> "Fingers":
        """Those of a left or right hand."""
        ends: list[Sequence[np.ndarray]] = [(np.array([w, 0.15, 0.0]), np.array([k, 0.95, 0.0])) for w, k, _ in PALM]
        radii, moved = [(half, 0.9 * half) for _, _, half in PALM], [np.zeros((2, 3))] * len(PALM)
        for finger in (*FINGERS, THUMB):
            frames = finger_frames(finger, bend)
            turned = np.cumsum(np.radians(finger.bends_deg)) * finger.lengths_mm / UNIT_MM
            by_bend = np.concatenate([np.zeros((1, 3)), np.cumsum(turned[:, None] * frames.axes[:, :, 2], axis=0)])
            ends += zip(frames.joints, frames.joints[1:])
            moved += [by_bend[k : k + 2] for k in range(3)]
            radii += [(a / UNIT_MM, b / UNIT_MM) for a, b in zip(finger.radii_mm, finger.radii_mm[1:])]
        side = np.array([-1.0 if left else 1.0, 1.0, 1.0])
        both = np.array(ends) * side
        along = both[:, 1] - both[:, 0]
        length = np.linalg.norm(along, axis=1)
        return Fingers(ends=both, axis=along / length[:, None], length=length, radii=np.array(radii), by_bend=np.array(moved) * side)

    @property
    def first(self) -> np.ndarray:
        """(K, 3) the ends at which the axes begin."""
        return self.ends[:, 0]

    @cached_property
    def taper(self) -> np.ndarray:
        """(K,) the radius' change along the axis."""
        return np.asarray((self.radii[:, 1] - self.radii[:, 0]) / self.length)

    def gaps(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of places (N, 3) the distance from the hand (N,), its gradient (N, 3), and its derivative by the bend (N,)."""
        from_first = places[:, None] - self.first
        along = np.einsum("nki,ki->nk", from_first, self.axis)
        aside = np.sqrt(np.maximum(np.einsum("nki,nki->nk", from_first, from_first) - along**2, 0.0))
        foot = np.clip(along + self.taper * aside / np.sqrt(1 - self.taper**2), 0.0, self.length)
        gap = np.hypot(aside, along - foot) - self.radii[:, 0] - self.taper * foot
        rows, k = np.arange(len(places)), gap.argmin(axis=1)
        share = (foot[rows, k] / self.length[k])[:, None]
        away = from_first[rows, k] - foot[rows, k][:, None] * self.axis[k]
        normal = away / np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
        moved = (1 - share) * self.by_bend[k, 0] + share * self.by_bend[k, 1]
        return gap[rows, k], normal, -np.einsum("ni,ni->n", normal, moved)
