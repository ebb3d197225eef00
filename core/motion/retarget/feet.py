"""Feet on the floor: the body is carried by the feet that stand, and what is left is taken up by hip and knee.

A walk on legs of other proportions keeps its directions only if the body's path changes. So first the path is solved for: a correction
c(t) of the root and a place X_k for every contact k, from

    Σ |r(t) + c(t) + o_f(t) − X_k − s_f(t)|²  +  τ⁴ Σ |c̈(t)|²  +  μ Σ |c(t)|²   →  min                      (1)

with r the root, o_f the ankle seen from it, and s_f how the ankle moves about the standing ball of the foot while the heel lifts. Heights
are given: the lowest point of the sole is on the floor. Then the ankle is brought to its place by two bones of known length   (2), with
the knee in its plane, and let go over a while so that nothing pops. Toes bend where they would go through the floor.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from .contacts import Contacts, FeetSettings, runs
from .mapping import RigMap
from .rig import Rig
from .roles import sided
from .turns import between, rotate, shortest, unit

SMOOTH_S = 0.05  # τ: the body's path does not follow the feet's noise
HOLD = 1e-5  # μ: where nothing stands the path stays as it was
REACH = 0.9995  # a leg is not stretched beyond this part of its length
STRAIGHT = 0.005  # a knee that is out of the line by less of the thigh's length bends forwards


@dataclass(frozen=True, eq=False, kw_only=True)
class Leg:
    """Bones of one leg of the target, by index, and what of its foot touches the floor."""

    side: str
    thigh: tuple[int, ...]
    shin: tuple[int, ...]
    foot: tuple[int, ...]
    toe: tuple[int, ...]
    ball_m: np.ndarray  # (3,) the toe's joint in the rest pose
    sole_m: np.ndarray  # (K, 3) points under the foot, rest pose
    tip_m: np.ndarray  # (J, 3) points under the toes, rest pose


def find_legs(rig: Rig, rig_map: RigMap, floor_m: float) -> dict[str, Leg]:
    """The target's legs that have thigh, shin and foot."""
    legs = {}
    for side in ("L", "R"):
        bones = {part: tuple(rig.index[n] for n in rig_map.bones.get(sided(part, side), ())) for part in ("thigh", "shin", "foot", "toe")}
        if bones["thigh"] and bones["shin"] and bones["foot"]:
            legs[side] = _leg(rig, side, bones, floor_m)
    return legs


def _leg(rig: Rig, side: str, bones: Mapping[str, tuple[int, ...]], floor_m: float) -> Leg:
    foot, toe = bones["foot"][0], bones["toe"]
    ankle = rig.head_m[foot]
    ball = rig.head_m[toe[0]] if toe else rig.tail_m[bones["foot"][-1]]
    if abs(unit(ball - ankle)[2]) > 0.95:
        ball = ankle.copy()
    tip = rig.tail_m[toe[-1]] if toe and unit(rig.tail_m[toe[-1]] - rig.head_m[toe[-1]])[2] < 0.5 else ball
    low = min(ankle[2], ball[2])
    if 0.0 <= low - floor_m < 0.25 * rig.height_m:
        low = floor_m
    skin = [rig.sole_m[rig.names[b]] for b in bones["foot"] if rig.names[b] in rig.sole_m]
    toes = [rig.sole_m[rig.names[b]] for b in toe if rig.names[b] in rig.sole_m]
    under = np.array([1.0, 1.0, 0.0])
    sole = np.concatenate(skin) if skin else np.array([ankle * under, ball * under]) + (0, 0, low)
    tips = np.concatenate(toes) if toes else np.array([tip * under + (0, 0, low)])
    return Leg(side=side, **{k: tuple(v) for k, v in bones.items()}, ball_m=ball, sole_m=sole, tip_m=tips)


def level_feet(since_rest: np.ndarray, flat: np.ndarray, A: np.ndarray) -> np.ndarray:
    """A foot's alignment such that its sole is level when the source's foot stands flat, whatever the source's rest pose.

    `since_rest` (T, 3, 3) of the source's foot, `flat` (T,) when it stands on heel and ball. n = mean of D(t)ᵀ z; A' = shortest(z → n) A.
    """
    if not flat.any():
        return A
    n = unit(np.median(since_rest[flat, 2, :], axis=0))
    return shortest(np.array([0.0, 0.0, 1.0]), n) @ A if n[2] > 0.2 else A


def lock_flat(R: np.ndarray, legs: Mapping[str, Leg], contacts: Contacts, rig: Rig, settings: FeetSettings, fps: float) -> np.ndarray:
    """R with feet that do not rock while they stand flat, and toes that lie while the ball stands."""
    R = R.copy()
    for side, leg in legs.items():
        if side not in contacts.sides:
            continue
        flat = contacts.ankle[side] & (contacts.toe[side] if contacts.toe[side].any() else True)
        for bones, on in ((leg.foot, flat), (leg.toe, contacts.toe[side])):
            for b in bones:
                R[:, b] = _held(R[:, b], rig.R_rest[b], on, settings.blend_s * fps)
    return R


def _held(R: np.ndarray, R_rest: np.ndarray, on: np.ndarray, blend: float) -> np.ndarray:
    """In every stretch the mean heading of a level foot; blended in and out outside of it."""
    held, weight = R.copy(), np.zeros(len(R))
    time = np.arange(len(R))
    for a, b in runs(on):
        middle = R[a + (b - a) // 2] @ R_rest.T
        up = shortest(middle[:, 2], np.array([0.0, 0.0, 1.0]))
        level = up @ middle @ R_rest
        near = fade(np.maximum(np.maximum(a - time, time - b + 1), 0), blend)
        better = near > weight
        held[better], weight[better] = level, near[better]
    return between(R, held, weight)


def fade(distance: np.ndarray, blend: float) -> np.ndarray:
    """1 at distance 0, smoothly 0 from `blend` on."""
    x = np.clip(1.0 - distance / max(blend, 1e-9), 0.0, 1.0)
    return x * x * (3 - 2 * x)


def lowest(leg: Leg, rig: Rig, R: np.ndarray) -> np.ndarray:
    """Height (T,) of the lowest point of foot and toes against the ankle, with R (T, B, 3, 3)."""
    foot, ankle = leg.foot[0], rig.head_m[leg.foot[0]]
    heights = [(leg.sole_m - ankle) @ rig.R_rest[foot] @ np.swapaxes(R[:, foot], 1, 2)]
    if leg.toe:
        toe = leg.toe[0]
        ball = R[:, foot] @ (rig.R_rest[foot].T @ (rig.head_m[toe] - ankle))
        heights.append((leg.tip_m - rig.head_m[toe]) @ rig.R_rest[toe] @ np.swapaxes(R[:, toe], 1, 2) + ball[:, None])
    return np.concatenate(heights, axis=1)[..., 2].min(axis=1)


def about_ball(leg: Leg, rig: Rig, R: np.ndarray, toe: np.ndarray, begin: int, end: int) -> np.ndarray:
    """s_f (end − begin, 3): how the ankle moves in a contact, about the ball where that stands and not at all where only the heel does."""
    foot = leg.foot[0]
    arm = R[begin:end, foot] @ (rig.R_rest[foot].T @ (leg.ball_m - rig.head_m[foot]))
    step = np.zeros_like(arm)
    step[1:] = -np.diff(arm, axis=0) * toe[begin + 1:end, None]
    return np.cumsum(step, axis=0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stand:
    """One contact of one foot: frames [begin, end), and where the ankle is in it (n, 3), up to its place X_k in the plane."""

    side: str
    begin: int
    end: int
    path_m: np.ndarray


def find_stands(legs: Mapping[str, Leg], contacts: Contacts, rig: Rig, R: np.ndarray, floor_m: float) -> list[Stand]:
    """All contacts of both feet; heights of the paths are final: the sole's lowest point is on the floor."""
    stands = []
    for side in (s for s in legs if s in contacts.sides):
        low = lowest(legs[side], rig, R)
        for begin, end in runs(contacts.ankle[side] | contacts.toe[side]):
            path = about_ball(legs[side], rig, R, contacts.toe[side], begin, end)
            path[:, 2] = floor_m - low[begin:end]
            stands.append(Stand(side=side, begin=begin, end=end, path_m=path))
    return stands


def carry_root(stands: list[Stand], ankles: Mapping[str, np.ndarray], fps: float) -> tuple[np.ndarray, np.ndarray]:
    """The root's correction c (T, 3) and the contacts' places X (K, 3; z is 0), from ankles (T, 3) by side.  (1)"""
    t, k = len(next(iter(ankles.values()))), len(stands)
    if not stands:
        return np.zeros((t, 3)), np.zeros((0, 3))
    frame = np.concatenate([np.arange(s.begin, s.end) for s in stands])
    which = np.repeat(np.arange(k), [s.end - s.begin for s in stands])
    misfit = np.concatenate([s.path_m - ankles[s.side][s.begin:s.end] for s in stands])
    rows = np.arange(len(frame))
    at = sparse.csr_matrix((np.ones(len(rows)), (rows, frame)), (len(rows), t))
    place = sparse.csr_matrix((np.ones(len(rows)), (rows, which)), (len(rows), k))
    bend = sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(max(t - 2, 0), t)) * (SMOOTH_S * fps) ** 2
    hold = bend.T @ bend + HOLD * sparse.identity(t)
    heights = spsolve((at.T @ at + hold).tocsc(), at.T @ misfit[:, 2])
    A = sparse.hstack([at, -place])
    N = (A.T @ A + sparse.block_diag([hold, 1e-9 * sparse.identity(k)])).tocsc()
    plane = np.stack([spsolve(N, A.T @ misfit[:, i]) for i in range(2)], axis=1)
    return np.column_stack([plane[:t], heights]), np.column_stack([plane[t:], np.zeros(k)])


def ankle_goals(stands: list[Stand], places: np.ndarray, ankles: Mapping[str, np.ndarray], low: Mapping[str, np.ndarray],
                floor_m: float, blend: float) -> dict[str, np.ndarray]:
    """Where the ankles shall be (T, 3) by side: pinned in contacts, let go over `blend` frames, and never so low that the sole is in
    the floor."""
    goals = {}
    for side, ankle in ankles.items():
        time, total, weights = np.arange(len(ankle)), np.zeros_like(ankle), np.zeros(len(ankle))
        pinned = np.zeros(len(ankle), dtype=bool)
        for stand, place in zip(stands, places):
            if stand.side != side:
                continue
            off = stand.path_m + place - ankle[stand.begin:stand.end]
            nearest = np.clip(time, stand.begin, stand.end - 1)
            weight = fade(np.abs(time - nearest), blend)
            inside = (time >= stand.begin) & (time < stand.end)
            weight[pinned] = 0.0
            total[inside], weights[inside] = 0.0, 0.0
            pinned |= inside
            total += weight[:, None] * off[nearest - stand.begin]
            weights += weight
        goal = ankle + total / np.maximum(weights, 1.0)[:, None]
        goal[:, 2] += np.maximum(floor_m - (goal[:, 2] + low[side]), 0.0)
        goals[side] = goal
    return goals


def bend_leg(leg: Leg, rig: Rig, R: np.ndarray, hip_m: np.ndarray, goal_m: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """R with thigh and shin turned so that the ankle is at goal (T, 3), the hip staying at (T, 3).  (2)

    `forward` (T, 3): where a straight knee would bend to. A goal out of reach is approached as far as the leg is long.
    """
    R = R.copy()
    a, b = leg.thigh[0], leg.shin[0]
    upper = R[:, a] @ (rig.R_rest[a].T @ (rig.head_m[b] - rig.head_m[a]))
    lower = R[:, b] @ (rig.R_rest[b].T @ (rig.head_m[leg.foot[0]] - rig.head_m[b]))
    l1, l2 = np.linalg.norm(upper[0]), np.linalg.norm(lower[0])
    now, then = upper + lower, goal_m - hip_m
    d = np.linalg.norm(then, axis=1)
    d = np.clip(d, abs(l1 - l2) + 1e-6, np.maximum((l1 + l2) * REACH, np.minimum(np.linalg.norm(now, axis=1), l1 + l2)))
    along, before = unit(then), unit(now)
    out = upper - before * np.sum(upper * before, axis=1, keepdims=True)
    ahead = forward - before * np.sum(forward * before, axis=1, keepdims=True)
    lack = np.maximum(STRAIGHT * l1 - np.linalg.norm(out, axis=1), 0.0)
    pole = rotate(shortest(before, along), unit(out + lack[:, None] * unit(ahead)))
    x = (l1**2 - l2**2 + d**2) / (2 * d)
    y = np.sqrt(np.maximum(l1**2 - x**2, 0.0))
    knee = along * x[:, None] + pole * y[:, None]  # (2)
    moved = np.linalg.norm(goal_m - hip_m - now, axis=1) > 1e-9
    for bones, old, new in ((leg.thigh, upper, knee), (leg.shin, lower, along * d[:, None] - knee)):
        turn = shortest(old, new)
        for bone in bones:
            R[moved, bone] = turn[moved] @ R[moved, bone]
    return R
