"""Recognising a rig without meaningful names: from its hierarchy, its lengths and its symmetry.

A body is a tree with two pairs of similar branches: the pair that ends lowest are the legs; of the pairs that fork above, the one that
reaches out farthest are the arms. The two longest consecutive bones of a branch are the limb; the bone before it is the collar bone or
hip, the bones after it are hand or foot. Left and right follow from the feet, which point forward.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .rig import Rig
from .roles import marks_an_end, sided

MOST_LIMBS = 100  # of one bone

# By the rig's height
SHORTEST_LIMB = 0.1  # shorter branches are no limbs
LOW_END = 0.2  # the legs end below this height
ARMS_OVER_HIPS = 0.15  # the arms fork at least so far above the legs
NECK_OFF_AXIS = 0.06  # neck and head are not farther from the chest's vertical
# By the length of the longer of two mirrored branches
ALIKE = 0.15  # their lengths differ by less …
LEVEL_ENDS = 0.05  # … and the heights of their ends
APART = 0.1  # their ends are farther apart
SPREAD_OUT = 0.3  # each end is farther from the fork
OFF_CENTRE = (0.6, 0.25)  # their middle is off the fork by less than so much of their distance and so much of their length
LONG_CLAVICLE = 0.6  # by the bone after it: a first bone that is shorter is a collar bone, not an upper arm
FEET_FORWARD = 0.05  # by leg length: shorter feet do not define forward
MOST_NECK_BONES = 6
ON_A_LEVEL_M = 1e-6  # tolerance for bones on one height
LEVEL_TOLERANCE_M = 1e-9  # of branches without length


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ShapeMatch:
    """Chains of bone names by role. `sides_known`: the feet define which way is forward, thus left and right."""

    bones: Mapping[str, tuple[str, ...]]
    sides_known: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class _Branch:
    """Bones from a fork outwards, and their length up to the end of the last one."""

    line: tuple[int, ...]
    length_m: float


def by_shape(rig: Rig) -> ShapeMatch | None:
    """The parts of the body by shape alone, or None if the rig is not shaped like a person who stands upright."""
    pairs = _pairs(rig)
    legs = min(pairs, key=lambda pair: (round(_end(rig, pair[0])[2], 3), len(rig.ancestors(pair[0].line[0]))), default=None)
    if legs is None or _end(rig, legs[0])[2] > rig.head_m[:, 2].min() + LOW_END * rig.height_m:
        return None
    fork = rig.common(legs[0].line[0], legs[1].line[0])
    arms = [
        pair
        for pair in pairs
        if fork is not None
        and not set(pair[0].line) & {*legs[0].line, *legs[1].line}
        and rig.head_m[pair[0].line[0]][2] > rig.head_m[fork][2] + ARMS_OVER_HIPS * rig.height_m
        and fork in rig.ancestors(pair[0].line[0])
    ]
    arm = max(arms, key=lambda pair: pair[0].length_m, default=None)
    if fork is None or arm is None:
        return None
    bones, sides_known = _sides(rig, legs, arm)
    chest = rig.common(arm[0].line[0], arm[1].line[0])
    if chest is None or fork not in rig.ancestors(chest):
        return None
    bones["hips"] = (rig.names[fork],)
    spine = rig.path(fork, chest)[1:]
    if spine:
        bones["spine"] = tuple(rig.names[b] for b in spine)
    top = _upwards(rig, chest, {*arm[0].line, *arm[1].line, *legs[0].line, *legs[1].line})
    if top:
        bones["head"] = (rig.names[top[-1]],)
        if top[:-1]:
            bones["neck"] = tuple(rig.names[b] for b in top[:-1])
    return ShapeMatch(bones=bones, sides_known=sides_known)


def _pairs(rig: Rig) -> list[tuple[_Branch, _Branch]]:
    """Pairs of branches of one bone that mirror each other in an upright plane."""
    pairs = []
    for fork, children in enumerate(rig.children):
        branches = [b for b in (_branch(rig, child) for child in children) if b.length_m > SHORTEST_LIMB * rig.height_m]
        branches = branches if len(branches) <= MOST_LIMBS else []  # no body forks so: every two would be compared
        for i, a in enumerate(branches):
            for b in branches[i + 1 :]:
                if _mirrored(rig, fork, a, b):
                    pairs.append((a, b))
    return pairs


def _branch(rig: Rig, start: int) -> _Branch:
    """The longest chain from `start` outwards; any finger continues an arm as well as another."""
    best = _Branch(line=(start,), length_m=float(np.linalg.norm(rig.tail_m[start] - rig.head_m[start])))
    for child in _proper_children(rig, start):
        tail = _branch(rig, child)
        length = tail.length_m + float(np.linalg.norm(rig.head_m[child] - rig.head_m[start]))
        if length > best.length_m or len(best.line) == 1:
            best = _Branch(line=(start, *tail.line), length_m=length)
    return best


def _proper_children(rig: Rig, bone: int) -> list[int]:
    """The children of a bone, without those that only mark its end."""
    return [child for child in rig.children[bone] if rig.children[child] or not marks_an_end(rig.names[child])]


def _end(rig: Rig, branch: _Branch) -> np.ndarray:
    return rig.head_m[branch.line[-1]]


def _mirrored(rig: Rig, fork: int, a: _Branch, b: _Branch) -> bool:
    size = max(a.length_m, b.length_m)
    end_a, end_b = _end(rig, a) - rig.head_m[fork], _end(rig, b) - rig.head_m[fork]
    apart = float(np.linalg.norm(end_a[:2] - end_b[:2]))
    level = abs(end_a[2] - end_b[2]) < LEVEL_ENDS * size + LEVEL_TOLERANCE_M
    middle = np.linalg.norm((end_a + end_b)[:2]) / 2
    alike = abs(a.length_m - b.length_m) < ALIKE * size and level and apart > APART * size
    return bool(alike and np.linalg.norm(end_a) > SPREAD_OUT * size and middle < OFF_CENTRE[0] * apart + OFF_CENTRE[1] * size)


def _sides(rig: Rig, legs: tuple[_Branch, _Branch], arms: tuple[_Branch, _Branch]) -> tuple[dict[str, tuple[str, ...]], bool]:
    """Limbs by role. Forward is where the feet point: from the ankle to the end of the foot."""
    parts = [_parts(rig, branch, ("thigh", "shin"), ("foot", "toe"), "") for branch in legs]
    feet = [line[line.index(part["shin"][-1]) + 1 :] for part, line in zip(parts, (legs[0].line, legs[1].line))]
    forward = np.zeros(3)
    for line in feet:
        if line:
            last = line[-1]
            end = rig.tail_m[last] if len(line) == 1 else rig.head_m[last]
            forward += (end - rig.head_m[line[0]]) * (1, 1, 0)
    sides_known = bool(np.linalg.norm(forward) > FEET_FORWARD * legs[0].length_m)
    left = np.cross((0.0, 0.0, 1.0), forward if sides_known else (0.0, -1.0, 0.0))
    bones: dict[str, tuple[str, ...]] = {}
    for pair, names in ((legs, (("thigh", "shin"), ("foot", "toe"), "")), (arms, (("upper_arm", "forearm"), ("hand",), "clavicle"))):
        first_is_left = float((_end(rig, pair[0]) - _end(rig, pair[1])) @ left) > 0
        for branch, side in zip(pair, ("L", "R") if first_is_left else ("R", "L")):
            for part, chain in _parts(rig, branch, *names).items():
                bones[sided(part, side)] = tuple(rig.names[b] for b in chain)
    return bones, sides_known


def _parts(rig: Rig, branch: _Branch, limb: tuple[str, str], after: tuple[str, ...], before: str) -> dict[str, tuple[int, ...]]:
    line = branch.line
    ends = [rig.head_m[b] for b in line[1:]] + [rig.tail_m[line[-1]]]
    length = np.array([np.linalg.norm(end - rig.head_m[b]) for b, end in zip(line, ends)])
    k = int(np.argmax(length[:-1] + length[1:])) if len(line) > 1 else 0
    if len(line) > k + 3 and not after[1:] and length[k] < LONG_CLAVICLE * length[k + 1]:
        k += 1
    parts: dict[str, tuple[int, ...]] = {limb[0]: (line[k],)}
    if len(line) > k + 1:
        parts[limb[1]] = (line[k + 1],)
    for part, bone in zip(after, line[k + 2 :]):
        parts[part] = (bone,)
    if before and k > 0:
        parts[before] = (line[k - 1],)
    return parts


def _upwards(rig: Rig, chest: int, taken: set[int]) -> list[int]:
    """The chain from the chest upwards between the arms: neck and head."""
    line: list[int] = []
    bone = chest
    while True:
        ahead = [
            c
            for c in _proper_children(rig, bone)
            if c not in taken
            and rig.head_m[c][2] >= rig.head_m[bone][2] - ON_A_LEVEL_M
            and np.linalg.norm((rig.head_m[c] - rig.head_m[chest])[:2]) < NECK_OFF_AXIS * rig.height_m
        ]
        if not ahead or len(line) > MOST_NECK_BONES:
            return line
        bone = max(ahead, key=lambda c: _branch(rig, c).length_m)
        line.append(bone)
