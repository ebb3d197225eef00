"""The transfer of rotations: every part of the target points where the source's part points, and turns as it turns.

    D_s(t) = R_s(t) · R_s,restᵀ                      how a part of the source has turned since its rest pose, in the world    (1)
    R_t(t) = D_s(t) · A · R_t,rest                   the target's part turns likewise, from a rest pose like the source's     (2)
    A_body = F_s · F_tᵀ                              F: the body's own axes (left, back, up) in the rest pose                 (3)
    A_child = shortest(A_parent · d_t → d_s) · A_parent        d: direction of the part in the rest pose, head to next head   (4)

(2) with A = 1 is the rule q_t = R_rest,t⁻¹ R_rest,s q_s R_rest,s⁻¹ R_rest,t of equal rest poses; A makes it hold for any two. By (4) the
directions of limbs agree exactly; feet get A by their heading only, since what matters of a foot is that its sole is level. Torso
parts keep their rest posture: A = A_body. Of chains that bend, the bones of the shorter one go to the bones of the longer one that end
nearest to theirs, so that they return; what lies between gets D interpolated along the length.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .mapping import RigMap
from .rig import Motion, Rig
from .roles import ROLES, SEGMENTS, SIDES, SPREAD, above, part_of, side_of, sided
from .turns import about, between, rotate, shortest, transposed, twist_about, unit

UPRIGHT = np.cos(np.radians(35.0))  # a rest pose that leans less is taken as upright
LEVEL = 0.35  # a foot whose direction has a smaller horizontal part has no heading

Nodes = tuple[np.ndarray, np.ndarray]  # fractions (N,) along a chain, and rotations since rest (N, T, 3, 3)


@dataclass(frozen=True, eq=False, kw_only=True)
class Turned:
    """Rotations of the target's bones in the world; `driven` says which bones follow the source, the others keep to their parents."""

    R: np.ndarray  # (T, B, 3, 3)
    driven: np.ndarray  # (B,) bool


def body_axes(rig: Rig, rig_map: RigMap) -> np.ndarray:
    """The body's left, back and up (columns, in the world) in the rest pose; the world's axes for a person who faces −Y."""

    def place(role: str) -> np.ndarray | None:
        name = rig_map.first(role) if role not in rig_map.hung else None
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


def direction(rig: Rig, rig_map: RigMap, role: str) -> np.ndarray | None:
    """Where a limb's part points in the rest pose (unit vector in the world): from its head to the next part's, or to its tail."""
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


def alignments(source: Rig, source_map: RigMap, target: Rig, target_map: RigMap) -> dict[str, np.ndarray]:
    """A (3, 3) of every role that both have.  (3), (4)"""
    body = body_axes(source, source_map) @ body_axes(target, target_map).T
    aligned: dict[str, np.ndarray] = {}
    for role in ROLES:
        if role not in source_map.bones or role not in target_map.bones:
            continue
        part = part_of(role)
        A = aligned.get(above(role, aligned), body)
        if part in ("upper_arm", "forearm", "thigh", "shin") or "." in part:
            d_s, d_t = direction(source, source_map, role), direction(target, target_map, role)
            if d_s is not None and d_t is not None:
                A = shortest(A @ d_t, d_s) @ A
        elif part in ("foot", "toe"):
            A = _heading(source, source_map, target, target_map, role, body)
        elif part not in ("hand",):
            A = body
        aligned[role] = A
    return aligned


def _heading(source: Rig, source_map: RigMap, target: Rig, target_map: RigMap, role: str, body: np.ndarray) -> np.ndarray:
    """A foot is aligned about the body's up axis alone."""
    up = body_axes(source, source_map)[:, 2]
    foot = sided("foot", side_of(role))
    d_s, d_t = direction(source, source_map, foot), direction(target, target_map, foot)
    if d_s is None or d_t is None:
        return body
    flat_s, flat_t = d_s - up * (d_s @ up), body @ d_t - up * (body @ d_t @ up)
    if min(np.linalg.norm(flat_s), np.linalg.norm(flat_t)) < LEVEL:
        return body
    return shortest(flat_t, flat_s) @ body


def turn(motion: Motion, source_map: RigMap, target: Rig, target_map: RigMap, aligned: Mapping[str, np.ndarray]) -> Turned:
    """Rotations (T, B, 3, 3) of all the target's bones in the world.  (2)"""
    since_rest = motion.R @ transposed(motion.rig.R_rest)  # (1)
    wanted: dict[int, np.ndarray] = {}
    for role, A in aligned.items():
        nodes = _nodes(motion.rig, source_map, role, since_rest)
        chain = [target.index[name] for name in target_map.bones[role]]
        fractions = _spread_over(nodes[0][1:], fractions_of(target, chain)) if part_of(role) in SPREAD else np.ones(len(chain))
        for bone, fraction in zip(chain, fractions):
            wanted[bone] = _at(nodes, fraction) @ A @ target.R_rest[bone]
    _point(motion, source_map, target, target_map, wanted)
    R = np.zeros((len(motion.frames), len(target.names), 3, 3))
    for bone, rotation in wanted.items():
        R[:, bone] = rotation
    driven = np.isin(np.arange(len(target.names)), list(wanted))
    R = follow(target, R, driven)
    for side in SIDES:  # toes that only the target has go with their foot, until they stand
        if sided("foot", side) in aligned:
            driven[[target.index[name] for name in target_map.bones.get(sided("toe", side), ())]] = True
    return Turned(R=R, driven=driven)


def kept(chain: Sequence[Any], role: str) -> Any:
    """Which of a part's bones, from the body outwards, has the part's own rotation, without what `share_twist` has spread."""
    return chain[0] if part_of(role) in ("forearm", "shin") else chain[-1]


def _nodes(rig: Rig, rig_map: RigMap, role: str, since_rest: np.ndarray) -> Nodes:
    """The source's rotations along a chain: at 0 that of what the chain hangs on, then after each of its bones."""
    chain = [rig.index[name] for name in rig_map.bones[role]]
    before = above(role, rig_map.bones)
    if part_of(role) not in SPREAD:
        return np.array([0.0, 1.0]), np.stack([since_rest[:, kept(chain, role)]] * 2)
    start = since_rest[:, rig.index[rig_map.bones[before][-1]]] if before else since_rest[:, chain[0]]
    return np.concatenate([[0.0], fractions_of(rig, chain)]), np.stack([start, *(since_rest[:, b] for b in chain)])


def fractions_of(rig: Rig, chain: list[int]) -> np.ndarray:
    """Where each bone of a chain ends, as a part (0…1] of its length."""
    ends = [rig.head_m[b] for b in chain[1:]] + [rig.tail_m[chain[-1]]]
    length = np.array([np.linalg.norm(end - rig.head_m[b]) for b, end in zip(chain, ends)])
    if length.sum() < 1e-9 or (length < 1e-9).any():
        length = np.ones(len(chain))
    return np.cumsum(length) / length.sum()


def _spread_over(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Where on the source's chain each of the target's bones has its rotation from; both by where their bones end (0…1]."""
    if len(target) < len(source):
        return source[partners_of(target, source)]
    partners = partners_of(source, target)
    return np.asarray(np.interp(target, np.concatenate([[0.0], target[partners]]), np.concatenate([[0.0], source])))


def partners_of(few: np.ndarray, many: np.ndarray) -> list[int]:
    """Which of `many` rising numbers goes with each of `few`: the nearest, each once, in order; the last with the last."""
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
    """Where the limbs' parts point in every frame (T, 3): from joint to joint, by role."""
    found = {}
    for side in SIDES:
        for part, after in SEGMENTS:
            first, following = rig_map.first(sided(part, side)), rig_map.first(sided(after, side))
            if first and following:
                place = motion.head_m[:, motion.rig.index[following]] - motion.head_m[:, motion.rig.index[first]]
                found[sided(part, side)] = unit(place)
    return found


def _point(motion: Motion, source_map: RigMap, target: Rig, target_map: RigMap, wanted: dict[int, np.ndarray]) -> None:
    """The last bit for sources whose joints also shift: the limbs' directions agree with the joints', not only with the rotations."""
    for role, along in directions(motion, source_map).items():
        d_t = direction(target, target_map, role)
        chain = [target.index[name] for name in target_map.bones.get(role, ())]
        if d_t is None or not along.any(axis=-1).all():
            continue
        for bone in chain:
            now = rotate(wanted[bone] @ target.R_rest[bone].T, d_t)
            wanted[bone] = shortest(now, along) @ wanted[bone]


def share_twist(target: Rig, target_map: RigMap, turned: Turned, *, lone_forearms: bool = False) -> Turned:
    """Spread the twist of hands, feet and upper limbs over the bones that are there for it: turning a bone about its own axis moves no
    joint.

    The hand's twist runs down the forearm, the foot's down the shin, from the first of their bones, which keeps the part's own rotation;
    the twist bones of an upper arm or thigh turn back towards the shoulder or hip, from the last, which keeps it. So what was spread can
    be read back (`kept`). With `lone_forearms` a forearm of one bone without twist bones takes half of the hand's twist; that cannot be
    read back.
    """
    R, driven = turned.R.copy(), turned.driven.copy()
    for side in SIDES:
        for part, after in (("forearm", "hand"), ("shin", "foot"), ("upper_arm", ""), ("thigh", "")):
            role, end = sided(part, side), target_map.first(sided(after, side)) if after else None
            chain = [target.index[name] for name in target_map.bones.get(role, ())]
            beside = [target.index[name] for name in target_map.twist.get(role, ()) if target.parents[target.index[name]] in chain]
            d = direction(target, target_map, role)
            beside.sort(key=lambda b: float((target.head_m[b] - target.head_m[chain[0]]) @ (d if d is not None else np.zeros(3))))
            if d is None or not driven[chain[0]] or (after and (end is None or not driven[target.index[end]])):
                continue
            twist = _twist(target, turned.R, chain[0], d, target.index[end] if end else None)
            if twist is not None:
                _spread(target, R, chain, beside, d, twist, outwards=bool(after), alone=lone_forearms and part == "forearm" and not beside)
                driven[beside] = True
    return Turned(R=follow(target, R, driven), driven=driven)


def _twist(target: Rig, R: np.ndarray, bone: int, d: np.ndarray, end: int | None) -> np.ndarray | None:
    """Twist (T,) [rad] about the part's own axis: of what hangs at its end, or of itself against what it hangs on."""
    a, b = (bone, end) if end is not None else (int(target.parents[bone]), bone)
    if a < 0:
        return None
    relative = transposed(R[:, a]) @ R[:, b] @ (target.R_rest[b].T @ target.R_rest[a])
    return np.unwrap(twist_about(relative, target.R_rest[a].T @ d))


def _spread(
    target: Rig, R: np.ndarray, chain: list[int], beside: list[int], d: np.ndarray, twist: np.ndarray, *, outwards: bool, alone: bool
) -> None:
    """Write into R; `alone`: a lone bone takes half of the twist that comes from its end."""
    before, n, m = R.copy(), len(chain), len(beside)
    if outwards:
        parts = [0.5] if alone and n == 1 else [k / n for k in range(n)]
    else:
        parts = [(k + 1) / n - 1.0 for k in range(n)]
    for b, part in zip(chain, parts):
        R[:, b] = before[:, b] @ about(target.R_rest[b].T @ d, part * twist)
    for k, b in enumerate(beside):
        p, part = target.parents[b], (k + 1) / (m + 1) - (0.0 if outwards else 1.0)
        R[:, b] = before[:, p] @ (target.R_rest[p].T @ target.R_rest[b]) @ about(target.R_rest[b].T @ d, part * twist)


def follow(target: Rig, R: np.ndarray, driven: np.ndarray) -> np.ndarray:
    """R (T, B, 3, 3) with the bones that are not driven at rest against their parents."""
    R = R.copy()
    for b in np.flatnonzero(~driven):
        p = target.parents[b]
        R[:, b] = target.R_rest[b] if p < 0 or not target.inherits_rotation[b] else R[:, p] @ (target.R_rest[p].T @ target.R_rest[b])
    return R
