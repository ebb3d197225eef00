"""Limbs: chains of bones whose poses must be observed, with what they carry."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..body.skeleton import frames_of_bones
from .hands import REACH, is_hand, thumb_side
from .state import FIRM_PRIOR, ShapeParameters, free_bones

CARRIED = 0.5  # of the limits of a hand's angle with a firm prior, where its arm is looked for; the hand itself is turned afterwards


@dataclass(frozen=True, eq=False, kw_only=True)
class Limb:
    """A limb, or the outer part of one."""

    parameters: ShapeParameters
    bones: np.ndarray  # those with a pose to be observed, from the body outwards
    outer: np.ndarray  # these and the bones that they carry: a hand
    columns: np.ndarray  # (C,) its DOFs
    low: np.ndarray  # (C,) where they are looked for: within their limits, of a hand that an arm carries nearer to the middle
    high: np.ndarray  # (C,)

    @staticmethod
    def of(parameters: ShapeParameters, first: int) -> "Limb":
        """The limb that begins with a bone.

        The bone before it turns about itself, too: its own points hardly constrain its twist, and it carries the limb around.
        """
        skeleton, free = parameters.skeleton, free_bones(parameters)
        outer = np.flatnonzero(skeleton.ancestors[:, first])
        bones, above = outer[free[outer]], int(skeleton.parents[first])
        twist = (skeleton.dof_bone == above) & free[above] & np.array([dof.axis == "y" for dof in skeleton.dofs])
        columns = np.flatnonzero((np.isin(skeleton.dof_bone, bones) | twist) & ~np.isin(np.arange(len(skeleton.dofs)), skeleton.locked))
        low, high = np.array([skeleton.dofs[c].limits for c in columns]).reshape(-1, 2).T
        firm = np.array(
            [skeleton.dofs[c].prior_sigma <= FIRM_PRIOR and is_hand(skeleton.bones[skeleton.dof_bone[c]].name) for c in columns]
        )
        low, high = (np.where(firm & (len(bones) > 1), CARRIED * limit, limit) for limit in (low, high))
        return Limb(parameters=parameters, bones=bones, outer=outer, columns=columns, low=low, high=high)

    @property
    def parent(self) -> int:
        """The bone that carries it."""
        return int(self.parameters.skeleton.parents[self.bones[0]])

    @property
    def hand(self) -> str | None:
        """The side of a hand alone, "L" or "R"; None for other limbs."""
        name = self.parameters.skeleton.bones[self.bones[0]].name
        return name[-1] if is_hand(name) and len(self.outer) == 1 else None

    def reach_m(self, lengths_m: np.ndarray) -> float:
        """How far it reaches from where it begins, with fingers, in a body with bones of these lengths (B,)."""
        hands = [is_hand(self.parameters.skeleton.bones[b].name) for b in self.outer]
        return float((lengths_m[self.outer] * np.where(hands, REACH, 1.0)).sum())

    def poses(self, pose: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Poses (N, D) with the limb's angles (N, C), else as in a pose (D,)."""
        whole = np.tile(pose, (len(angles), 1))
        whole[:, self.columns] = angles
        return whole

    def samples(self, angles: np.ndarray, count: int, spread: float) -> np.ndarray:
        """Angles (count, C), evenly within `spread` [rad] of some (C,) and within the limits of the joints (Halton 1960)."""
        low, high = np.maximum(self.low, angles - spread), np.minimum(self.high, angles + spread)
        return np.asarray(low + halton(len(angles), count) * np.maximum(high - low, 0.0))

    def head_m(self, pose: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Where it begins (3,) in a pose (D,) of a body with the shape vector (S,)."""
        return self.parameters.state(pose, vector).head_m[self.bones[0]]

    def ends(self, poses: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """The tails (N, E, 3) of its bones in poses (N, D), of a body with the shape vector (S,).

        Of a hand alone the tail and its thumb's side, in the axes that it would have with angles of 0: its arm may move.
        """
        lengths = self.parameters.body(vector)[0]
        R, head = frames_of_bones(self.parameters.skeleton, lengths, poses, self.bones)
        if self.hand is None:
            return np.asarray(head + lengths[self.bones, None] * R[..., 1])
        straight = np.array(poses)
        straight[:, self.columns] = 0.0
        axes = frames_of_bones(self.parameters.skeleton, lengths, straight, self.bones)[0][:, 0]
        places = lengths[self.bones] * np.stack([np.eye(3)[1], thumb_side(self.hand == "L")], axis=1)  # (3, 2)
        return np.asarray((axes.transpose(0, 2, 1) @ R[:, 0] @ places).transpose(0, 2, 1))


def limbs_of(parameters: ShapeParameters) -> dict[int, Limb]:
    """Limbs and the outer parts of limbs, by the first bone of each."""
    skeleton, free = parameters.skeleton, free_bones(parameters)
    sided = [bone.name.endswith((".L", ".R")) for bone in skeleton.bones]
    first = [int(b) for b in np.flatnonzero(free) if skeleton.parents[b] >= 0 and sided[b]]
    return {b: Limb.of(parameters, b) for b in first}


def whole_limbs(parameters: ShapeParameters) -> list[Limb]:
    """The limbs that are no part of a larger one."""
    limbs = limbs_of(parameters)
    return [limb for limb in limbs.values() if limb.parent not in limbs]


@lru_cache(maxsize=32)
def halton(dimensions: int, count: int) -> np.ndarray:
    """Points (count, dimensions) evenly in the unit cube, the same in every run (Halton 1960)."""
    bases = list[int]()  # the first primes
    while len(bases) < dimensions:
        last = bases[-1] if bases else 1
        bases.append(next(n for n in range(last + 1, 2 * last + 1) if all(n % base for base in bases)))
    return np.stack([_radical_inverse(count, base) for base in bases], axis=1)


def _radical_inverse(count: int, base: int) -> np.ndarray:
    """The digits of 0, 1, 2, … in a base, mirrored at the point (count,)."""
    rest, found, unit = np.arange(count), np.zeros(count), 1.0 / base
    while rest.any():
        found += rest % base * unit
        rest, unit = rest // base, unit / base
    return found
