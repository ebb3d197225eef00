"""The parts of a body for its skin: chains of bones, from joint to joint, and the bone from which each chain branches off.

At each joint a chain continues with the child whose direction is nearest to its own (pelvis, spine, chest, neck, head; upper arm, forearm,
hand); the other children begin chains that branch off their parent bone. Bones without metaballs are skipped.
"""

from dataclasses import dataclass

import numpy as np

from ..shape import BodyShape

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
