"""Hands near the body keep their distance from it, and from each other, on a body of other proportions.

    v = p_s − a_s ,   goal = a_t + k v                                                     (1)
    w = 1 − s(|v|) ,  p' = p_t + max w · (Σ w goal / Σ w − p_t)                              (2)

p are the palms and a the anchors (the other palm, head, hips, thighs) in source and target, k the ratio of sizes, s a smooth step from near
to far, so that a hand that moves away comes to follow its arm again. Of two hands that hold each other each gives way by half.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .feet import bend_limb
from .mapping import RigMap
from .rig import Motion, Rig
from .roles import SIDES, sided

NEAR, FAR = 0.35, 0.75  # of the source's arm (upper arm and forearm): fully held, and not at all
ANCHORS = ("head", "hips", "thigh.L", "thigh.R")
OTHER = {"L": "R", "R": "L"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Arm:
    """Bones of one arm of the target, by index."""

    upper: tuple[int, ...]
    fore: tuple[int, ...]
    hand: int


def find_arms(rig: Rig, rig_map: RigMap) -> dict[str, Arm]:
    """The arms of a rig that have upper arm, forearm and hand."""
    arms = {}
    for side in SIDES:
        upper, fore, hand = (
            tuple(rig.index[n] for n in rig_map.bones.get(sided(part, side), ())) for part in ("upper_arm", "forearm", "hand")
        )
        if upper and fore and hand:
            arms[side] = Arm(upper=upper, fore=fore, hand=hand[0])
    return arms


def middle(motion: Motion, rig_map: RigMap, role: str) -> np.ndarray:
    """The middle (T, 3) of a part's first bone."""
    b = motion.rig.index[rig_map.bones[role][0]]
    return motion.head_m[:, b] + motion.R[:, b] @ (motion.rig.R_rest[b].T @ (motion.rig.tail_m[b] - motion.rig.head_m[b]) / 2)


def hold_hands(source: Motion, source_map: RigMap, moved: Motion, target_map: RigMap, scale: float) -> np.ndarray:
    """R (T, B, 3, 3) of the target's motion with the arms bent so that hands keep their distances.  (1), (2)

    `scale` is k. Rigs without a whole arm, or anchors that only one of them has, are left as they are.
    """
    arms, own = find_arms(moved.rig, target_map), find_arms(source.rig, source_map)
    palms = {side: middle(source, source_map, sided("hand", side)) for side in own}
    now = {side: middle(moved, target_map, sided("hand", side)) for side in arms}
    R = np.array(moved.R)
    for side in sorted(set(arms) & set(own)):
        reach = _reach(source.rig, own[side])
        pulls = _pulls(source, source_map, moved, target_map, scale, side, palms, now, reach)
        if not pulls:
            continue
        goals, weights = np.stack([goal for goal, _ in pulls]), np.stack([w for _, w in pulls])
        total = weights.sum(axis=0)
        wanted = np.einsum("at,ati->ti", weights, goals) / np.maximum(total, 1e-9)[:, None]
        off = weights.max(axis=0)[:, None] * (wanted - now[side])
        arm = arms[side]
        if np.abs(off).max() < 1e-6:
            continue
        bent = bend_limb(
            moved.rig, R, arm.upper, arm.fore, arm.hand, moved.head_m[:, arm.upper[0]], moved.head_m[:, arm.hand] + off, _out(moved, arm)
        )
        held = np.flatnonzero(total > 0)
        R[held] = bent[held]
    return R


def _pulls(
    source: Motion,
    source_map: RigMap,
    moved: Motion,
    target_map: RigMap,
    scale: float,
    side: str,
    palms: Mapping[str, np.ndarray],
    now: Mapping[str, np.ndarray],
    reach: float,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Goals (T, 3) of a palm and their weights (T,).  (1)"""
    pulls = []
    for role in ANCHORS:
        if role in source_map.bones and role in target_map.bones:
            away = palms[side] - middle(source, source_map, role)
            pulls.append((middle(moved, target_map, role) + scale * away, _held(away, reach)))
    other = OTHER[side]
    if other in palms and other in now:
        away = palms[side] - palms[other]
        pulls.append(((now[side] + now[other]) / 2 + scale * away / 2, _held(away, reach)))
    return pulls


def _held(away: np.ndarray, reach: float) -> np.ndarray:
    """w (T,) of (2)."""
    x = np.clip((np.linalg.norm(away, axis=1) / reach - NEAR) / (FAR - NEAR), 0.0, 1.0)
    return np.asarray(1.0 - x * x * (3.0 - 2.0 * x))


def _reach(rig: Rig, arm: Arm) -> float:
    elbow = rig.head_m[arm.fore[0]]
    return float(np.linalg.norm(elbow - rig.head_m[arm.upper[0]]) + np.linalg.norm(rig.head_m[arm.hand] - elbow))


def _out(moved: Motion, arm: Arm) -> np.ndarray:
    """Where (T, 3) a straight elbow would bend to: away from the line from shoulder to wrist, or downwards."""
    shoulder, elbow, wrist = (moved.head_m[:, b] for b in (arm.upper[0], arm.fore[0], arm.hand))
    return np.asarray(elbow - (shoulder + wrist) / 2 + np.array([0.0, 0.0, -1e-3]))
