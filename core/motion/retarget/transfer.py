"""The transfer of rotations: every part of the target has the direction and the twist of the source's part.

    D_s(t) = R_s(t) · R_s,restᵀ                      rotation of a part of the source since its rest pose, in the world       (1)
    R_t(t) = D_s(t) · A · R_t,rest                   the target's part turns likewise, from a rest pose like the source's     (2)
    A_body = F_s · F_tᵀ                              F: the body's own axes (left, back, up) in the rest pose                 (3)
    A_child = shortest(A_parent · d_t → d_s) · A_parent        d: direction of the part in the rest pose, head to next head   (4)

(2) with A = 1 is the rule q_t = R_rest,t⁻¹ R_rest,s q_s R_rest,s⁻¹ R_rest,t of equal rest poses; the alignment A extends it to any two. By
(4) the directions of limbs agree exactly; feet are aligned by their heading only, so that their soles stay level. Parts of the torso keep
their rest pose: A = A_body. In chains that bend, each bone of the shorter chain is paired with the bone of the longer one whose end is
nearest to its own, so that a round trip is exact; the bones between get D interpolated along the length.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...geometry.rotation import (
    about,
    angle_of,
    between,
    euler_from_matrix,
    matrix_from_euler,
    rotate,
    shortest,
    transposed,
    twist_about,
    unit,
)
from .mapping import MappedMotion, MappedRig, RigMap
from .rig import Motion, Rig, following
from .roles import ROLES, SEGMENTS, SIDES, SPREAD, above, part_of, side_of, sided

UPRIGHT = np.cos(np.radians(35.0))  # a rest pose that leans by less counts as upright
LEVEL = 0.35  # a foot whose direction has a smaller horizontal component has no heading
LONE_FOREARM = 0.5  # fraction of the hand's twist that a forearm without twist bones takes
SAME_DEG = 0.05  # between a posed part and its source: no offset
SHORTEST_M = 1e-9  # bones below this length count as equally long

Nodes = tuple[np.ndarray, np.ndarray]  # fractions (N,) along a chain, and rotations since rest (N, T, 3, 3)


@dataclass(frozen=True, eq=False, kw_only=True)
class Turned:
    """Rotations of the target's bones in the world. Bones that are not driven keep their rest pose relative to their parents."""

    R: np.ndarray  # (T, B, 3, 3)
    driven: np.ndarray  # (B,) bool: bones that follow the source


def body_axes(rig: Rig, rig_map: RigMap) -> np.ndarray:
    """The body's left, back and up (columns, in the world) in the rest pose; the world's axes for a person who faces −Y."""

    def place(role: str) -> np.ndarray | None:
        name = rig_map.first(role) if role not in rig_map.restored else None
        return rig.head_m[rig.index[name]] if name else None

    pairs = [(place(sided(part, "L")), place(sided(part, "R"))) for part in ("thigh", "upper_arm", "clavicle", "shin", "forearm")]
    across = np.sum([unit(a - b) for a, b in pairs if a is not None and b is not None] or [np.zeros(3)], axis=0)
    low = [p for pair in pairs[:1] for p in pair if p is not None] or [p for p in (place("hips"),) if p is not None]
    high = [p for pair in pairs[1:3] for p in pair if p is not None] + [p for p in (place("head"),) if p is not None]
    up = np.array([0.0, 0.0, 1.0])
    if low and high:
        along = unit(np.mean(high, axis=0) - np.mean(low, axis=0))
        up = up if along @ up > UPRIGHT or not along.any() else along
    across = across - up * (across @ up)
    if np.linalg.norm(across) < 1e-6:
        across = np.array([1.0, 0.0, 0.0]) - up * up[0]
    left = unit(across)
    return np.stack([left, np.cross(up, left), up], axis=1)


def standing_turn(rig: Rig, rig_map: RigMap) -> np.ndarray:
    """The rotation (3, 3) about the world's origin by which a rig stands that lies in its rest pose, or stands on its head; else none."""
    up = body_axes(rig, rig_map)[:, 2]
    return np.eye(3) if up[2] == 1.0 else shortest(up, np.array([0.0, 0.0, 1.0]))


def stood_up(rig: Rig, rig_map: RigMap) -> Rig:
    """The rig itself, or one that was turned so that its rest pose stands (`standing_turn`), on the ground at height 0, wherever it lay."""
    turn = standing_turn(rig, rig_map)
    if (turn == np.eye(3)).all():
        return rig
    head_m, tail_m = rig.head_m @ turn.T, rig.tail_m @ turn.T
    soles = {name: points @ turn.T for name, points in rig.sole_m.items()}
    stands = replace(rig, R_rest=turn @ rig.R_rest, head_m=head_m, tail_m=tail_m, sole_m=soles)
    lift = np.array([0.0, 0.0, -lowest_m(stands)])
    return replace(stands, head_m=head_m + lift, tail_m=tail_m + lift, sole_m={name: points + lift for name, points in soles.items()})


def lowest_m(rig: Rig) -> float:
    """The height of a rig's soles, or else of its lowest joint, in the rest pose."""
    return min([float(points[:, 2].min()) for points in rig.sole_m.values()] or [float(rig.head_m[:, 2].min())])


def direction(rig: Rig, rig_map: RigMap, role: str) -> np.ndarray | None:
    """A part's direction in the rest pose (unit vector in the world): from its head to the next part's, or to its tail."""
    name = rig_map.first(role)
    if name is None:
        return None
    part, side = part_of(role), side_of(role)
    after = dict(SEGMENTS).get(part) or {"foot": "toe"}.get(part)
    following = rig_map.first(sided(after, side)) if after else None
    chain = rig_map.bones[role]
    start = rig.head_m[rig.index[name]]
    end = rig.head_m[rig.index[following]] if following else rig.tail_m[rig.index[chain[-1]]]
    along = unit(end - start)
    return along if along.any() else None


def alignments(source: MappedRig, target: MappedRig) -> dict[str, np.ndarray]:
    """A (3, 3) of every role that both have.  (3), (4)"""
    body = body_axes(source.rig, source.map) @ body_axes(target.rig, target.map).T
    aligned: dict[str, np.ndarray] = {}
    for role in ROLES:
        if role not in source.map.bones or role not in target.map.bones:
            continue
        part = part_of(role)
        A = aligned.get(above(role, aligned), body)
        if part in ("upper_arm", "forearm", "thigh", "shin") or "." in part:
            d_s, d_t = direction(source.rig, source.map, role), direction(target.rig, target.map, role)
            if d_s is not None and d_t is not None:
                A = shortest(A @ d_t, d_s) @ A
        elif part in ("foot", "toe"):
            A = _heading(source, target, role, body)
        elif part not in ("hand",):
            A = body
        aligned[role] = A
    return aligned


def with_offsets(aligned: Mapping[str, np.ndarray], target: MappedRig) -> dict[str, np.ndarray]:
    """The alignments with the rotation offsets of the target's mapping: A · R_t,rest · O · R_t,restᵀ."""
    turned = dict(aligned)
    for role in aligned.keys() & target.map.offsets_deg.keys():
        R_rest = target.rig.R_rest[target.rig.index[target.map.bones[role][0]]]
        O = matrix_from_euler(np.radians(target.map.offsets_deg[role]), "XYZ")
        turned[role] = aligned[role] @ R_rest @ O @ R_rest.T
    return turned


def offsets_of_pose(source: MappedMotion, row: int, target: MappedMotion) -> dict[str, tuple[float, float, float]]:
    """The offsets [°] with which the target has the pose of its first frame when the source has that of frame number `row`; parts without
    a difference are left out. Each part is compared by the first of its bones."""
    offsets: dict[str, tuple[float, float, float]] = {}
    for role, A in alignments(source.mapped_rig, target.mapped_rig).items():
        s, t = (mapped.rig.index[mapped.map.bones[role][0]] for mapped in (source, target))
        D = source.motion.R[row, s] @ source.rig.R_rest[s].T
        O = (D @ A @ target.rig.R_rest[t]).T @ target.motion.R[0, t]
        angles = np.degrees(euler_from_matrix(O[None], "XYZ")[0])
        if np.degrees(angle_of(O)) > SAME_DEG:
            offsets[role] = (float(angles[0]), float(angles[1]), float(angles[2]))
    return offsets


def _heading(source: MappedRig, target: MappedRig, role: str, body: np.ndarray) -> np.ndarray:
    """A foot is aligned about the body's up axis alone."""
    up = body_axes(source.rig, source.map)[:, 2]
    foot = sided("foot", side_of(role))
    d_s, d_t = direction(source.rig, source.map, foot), direction(target.rig, target.map, foot)
    if d_s is None or d_t is None:
        return body
    flat_s, flat_t = d_s - up * (d_s @ up), body @ d_t - up * (body @ d_t @ up)
    if min(np.linalg.norm(flat_s), np.linalg.norm(flat_t)) < LEVEL:
        return body
    return shortest(flat_t, flat_s) @ body


def turn(source: MappedMotion, target: MappedRig, aligned: Mapping[str, np.ndarray]) -> Turned:
    """Rotations (T, B, 3, 3) of all the target's bones in the world.  (2)"""
    motion, rig = source.motion, target.rig
    since_rest = motion.R @ transposed(motion.rig.R_rest)  # (1)
    wanted: dict[int, np.ndarray] = {}
    for role, A in aligned.items():
        nodes = _nodes(source.mapped_rig, role, since_rest)
        chain = [rig.index[name] for name in target.map.bones[role]]
        fractions = _spread_over(nodes[0][1:], fractions_of(rig, chain)) if part_of(role) in SPREAD else np.ones(len(chain))
        for bone, fraction in zip(chain, fractions):
            wanted[bone] = _at(nodes, fraction) @ A @ rig.R_rest[bone]
    _point(source, target, wanted)
    R = np.zeros((len(motion.frames), len(rig.names), 3, 3))
    for bone, rotation in wanted.items():
        R[:, bone] = rotation
    driven = np.isin(np.arange(len(rig.names)), list(wanted))
    R = following(rig, R, driven)
    for side in SIDES:  # toes that only the target has follow their foot until the ball of the foot stands
        if sided("foot", side) in aligned:
            driven[[rig.index[name] for name in target.map.bones.get(sided("toe", side), ())]] = True
    return Turned(R=R, driven=driven)


def untwisted_bone(chain: Sequence[Any], role: str) -> Any:
    """The bone of a part, given from the body outwards, that keeps the part's own rotation when `share_twist` spreads the twist."""
    return chain[0] if part_of(role) in ("forearm", "shin") else chain[-1]


def _nodes(source: MappedRig, role: str, since_rest: np.ndarray) -> Nodes:
    """The source's rotations along a chain: at 0 that of the part above, then at the end of each of its bones."""
    rig, rig_map = source.rig, source.map
    chain = [rig.index[name] for name in rig_map.bones[role]]
    before = above(role, rig_map.bones)
    if part_of(role) not in SPREAD:
        return np.array([0.0, 1.0]), np.stack([since_rest[:, untwisted_bone(chain, role)]] * 2)
    start = since_rest[:, rig.index[rig_map.bones[before][-1]]] if before else since_rest[:, chain[0]]
    return np.concatenate([[0.0], fractions_of(rig, chain)]), np.stack([start, *(since_rest[:, b] for b in chain)])


def fractions_of(rig: Rig, chain: list[int]) -> np.ndarray:
    """Where each bone of a chain ends, as a fraction (0…1] of the chain's length."""
    ends = [rig.head_m[b] for b in chain[1:]] + [rig.tail_m[chain[-1]]]
    length = np.array([np.linalg.norm(end - rig.head_m[b]) for b, end in zip(chain, ends)])
    if length.sum() < SHORTEST_M or (length < SHORTEST_M).any():
        length = np.ones(len(chain))
    return np.cumsum(length) / length.sum()


def _spread_over(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The fractions of the source's chain from which the target's bones take their rotations; both given by their bones' ends (0…1]."""
    if len(target) < len(source):
        return source[partners_of(target, source)]
    partners = partners_of(source, target)
    return np.asarray(np.interp(target, np.concatenate([[0.0], target[partners]]), np.concatenate([[0.0], source])))


def partners_of(few: np.ndarray, many: np.ndarray) -> list[int]:
    """The index in `many` (ascending) of the partner of each of `few`: the nearest, each once, in order; the last with the last."""
    partners: list[int] = []
    for i, place in enumerate(few):
        first, stop = partners[-1] + 1 if partners else 0, len(many) - (len(few) - 1 - i)
        partners.append(first + int(np.abs(many[first:stop] - place).argmin()))
    return partners[:-1] + [len(many) - 1]


def _at(nodes: Nodes, fraction: float) -> np.ndarray:
    fractions, D = nodes
    k = int(np.searchsorted(fractions, fraction - 1e-9))
    if k == 0 or fraction >= fractions[k] - 1e-9:
        return D[k]
    part = (fraction - fractions[k - 1]) / (fractions[k] - fractions[k - 1])
    return between(D[k - 1], D[k], float(part))


def directions(motion: Motion, rig_map: RigMap) -> dict[str, np.ndarray]:
    """Directions of the limbs' parts in every frame (T, 3): from joint to joint, by role."""
    found = {}
    for side in SIDES:
        for part, after in SEGMENTS:
            first, following = rig_map.first(sided(part, side)), rig_map.first(sided(after, side))
            if first and following:
                place = motion.head_m[:, motion.rig.index[following]] - motion.head_m[:, motion.rig.index[first]]
                found[sided(part, side)] = unit(place)
    return found


def _point(source: MappedMotion, target: MappedRig, wanted: dict[int, np.ndarray]) -> None:
    """Correct `wanted` for sources whose joints also shift: the limbs' directions agree with the joints', not only with the rotations."""
    for role, along in directions(source.motion, source.map).items():
        d_t = direction(target.rig, target.map, role)
        chain = [target.rig.index[name] for name in target.map.bones.get(role, ())]
        if d_t is None or not along.any(axis=-1).all():
            continue
        for bone in chain:
            now = rotate(wanted[bone] @ target.rig.R_rest[bone].T, d_t)
            wanted[bone] = shortest(now, along) @ wanted[bone]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _TwistChain:
    """A part along which a twist is spread: its bones and its twist bones from the body outwards, and its direction in the rest pose.

    The twist comes from the hand or foot at the part's `end`; without one, it is the part's own against its parent.
    """

    rig: Rig
    chain: list[int]
    twist_bones: list[int]
    direction: np.ndarray
    end: int | None

    def twist(self, R: np.ndarray) -> np.ndarray | None:
        """Twist (T,) [rad] about the part's own axis in R (T, B, 3, 3); None without a parent."""
        bone = self.chain[0]
        a, b = (bone, self.end) if self.end is not None else (int(self.rig.parents[bone]), bone)
        if a < 0:
            return None
        relative = transposed(R[:, a]) @ R[:, b] @ (self.rig.R_rest[b].T @ self.rig.R_rest[a])
        return np.unwrap(twist_about(relative, self.rig.R_rest[a].T @ self.direction))

    def spread(self, R: np.ndarray, twist: np.ndarray, *, lone: bool) -> None:
        """Write into R; `lone`: a single bone without twist bones takes a part of the twist of its end."""
        before, n, m, outwards = R.copy(), len(self.chain), len(self.twist_bones), self.end is not None
        rest, d = self.rig.R_rest, self.direction
        if outwards:
            parts = [LONE_FOREARM] if lone and n == 1 else [k / n for k in range(n)]
        else:
            parts = [(k + 1) / n - 1.0 for k in range(n)]
        for b, part in zip(self.chain, parts):
            R[:, b] = before[:, b] @ about(rest[b].T @ d, part * twist)
        for k, b in enumerate(self.twist_bones):
            p, part = self.rig.parents[b], (k + 1) / (m + 1) - (0.0 if outwards else 1.0)
            R[:, b] = before[:, p] @ (rest[p].T @ rest[b]) @ about(rest[b].T @ d, part * twist)


def share_twist(target: MappedRig, turned: Turned, *, lone_forearms: bool = False) -> Turned:
    """Spread the twist of hands, feet and upper limbs over twist bones: turning a bone about its own axis moves no joint.

    The hand's twist is spread down the forearm, the foot's down the shin, from the first of their bones, which keeps the part's own
    rotation; the twist bones of an upper arm or thigh turn back towards the shoulder or hip, from the last, which keeps it. So the part's
    own rotation can be recovered (`untwisted_bone`). With `lone_forearms` a forearm of one bone without twist bones takes half of the
    hand's twist; that cannot be recovered from the rig.
    """
    R, driven = turned.R.copy(), turned.driven.copy()
    for side in SIDES:
        for part, after in (("forearm", "hand"), ("shin", "foot"), ("upper_arm", ""), ("thigh", "")):
            found = _twist_chain(target, sided(part, side), sided(after, side) if after else "")
            if found is None or not driven[found.chain[0]] or (found.end is not None and not driven[found.end]):
                continue
            twist = found.twist(turned.R)
            if twist is not None:
                found.spread(R, twist, lone=lone_forearms and part == "forearm" and not found.twist_bones)
                driven[found.twist_bones] = True
    return Turned(R=following(target.rig, R, driven), driven=driven)


def _twist_chain(target: MappedRig, role: str, after: str) -> _TwistChain | None:
    """A part's bones with the hand or foot `after` it; None if the rig lacks one of them, or the part has no direction."""
    rig, names = target.rig, target.map
    end, d = names.first(after) if after else None, direction(rig, names, role)
    if d is None or (after and end is None):
        return None
    chain = [rig.index[name] for name in names.bones[role]]
    twist_bones = [rig.index[name] for name in names.twist.get(role, ()) if rig.parents[rig.index[name]] in chain]
    twist_bones.sort(key=lambda b: float((rig.head_m[b] - rig.head_m[chain[0]]) @ d))
    return _TwistChain(rig=rig, chain=chain, twist_bones=twist_bones, direction=d, end=rig.index[end] if end else None)
