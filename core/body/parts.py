"""The parts of a body for its skin: chains of bones, from joint to joint, and the bone from which each chain branches off.

At each joint a chain continues with the child whose direction is nearest to its own (pelvis, spine, chest, neck, head; upper arm, forearm,
hand); the other children begin chains that branch off their parent bone. Bones without metaballs are skipped.

The thickness of a body around each of its bones: where the summed field of the bone and its chain neighbours equals the threshold.

It does not follow from the radii of single balls: a limb's radius results from the sum, and adjacent stout bones add to it as much as the
bone's own balls. Limbs that branch off (a shoulder at the chest) are not counted.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .metaballs import STATIONS, THRESHOLD, Metaballs
from .shape import BodyShape
from .skeleton import Skeleton, bone_frames

JUNCTION_SHARE = 1 / 3  # first fraction of a chain's length, that blends with its parent part


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """One chain of consecutive bones with metaballs."""

    bones: tuple[int, ...]
    junction: tuple[int, ...]  # its first bones, which may blend with the parent part
    parent: int | None  # the part from which it branches off
    attachment: int | None  # … and the bone of that part


def body_parts(shape: BodyShape) -> tuple[Part, ...]:
    """The chains of the bones that have metaballs; parents before children, every bone in one of them."""
    skeleton = shape.skeleton
    fleshy = sorted(set(shape.metaballs.bone_index.tolist()))
    parts: list[Part] = []
    owner: dict[int, int] = {}
    for first in fleshy:
        if first in owner:
            continue
        chain = [first]
        while (ahead := _continuation(shape, chain[-1], fleshy)) is not None:
            chain.append(ahead)
        attachment = int(skeleton.parents[first])
        while attachment >= 0 and attachment not in owner:
            attachment = int(skeleton.parents[attachment])
        parts.append(
            Part(
                bones=tuple(chain),
                junction=_junction(shape, chain),
                parent=owner.get(attachment),
                attachment=attachment if attachment >= 0 else None,
            )
        )
        owner |= {bone: len(parts) - 1 for bone in chain}
    return tuple(parts)


def _continuation(shape: BodyShape, bone: int, fleshy: list[int]) -> int | None:
    skeleton = shape.skeleton
    ahead = [c for c in fleshy if skeleton.parents[c] == bone and skeleton.starts_at_tail[c]]
    y = skeleton.bones[bone].R_rest[:, 1]
    return max(ahead, key=lambda c: float(skeleton.bones[c].R_rest[:, 1] @ y), default=None)


def _junction(shape: BodyShape, chain: list[int]) -> tuple[int, ...]:
    reached = np.cumsum(shape.lengths_m[chain])
    return tuple(chain[: 1 + int(np.searchsorted(reached, JUNCTION_SHARE * reached[-1]))])


ALONG = 5  # stations along a bone, from its first ball to its last
SIDES = np.array([[1.0, 0, 0], [0, 0, 1.0], [-1.0, 0, 0], [0, 0, -1.0]])  # in the bone's axes: x, z, −x, −z
HALVINGS = 14  # of the bisection: to 1/16384 of the reach
FARTHEST = 1.25  # visible radius / largest l across of summed balls
LEAST_M = 0.003  # where the balls do not surround the axis


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoneProfile:
    """Even fractions along a bone (K,), and the radii there (K, 4) [m] towards x, z, −x and −z of its axes; constant beyond the ends."""

    stations: np.ndarray
    radii_m: np.ndarray

    def across(self, along: np.ndarray, across_m: np.ndarray) -> np.ndarray:
        """Half axes (N, 2) of the quarter ellipse of a point at fractions (N,) along and positions (N, 2) in x and z across the bone."""
        return ProfileTable.of({0: self}, 1).across(np.zeros(len(along), dtype=np.intp), along, across_m)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ProfileTable:
    """The profiles of all bones in one table."""

    first: np.ndarray  # (B,) fraction along the bone of the first station
    step: np.ndarray  # (B,)
    radii_m: np.ndarray  # (B, K, 4), 0 for a bone without balls

    @staticmethod
    def of(profiles: Mapping[int, BoneProfile], bones: int) -> "ProfileTable":
        """That of the profiles of some of so many bones."""
        first, step, radii = np.zeros(bones), np.ones(bones), np.zeros((bones, ALONG, len(SIDES)))
        for b, profile in profiles.items():
            first[b], step[b] = profile.stations[0], (profile.stations[-1] - profile.stations[0]) / (ALONG - 1)
            radii[b] = profile.radii_m
        return ProfileTable(first=first, step=step, radii_m=radii)

    def across(self, bone: np.ndarray, along: np.ndarray, across_m: np.ndarray) -> np.ndarray:
        """As `BoneProfile.across`, of one bone for each point (N,)."""
        place = np.clip((along - self.first[bone]) / self.step[bone], 0.0, ALONG - 1)
        before = np.minimum(place.astype(np.intp), ALONG - 2)
        share = (place - before)[:, None]
        towards = len(SIDES) * (ALONG * bone + before)[:, None] + [0, 1] + 2 * (across_m < 0)
        radii = self.radii_m.reshape(-1)
        first = radii.take(towards)
        return np.asarray(first + share * (radii.take(towards + len(SIDES)) - first))


def chain_neighbours(shape: BodyShape) -> np.ndarray:
    """(B, B) whether the balls of bone j count for the profile of bone i: adjacent bones of one chain."""
    together = np.zeros_like(shape.skeleton.neighbours)
    for part in body_parts(shape):
        together[np.ix_(part.bones, part.bones)] = True
    return together & shape.skeleton.neighbours


def bone_profiles(skeleton: Skeleton, lengths_m: np.ndarray, balls: Metaballs, counted: np.ndarray) -> dict[int, BoneProfile]:
    """The profiles of all bones that have balls, in the rest pose. `counted` (B, B) as from `chain_neighbours`."""
    R, head = bone_frames(skeleton, lengths_m, np.zeros(len(skeleton.dofs)))
    centres = head[balls.bone_index] + np.einsum("mij,mj->mi", R[balls.bone_index], balls.centres_m(lengths_m))
    scaled = R[balls.bone_index].transpose(0, 2, 1) / balls.radii_m[:, :, None]  # world to units of l
    found = {}
    for b in np.unique(balls.bone_index).tolist():
        fractions = balls.centre[balls.bone_index == b, 1]
        stations = np.linspace(min(STATIONS[0], fractions.min()), max(STATIONS[-1], fractions.max()), ALONG)
        origin = np.repeat(head[b] + (stations * lengths_m[b])[:, None] * R[b, :, 1], len(SIDES), axis=0)
        used = counted[b, balls.bone_index]
        M = scaled[used]
        o = np.einsum("mij,nmj->nmi", M, origin[:, None] - centres[used])
        u = np.einsum("mij,nj->nmi", M, np.tile(SIDES @ R[b].T, (ALONG, 1)))
        aside = np.linalg.norm(balls.centres_m(lengths_m)[used][:, [0, 2]], axis=1)
        reach = float((FARTHEST * balls.radii_m[used][:, [0, 2]].max(axis=1) + aside).max())
        radii = _visible_radii(o, u, balls.weight[used], reach)
        found[b] = BoneProfile(stations=stations, radii_m=np.maximum(radii, LEAST_M).reshape(ALONG, len(SIDES)))
    return found


def _visible_radii(o: np.ndarray, u: np.ndarray, weight: np.ndarray, reach_m: float) -> np.ndarray:
    """The ρ (N,) at which rays o + ρ u (N, m, 3), in units of each ball's l, leave the surface; 0 where they begin outside."""
    a, b, c = (np.einsum("nmi,nmi->nm", p, q) for p, q in ((u, u), (o, u), (o, o)))
    low, high = np.zeros(len(o)), np.full(len(o), reach_m)
    for _ in range(HALVINGS):
        middle = ((low + high) / 2)[:, None]
        inside = np.exp(-2 * (c + middle * (2 * b + middle * a))) @ weight >= THRESHOLD
        low, high = np.where(inside, middle[:, 0], low), np.where(inside, high, middle[:, 0])
    return (low + high) / 2
