"""Feet on the floor: the body is carried by the feet that stand, and what is left is taken up by hip and knee.

A walk on legs of other proportions keeps its directions only if the body's path changes. So first the path is solved for: a correction
c(t) of the root and a place X_k for every contact k, from

    Σ |r(t) + c(t) + ω(t) × h_f(t) + o_f(t) − X_k − s_f(t)|²  +  τ⁴ Σ |c̈(t)|²  +  μ Σ |c(t)|²  +  the like of ω   →  min      (1)

with r the root, ω a small turn of the hips, h_f a hip joint, o_f the ankle seen from the root, and s_f how the ankle moves about the
standing ball of the foot while the heel lifts. Heights are given: the lowest point of the sole is on the floor. The norm counts angles:
a displacement e of the ankle turns a leg of length d by e/d across it, but along it, with the knee bent by φ, each of its two bones
by e·d/(2 l₁ l₂ sin φ)  (4). Of a foot whose heel is lifted mostly the distance from the ball counts, since it can turn: its ankle goes to
the point next to where the leg has it on the sphere about the standing ball,

    a' = B + |a − B|_rest · unit(a − B)                                                                          (2)

and the foot turns with it. What is left is taken up by two bones of known length (3), with the knee in its plane, and let go over a
while so that nothing pops.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from ...geometry.rotation import cross_matrix
from .contacts import Contacts, FeetSettings, runs
from .mapping import RigMap
from .rig import Rig
from .roles import sided
from .turns import about, between, matrix_from_vector, rotate, shortest, unit, vector_from_matrix

SMOOTH_S = 0.05  # τ: the body's path does not follow the feet's noise
HOLD = 1e-5  # μ: where nothing stands the path stays as it was
GIVE = 0.4  # how much counts what a lifted foot can yield to by turning
TILT = 0.2  # a turn of the hips counts as much less than one of a leg
BENT = np.radians(8.0)  # a knee is taken to be bent at least as much in (4)
NEAR = 0.8  # an ankle nearer to the ball than this part of the foot does not tell the foot's direction
ROLL_M = 0.002  # the ball of a foot that rolls over its toes goes forward by at most this
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
    end_m: np.ndarray  # (3,) the foremost of them


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
    return Leg(side=side, **{k: tuple(v) for k, v in bones.items()}, ball_m=ball, sole_m=sole, tip_m=tips,
               end_m=tips[np.argmax((tips - ankle) @ (unit((ball - ankle) * under)))])


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


def _arm(leg: Leg, rig: Rig, R: np.ndarray) -> np.ndarray:
    """From the ankle to the ball (T, 3)."""
    return R[:, leg.foot[0]] @ (rig.R_rest[leg.foot[0]].T @ (leg.ball_m - rig.head_m[leg.foot[0]]))


def about_ball(leg: Leg, rig: Rig, R: np.ndarray, toe: np.ndarray, begin: int, end: int) -> np.ndarray:
    """s_f (end − begin, 3): how the ankle moves in a contact, about the ball where that stands and not at all where only the heel does."""
    arm = _arm(leg, rig, R)[begin:end]
    step = np.zeros_like(arm)
    step[1:] = -np.diff(arm, axis=0) * toe[begin + 1:end, None]
    return np.cumsum(step, axis=0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stand:
    """One contact of one foot: frames [begin, end), and where the ankle is in it (n, 3), up to its place X_k in the plane; in which
    frames (n,) only the ball stands."""

    side: str
    begin: int
    end: int
    path_m: np.ndarray
    lifted: np.ndarray
    arm_m: np.ndarray  # (n, 3) from the ankle to the ball


def find_stands(legs: Mapping[str, Leg], contacts: Contacts, rig: Rig, R: np.ndarray, floor_m: float) -> list[Stand]:
    """All contacts of both feet; heights of the paths are final: the sole's lowest point is on the floor."""
    stands = []
    for side in (s for s in legs if s in contacts.sides):
        low = lowest(legs[side], rig, R)
        for begin, end in runs(contacts.ankle[side] | contacts.toe[side]):
            path = about_ball(legs[side], rig, R, contacts.toe[side], begin, end)
            path[:, 2] = floor_m - low[begin:end]
            lifted = ~contacts.ankle[side][begin:end] & bool(np.linalg.norm(legs[side].ball_m - rig.head_m[legs[side].foot[0]]) > 1e-4)
            stands.append(Stand(side=side, begin=begin, end=end, path_m=path, lifted=lifted, arm_m=_arm(legs[side], rig, R)[begin:end]))
    return stands


def stiffness(leg: Leg, rig: Rig, R: np.ndarray) -> np.ndarray:
    """W^½ (T, 3, 3): by how much the leg's directions suffer (rad × leg length) from a displacement of the ankle.  (4)"""
    upper = R[:, leg.thigh[0]] @ (rig.R_rest[leg.thigh[0]].T @ (rig.head_m[leg.shin[0]] - rig.head_m[leg.thigh[0]]))
    lower = R[:, leg.shin[0]] @ (rig.R_rest[leg.shin[0]].T @ (rig.head_m[leg.foot[0]] - rig.head_m[leg.shin[0]]))
    area = np.linalg.norm(np.cross(upper, lower), axis=1)  # l₁ l₂ sin φ
    along, reach = unit(upper + lower), np.linalg.norm(upper + lower, axis=1)
    least = np.sin(BENT) * np.linalg.norm(upper[0]) * np.linalg.norm(lower[0])
    k = np.maximum(reach**2 / (2.0 * np.maximum(area, least)), 1.0)
    return np.eye(3) + (k - 1.0)[:, None, None] * along[:, :, None] * along[:, None, :]


def carry_root(stands: list[Stand], ankles: Mapping[str, np.ndarray], hips: Mapping[str, np.ndarray], stiff: Mapping[str, np.ndarray],
               fps: float, leg_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corrections of the root: shift c (T, 3), turn ω (T, 3) [rad], and the contacts' places X (K, 3; z is 0).  (1)

    By side: ankles (T, 3), hip joints against the middle of the hips (T, 3), and W^½ (T, 3, 3).
    """
    t, k = len(next(iter(ankles.values()))), len(stands)
    if not stands:
        return np.zeros((t, 3)), np.zeros((t, 3)), np.zeros((0, 3))
    frame = np.concatenate([np.arange(s.begin, s.end) for s in stands])
    which = np.repeat(np.arange(k), [s.end - s.begin for s in stands])
    W = np.concatenate([_say(s) @ stiff[s.side][s.begin:s.end] for s in stands])  # (n, 3, 3)
    misfit = np.concatenate([s.path_m - ankles[s.side][s.begin:s.end] for s in stands])
    n = len(frame)
    row = np.broadcast_to((3 * np.arange(n)[:, None] + np.arange(3))[:, :, None], W.shape)
    column = np.broadcast_to((3 * frame[:, None] + np.arange(3))[:, None, :], W.shape)
    at = sparse.csr_matrix((W.ravel(), (row.ravel(), column.ravel())), (3 * n, 3 * t))
    column = np.broadcast_to((2 * which[:, None] + np.arange(2))[:, None, :], (n, 3, 2))
    place = sparse.csr_matrix((W[:, :, :2].ravel(), (row[:, :, :2].ravel(), column.ravel())), (3 * n, 2 * k))
    lever = W @ -cross_matrix(np.concatenate([hips[s.side][s.begin:s.end] for s in stands]))  # ω × h = −[h]× ω
    column = np.broadcast_to((3 * frame[:, None] + np.arange(3))[:, None, :], W.shape)
    turning = sparse.csr_matrix((lever.ravel(), (row.ravel(), column.ravel())), (3 * n, 3 * t))
    smooth = _roughness(t) * (SMOOTH_S * fps) ** 4
    own = (TILT * leg_m) ** 2
    hold = [sparse.kron(smooth + HOLD * sparse.identity(t), sparse.identity(3)),
            sparse.kron(own * (smooth + sparse.identity(t)), sparse.identity(3)), 1e-9 * sparse.identity(2 * k)]
    A = sparse.hstack([at, turning, -place])
    x = spsolve((A.T @ A + sparse.block_diag(hold)).tocsc(), A.T @ np.einsum("nij,nj->ni", W, misfit).ravel())
    return x[:3 * t].reshape(t, 3), x[3 * t:6 * t].reshape(t, 3), np.column_stack([x[6 * t:].reshape(k, 2), np.zeros(k)])


def _roughness(t: int) -> sparse.csr_matrix:
    """(t, t): xᵀ M x is the sum of the squared second differences of x; nothing bends in fewer than three frames."""
    if t < 3:
        return sparse.csr_matrix((t, t))
    bend = sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(t - 2, t))
    return (bend.T @ bend).tocsr()


def _say(stand: Stand) -> np.ndarray:
    """(n, 3, 3): all of a firm foot counts; of a lifted one what changes its distance from the ball, since it can turn."""
    n = unit(stand.arm_m)
    along = n[:, :, None] * n[:, None, :]
    return np.where(stand.lifted[:, None, None], along + GIVE * (np.eye(3) - along), np.eye(3))


def plant(leg: Leg, rig: Rig, R: np.ndarray, stand: Stand, place: np.ndarray, ankle: np.ndarray, floor_m: float, blend: float
          ) -> tuple[np.ndarray, np.ndarray]:
    """Ankle (n, 3), and R (n, B, 3, 3) with foot and toes turned, in a contact; `ankle` (T, 3): where the leg has it.  (2)"""
    own, foot = R[stand.begin:stand.end].copy(), leg.foot[0]
    pinned, free = stand.path_m + place, ankle[stand.begin:stand.end]
    if not stand.lifted.any():
        return pinned, own
    firm = np.flatnonzero(~stand.lifted)
    if len(firm):  # what a flat foot lacked is let go while the heel lifts
        time = np.arange(len(own))
        nearest = firm[np.abs(time[:, None] - firm).argmin(axis=1)]
        free = free + fade(np.abs(time - nearest), blend)[:, None] * (pinned - free)[nearest]
    arm = _arm(leg, rig, own)
    ball, length = pinned + arm, float(np.linalg.norm(arm[0]))
    level = np.where(stand.lifted, (rig.head_m[foot][2] - leg.ball_m[2]) / length, -1.0)
    for _ in range(3):
        goal = ball + length * _away(ball, free, arm, level)  # (2)
        own[:, foot] = shortest(arm, ball - goal) @ R[stand.begin:stand.end, foot]
        ball[stand.lifted, 2] += (floor_m - goal[:, 2] - lowest(leg, rig, own))[stand.lifted]
    if leg.toe:
        ball = _over_the_tip(leg, rig, own, ball, free, length)
    goal = ball + length * _away(ball, free, arm, level)
    own[:, foot] = shortest(arm, ball - goal) @ R[stand.begin:stand.end, foot]
    return goal, own


def _away(ball: np.ndarray, free: np.ndarray, arm: np.ndarray, level: np.ndarray) -> np.ndarray:
    """From the ball towards the ankle (n, 3), unit vectors; if that is too near the ball to tell, as the foot was. Their height is at
    least `level`, that of a foot that stands flat: a lifted heel is not pressed into the floor."""
    lack = np.maximum(NEAR * np.linalg.norm(arm, axis=1) - np.linalg.norm(free - ball, axis=1), 0.0)
    up = unit(free - ball - lack[:, None] * unit(arm))
    least = np.maximum(up[:, 2], level)
    flat = np.sqrt(1.0 - least**2) / np.maximum(np.linalg.norm(up[:, :2], axis=1), 1e-9)
    return np.column_stack([up[:, :2] * flat[:, None], least])


def _over_the_tip(leg: Leg, rig: Rig, own: np.ndarray, ball: np.ndarray, free: np.ndarray, length: float) -> np.ndarray:
    """The ball (n, 3), raised about the tip of the toes where the foot is too short to reach the ankle; turns the toes in `own`.

    It goes forward thereby, by no more than ROLL_M.
    """
    toe = leg.toe[0]
    back = -own[:, toe] @ (rig.R_rest[toe].T @ (leg.end_m - rig.head_m[toe]))
    lack = np.linalg.norm(free - ball, axis=1) - length
    size, toward = np.linalg.norm(back, axis=1), unit(free - ball)
    axis = unit(np.cross(back, np.broadcast_to((0.0, 0.0, 1.0), back.shape)))
    lift = np.sum(np.cross(axis, back) * toward, axis=1)  # how far the ball comes nearer per radian
    steep = np.arctan2(back[:, 2], np.linalg.norm(back[:, :2], axis=1))
    most = np.maximum(np.arccos(np.clip(np.cos(steep) - ROLL_M / np.maximum(size, ROLL_M), -1.0, 1.0)) - np.maximum(steep, 0.0), 0.0)
    angle = np.clip(lack / np.maximum(lift, 0.1 * size), 0.0, most) * np.clip(5.0 * lift / size - 0.5, 0.0, 1.0)
    turn = about(axis, angle)
    own[:, toe] = turn @ own[:, toe]
    return ball - back + rotate(turn, back)


def step_over(leg: Leg, rig: Rig, R: np.ndarray, ankle: np.ndarray, floor_m: float, swinging: np.ndarray) -> np.ndarray:
    """R with a swinging foot's toes held straighter, then the foot more level, where they would go through the floor, by no more than
    it takes."""
    foot = leg.foot[0]
    if leg.toe:
        toe = leg.toe[0]
        straight = R[:, foot] @ (rig.R_rest[foot].T @ rig.R_rest[toe]) @ np.swapaxes(R[:, toe], 1, 2)
        R = _eased(leg, rig, R, leg.toe, vector_from_matrix(straight), ankle, floor_m, swinging)
    level = shortest((R[:, foot] @ rig.R_rest[foot].T)[:, :, 2], np.array([0.0, 0.0, 1.0]))
    return _eased(leg, rig, R, (*leg.foot, *leg.toe), vector_from_matrix(level), ankle, floor_m, swinging)


def _eased(leg: Leg, rig: Rig, R: np.ndarray, bones: tuple[int, ...], turn: np.ndarray, ankle: np.ndarray, floor_m: float,
           swinging: np.ndarray) -> np.ndarray:
    """R with `bones` turned by the least part of the Rodrigues vectors `turn` (T, 3) that clears the floor; not if that is no help."""
    before = ankle[:, 2] + lowest(leg, rig, R) - floor_m
    some = np.flatnonzero(swinging & (before < 0.0))
    some = some[(ankle[:, 2] + lowest(leg, rig, _turned(R, bones, turn)) - floor_m)[some] > before[some]]
    if not len(some):
        return R
    little, much = np.zeros(len(some)), np.ones(len(some))
    for _ in range(12):
        part = (little + much) / 2
        clear = ankle[some, 2] + lowest(leg, rig, _turned(R[some], bones, turn[some] * part[:, None])) >= floor_m
        little, much = np.where(clear, little, part), np.where(clear, part, much)
    R = R.copy()
    R[some] = _turned(R[some], bones, turn[some] * much[:, None])
    return R


def _turned(R: np.ndarray, bones: tuple[int, ...], vector: np.ndarray) -> np.ndarray:
    R, turn = R.copy(), matrix_from_vector(vector)
    for bone in bones:
        R[:, bone] = turn @ R[:, bone]
    return R


def ankle_goals(leg: Leg, rig: Rig, R: np.ndarray, stands: list[Stand], places: np.ndarray, ankle: np.ndarray, floor_m: float,
                blend: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the ankle shall be (T, 3), and R with the foot turned: planted in contacts, let go over `blend` frames, and never so low
    that the sole is in the floor. `ankle` (T, 3): where the leg has it."""
    time, moving = np.arange(len(ankle)), (*leg.foot, *leg.toe)
    off, turn, weight = np.zeros_like(ankle), np.zeros((len(ankle), len(moving), 3)), np.zeros(len(ankle))
    for stand, place in zip(stands, places):
        if stand.side != leg.side:
            continue
        goal, own = plant(leg, rig, R, stand, place, ankle, floor_m, blend / 2)
        nearest = np.clip(time, stand.begin, stand.end - 1)
        near = fade(np.abs(time - nearest), blend)
        closer, there = near > weight, nearest - stand.begin
        turned = vector_from_matrix((own @ np.swapaxes(R[stand.begin:stand.end], 2, 3))[:, moving])
        off[closer] = (near[:, None] * (goal - ankle[stand.begin:stand.end])[there])[closer]
        turn[closer] = (near[:, None, None] * turned[there])[closer]
        weight = np.maximum(weight, near)
    R, goal = R.copy(), ankle + off
    R[:, moving] = matrix_from_vector(turn) @ R[:, moving]
    R = step_over(leg, rig, R, goal, floor_m, weight < 1.0)
    goal[:, 2] += np.maximum(floor_m - goal[:, 2] - lowest(leg, rig, R), 0.0)
    return goal, R


def bend_limb(rig: Rig, R: np.ndarray, thigh: tuple[int, ...], shin: tuple[int, ...], foot: int, hip_m: np.ndarray, goal_m: np.ndarray,
              forward: np.ndarray) -> np.ndarray:
    """R with thigh and shin (or the bones of an arm) turned so that the ankle is at goal (T, 3), the hip staying at (T, 3).  (3)

    `forward` (T, 3): where a straight knee would bend to. A goal out of reach is approached as far as the leg is long.
    """
    R = R.copy()
    a, b = thigh[0], shin[0]
    upper = R[:, a] @ (rig.R_rest[a].T @ (rig.head_m[b] - rig.head_m[a]))
    lower = R[:, b] @ (rig.R_rest[b].T @ (rig.head_m[foot] - rig.head_m[b]))
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
    knee = along * x[:, None] + pole * y[:, None]  # (3)
    moved = np.linalg.norm(goal_m - hip_m - now, axis=1) > 1e-9
    for bones, old, new in ((thigh, upper, knee), (shin, lower, along * d[:, None] - knee)):
        turn = shortest(old, new)
        for bone in bones:
            R[moved, bone] = turn[moved] @ R[moved, bone]
    return R
