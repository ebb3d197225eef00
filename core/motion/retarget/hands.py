"""Hands near the body, or near each other, keep their distances on a body of other proportions.

    v = p_s − a_s ,   goal = a_t + k v                                                     (1)
    w = 1 − s(|v|) ,  p' = p_t + max w · (Σ w goal / Σ w − p_t)                              (2)

p are the palms and a the anchors (the other palm, head, hips, thighs) in source and target, k the ratio of sizes, s a smooth step from
NEAR to FAR: a hand that moves away follows its arm again. Of two hands that hold each other, each moves half of the distance.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .feet import Limb, bend_limb
from .mapping import MappedMotion, RigMap
from .rig import Motion, Rig
from .roles import SIDES, sided

NEAR = 0.35  # by the length of the source's arm (upper arm and forearm): nearer hands keep their distance entirely
FAR = 0.75  # farther ones not at all
ANCHORS = ("head", "hips", "thigh.L", "thigh.R")
OTHER = {"L": "R", "R": "L"}
SMALLEST_MOVE_M = 1e-6  # arms that would move by less are left alone
BEND_DOWN_M = 1e-3  # of a straight arm: its elbow bends downwards


def find_arms(rig: Rig, rig_map: RigMap) -> dict[str, Limb]:
    """The arms of a rig that have upper arm, forearm and hand."""
    arms = {}
    for side in SIDES:
        upper, fore, hand = (
            tuple(rig.index[n] for n in rig_map.bones.get(sided(part, side), ())) for part in ("upper_arm", "forearm", "hand")
        )
        if upper and fore and hand:
            arms[side] = Limb(rig=rig, upper=upper, lower=fore, end=hand[0])
    return arms


def middle(motion: Motion, rig_map: RigMap, role: str) -> np.ndarray:
    """The middle (T, 3) of a part's first bone."""
    b = motion.rig.index[rig_map.bones[role][0]]
    return motion.head_m[:, b] + motion.R[:, b] @ (motion.rig.R_rest[b].T @ (motion.rig.tail_m[b] - motion.rig.head_m[b]) / 2)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Hands:
    """A body with its arms and palms by side."""

    body: MappedMotion
    arms: Mapping[str, Limb]
    palm_m: Mapping[str, np.ndarray]  # (T, 3)

    def anchor_m(self, role: str) -> np.ndarray | None:
        """An anchor (T, 3), if the body has that part."""
        return middle(self.body.motion, self.body.map, role) if role in self.body.map.bones else None


def _hands_of(body: MappedMotion) -> _Hands:
    arms = find_arms(body.rig, body.map)
    return _Hands(body=body, arms=arms, palm_m={side: middle(body.motion, body.map, sided("hand", side)) for side in arms})


def keep_hand_distances(source: MappedMotion, target: MappedMotion, scale: float) -> np.ndarray:
    """R (T, B, 3, 3) of the target's motion with the arms bent so that hands keep their distances.  (1), (2)

    `scale` is k. Arms and anchors that only one of the two has are ignored.
    """
    theirs, ours, motion = _hands_of(source), _hands_of(target), target.motion
    R = np.array(motion.R)
    for side in sorted(set(ours.arms) & set(theirs.arms)):
        goals = _goals(theirs, ours, side, scale)
        if not goals:
            continue
        goal_m, weights = np.stack([goal for goal, _ in goals]), np.stack([w for _, w in goals])
        total = weights.sum(axis=0)
        wanted = np.einsum("at,ati->ti", weights, goal_m) / np.maximum(total, 1e-9)[:, None]
        move = weights.max(axis=0)[:, None] * (wanted - ours.palm_m[side])
        arm = ours.arms[side]
        if np.abs(move).max() < SMALLEST_MOVE_M:
            continue
        bent = bend_limb(arm, R, motion.head_m[:, arm.upper[0]], motion.head_m[:, arm.end] + move, _elbow_direction(motion, arm))
        near = np.flatnonzero(total > 0)
        R[near] = bent[near]
    return R


def _goals(source: _Hands, target: _Hands, side: str, scale: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Goals (T, 3) of a palm and their weights (T,).  (1)"""
    goals, palm, arm_m = [], source.palm_m[side], _length(source.arms[side])
    for role in ANCHORS:
        theirs, ours = source.anchor_m(role), target.anchor_m(role)
        if theirs is not None and ours is not None:
            away = palm - theirs
            goals.append((ours + scale * away, _weight(away, arm_m)))
    other = OTHER[side]
    if other in source.palm_m and other in target.palm_m:
        away = palm - source.palm_m[other]
        goals.append(((target.palm_m[side] + target.palm_m[other]) / 2 + scale * away / 2, _weight(away, arm_m)))
    return goals


def _weight(away: np.ndarray, arm_m: float) -> np.ndarray:
    """w (T,) of (2)."""
    x = np.clip((np.linalg.norm(away, axis=1) / arm_m - NEAR) / (FAR - NEAR), 0.0, 1.0)
    return np.asarray(1.0 - x * x * (3.0 - 2.0 * x))


def _length(arm: Limb) -> float:
    head_m = arm.rig.head_m
    elbow = head_m[arm.lower[0]]
    return float(np.linalg.norm(elbow - head_m[arm.upper[0]]) + np.linalg.norm(head_m[arm.end] - elbow))


def _elbow_direction(motion: Motion, arm: Limb) -> np.ndarray:
    """Where (T, 3) the elbow bends to: away from the line from shoulder to wrist, or downwards."""
    shoulder, elbow, wrist = (motion.head_m[:, b] for b in (arm.upper[0], arm.lower[0], arm.end))
    return np.asarray(elbow - (shoulder + wrist) / 2 + np.array([0.0, 0.0, -BEND_DOWN_M]))
