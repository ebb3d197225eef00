"""Foot locking: feet that stand in the source stand on the target's floor; hip and knee take up what the body's path does not.

A walk on legs of other proportions has the same limb directions only if the body's path changes. So the path is solved for first: a
correction c(t) of the root and a place X_k for every contact k, from

    Σ |r(t) + c(t) + ω(t) × h_f(t) + o_f(t) − X_k − s_f(t)|²  +  Σ (τ⁴ |c̈(t)|² + λ τ² |ċ(t)|² + μ |c(t)|²)  +  likewise for ω   →  min   (1)

with r the root, ω a small rotation of the hips, h_f a hip joint, o_f the ankle relative to the root, and s_f the ankle's motion about the
planted ball of the foot while the heel lifts: feet and toes keep their directions of the source unless they would be in the floor.
Heights are given: the lowest point of the sole is on the floor. The norm counts angles: a displacement e of the ankle turns a leg of
length d by e/d across it, but along it, with the knee bent by φ, it turns each of its two bones by e·d/(2 l₁ l₂ sin φ)  (2). The rest is
taken up by two-bone inverse kinematics (3), with the knee in its plane, and blended out before and after a contact.

A foot that already stands is not moved, so that a motion survives retargeting to another rig and back: rotations of the foot are kept as
small as possible, since a foot is short, and 10 mm at the ankle are 4° of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...geometry.rotation import cross_matrix, matrix_from_vector, rotate, shortest, unit, vector_from_matrix
from .contacts import Contacts, FeetSettings, runs, stance
from .mapping import RigMap
from .rig import Rig
from .roles import sided
from .transfer import stood_up

if TYPE_CHECKING:
    from scipy import sparse

SMOOTH_S = 0.05  # τ [s]: time constant that keeps the feet's noise out of the body's path
LEVEL = 0.1  # λ: damps the velocity of the correction, so that it stays in the air what it was on the ground
HOLD = 1e-5  # μ: pulls the correction to zero where no foot stands
TILT = 0.2  # weight of a rotation of the hips relative to one of a leg
RAISED = 0.006  # by leg length: a swinging foot that is in the floor by less is raised, not turned
BENT = np.radians(8.0)  # [rad] least bend of a knee that (2) assumes
REACH = 0.9995  # by leg length: a leg is not stretched further
STRAIGHT = 0.005  # by thigh length: a knee that is out of line by less bends forwards
UPRIGHT = 0.95  # z of a unit vector: a foot that is steeper has no heading
FLAT_TOE = 0.5  # z of a unit vector: a toe bone that is steeper does not end at the tip of the toes
FLOOR_GAP = 0.25  # by height of the rig: a foot that is higher over the floor in the rest pose keeps its own level
LEVEL_SOLE = 0.2  # z of the sole's mean normal: below it the foot does not stand flat, and its alignment stays
MEDIAN_STEPS = 60  # Weiszfeld iterations
BISECTIONS = 12  # of the fraction of a turn: 1/4096 of it


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Limb:
    """Two segments of a rig, an upper and a lower one of one or more bones each, and the bone at their end; bones by index."""

    rig: Rig
    upper: tuple[int, ...]
    lower: tuple[int, ...]
    end: int


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Leg:
    """One leg of the target on its floor: bones by index, and the points of its foot that touch the floor."""

    rig: Rig  # that stands in its rest pose
    floor_m: float  # height of the floor
    side: str
    thigh: tuple[int, ...]
    shin: tuple[int, ...]
    foot: tuple[int, ...]
    toe: tuple[int, ...]
    ball_m: np.ndarray  # (3,) the toe's joint in the rest pose
    ankle_m: float  # height of the ankle over the sole in the rest pose
    sole_m: np.ndarray  # (K, 3) points under the foot, rest pose
    tip_m: np.ndarray  # (J, 3) points under the toes, rest pose

    @property
    def limb(self) -> Limb:
        """Thigh and shin, down to the foot."""
        return Limb(rig=self.rig, upper=self.thigh, lower=self.shin, end=self.foot[0])


def find_legs(rig: Rig, rig_map: RigMap, floor_m: float) -> dict[str, Leg]:
    """The target's legs that have thigh, shin and foot, of its rig as it stands (`stood_up`), `floor_m` being the floor under it."""
    legs, rig = {}, stood_up(rig, rig_map)
    for side in ("L", "R"):
        bones = {part: tuple(rig.index[n] for n in rig_map.bones.get(sided(part, side), ())) for part in ("thigh", "shin", "foot", "toe")}
        if bones["thigh"] and bones["shin"] and bones["foot"]:
            legs[side] = _leg(rig, side, bones, floor_m)
    return legs


def _leg(rig: Rig, side: str, bones: Mapping[str, tuple[int, ...]], floor_m: float) -> Leg:
    foot, toe = bones["foot"][0], bones["toe"]
    ankle = rig.head_m[foot]
    ball = rig.head_m[toe[0]] if toe else rig.tail_m[bones["foot"][-1]]
    if abs(unit(ball - ankle)[2]) > UPRIGHT:
        ball = ankle.copy()
    tip = rig.tail_m[toe[-1]] if toe and unit(rig.tail_m[toe[-1]] - rig.head_m[toe[-1]])[2] < FLAT_TOE else ball
    low = min(ankle[2], ball[2])
    if 0.0 <= low - floor_m < FLOOR_GAP * rig.height_m:
        low = floor_m
    skin = [rig.sole_m[rig.names[b]] for b in bones["foot"] if rig.names[b] in rig.sole_m]
    toes = [rig.sole_m[rig.names[b]] for b in toe if rig.names[b] in rig.sole_m]
    under = np.array([1.0, 1.0, 0.0])
    sole = np.concatenate(skin) if skin else np.array([ankle * under, ball * under]) + (0, 0, low)
    tips = np.concatenate(toes) if toes else np.array([tip * under + (0, 0, low)])
    return Leg(
        rig=rig,
        floor_m=floor_m,
        side=side,
        **{k: tuple(v) for k, v in bones.items()},
        ball_m=ball,
        ankle_m=float(ankle[2] - sole[:, 2].min()),
        sole_m=sole,
        tip_m=tips,
    )


def level_feet(since_rest: np.ndarray, flat: np.ndarray, A: np.ndarray) -> np.ndarray:
    """A foot's alignment such that its sole is level when the source's foot stands flat, whatever the source's rest pose.

    `since_rest` (T, 3, 3) of the source's foot, `flat` (T,) when it stands on heel and ball. n = median of D(t)ᵀ z; A' = shortest(z → n) A.
    """
    if not flat.any():
        return A
    n = unit(_geometric_median(since_rest[flat, 2, :]))
    return shortest(np.array([0.0, 0.0, 1.0]), n) @ A if n[2] > LEVEL_SOLE else A


def _geometric_median(points: np.ndarray) -> np.ndarray:
    """The point with the least sum of distances to the points (n, 3); it is equivariant to rotations (Weiszfeld 1937)."""
    middle = np.asarray(points.mean(axis=0))
    for _ in range(MEDIAN_STEPS):
        weight = 1.0 / np.maximum(np.linalg.norm(points - middle, axis=1), 1e-9)
        middle = weight @ points / weight.sum()
    return middle


def lock_flat(R: np.ndarray, legs: Mapping[str, Leg], contacts: Contacts, settings: FeetSettings, fps: float) -> np.ndarray:
    """R with feet that do not rock while they stand flat, and toes that lie flat while the ball stands."""
    R = R.copy()
    for side, leg in legs.items():
        if side not in contacts.sides:
            continue
        for bones, on in ((leg.foot, contacts.flat[side]), (leg.toe, contacts.toe[side])):
            for b in bones:
                R[:, b] = _locked(R[:, b], leg.rig.R_rest[b], runs(on), settings.blend_s * fps)
    return R


def _locked(R: np.ndarray, R_rest: np.ndarray, spans: list[tuple[int, int]], blend: float) -> np.ndarray:
    """R in every contact replaced by its most typical rotation, levelled; the change is blended out before and after."""
    vectors = np.zeros((len(R), 3))
    for k, (a, b) in enumerate(spans):
        middle = R[a + stance(R[a:b])] @ R_rest.T
        level = shortest(middle[:, 2], np.array([0.0, 0.0, 1.0])) @ middle @ R_rest
        vectors += blended_out(vector_from_matrix(level @ np.swapaxes(R[a:b], 1, 2)), spans, k, len(R), blend)
    return matrix_from_vector(vectors) @ R


def blended_out(values: np.ndarray, spans: list[tuple[int, int]], k: int, frames: int, blend: float) -> np.ndarray:
    """`values` (n, …) of span k of `spans` over all frames (T, …): before and after it they fade to zero within `blend` frames, or until
    the next span begins."""
    a, b = spans[k]
    time, nearest = np.arange(frames), np.clip(np.arange(frames), a, b - 1)
    before = a - spans[k - 1][1] + 1 if k else blend
    after = spans[k + 1][0] - b + 1 if k + 1 < len(spans) else blend
    weight = fade(np.abs(time - nearest), np.where(time < a, min(before, blend), min(after, blend)))
    return weight.reshape(-1, *(1,) * (values.ndim - 1)) * values[nearest - a]


def fade(distance: np.ndarray, blend: float | np.ndarray) -> np.ndarray:
    """1 at distance 0, smoothly 0 from `blend` on."""
    x = np.clip(1.0 - distance / np.maximum(blend, 1e-9), 0.0, 1.0)
    return x * x * (3 - 2 * x)


def lowest(leg: Leg, R: np.ndarray) -> np.ndarray:
    """Height (T,) of the lowest point of foot and toes relative to the ankle, with R (T, B, 3, 3)."""
    rig, foot, ankle = leg.rig, leg.foot[0], leg.rig.head_m[leg.foot[0]]
    heights = [(leg.sole_m - ankle) @ rig.R_rest[foot] @ np.swapaxes(R[:, foot], 1, 2)]
    if leg.toe:
        toe = leg.toe[0]
        ball = R[:, foot] @ (rig.R_rest[foot].T @ (rig.head_m[toe] - ankle))
        heights.append((leg.tip_m - rig.head_m[toe]) @ rig.R_rest[toe] @ np.swapaxes(R[:, toe], 1, 2) + ball[:, None])
    return np.concatenate(heights, axis=1)[..., 2].min(axis=1)


def _ankle_to_ball(leg: Leg, R: np.ndarray) -> np.ndarray:
    """From the ankle to the ball (T, 3)."""
    return R[:, leg.foot[0]] @ (leg.rig.R_rest[leg.foot[0]].T @ (leg.ball_m - leg.rig.head_m[leg.foot[0]]))


def about_ball(leg: Leg, R: np.ndarray, toe: np.ndarray, begin: int, end: int) -> np.ndarray:
    """s_f (end − begin, 3): the ankle's motion in a contact: about the ball where that stands, none where only the heel does."""
    arm = _ankle_to_ball(leg, R)[begin:end]
    step = np.zeros_like(arm)
    step[1:] = -np.diff(arm, axis=0) * (toe[begin : end - 1] & toe[begin + 1 : end])[:, None]
    return np.cumsum(step, axis=0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stand:
    """One contact of one foot: frames [begin, end), and the ankle's path (n, 3) in it relative to its place X_k."""

    side: str
    begin: int
    end: int
    path_m: np.ndarray


def find_stands(legs: Mapping[str, Leg], contacts: Contacts, R: np.ndarray) -> list[Stand]:
    """All contacts of both feet. Heights of the paths are final: the sole's lowest point is on the floor."""
    stands = []
    for side in (s for s in legs if s in contacts.sides):
        low = lowest(legs[side], R)
        for begin, end in runs(contacts.ankle[side] | contacts.toe[side]):
            path = about_ball(legs[side], R, contacts.toe[side], begin, end)
            path[:, 2] = legs[side].floor_m - low[begin:end]
            stands.append(Stand(side=side, begin=begin, end=end, path_m=path))
    return stands


def stiffness(leg: Leg, R: np.ndarray) -> np.ndarray:
    """W^½ (T, 3, 3): how much a displacement of the ankle changes the leg's directions (rad × leg length).  (2)"""
    rig = leg.rig
    upper = R[:, leg.thigh[0]] @ (rig.R_rest[leg.thigh[0]].T @ (rig.head_m[leg.shin[0]] - rig.head_m[leg.thigh[0]]))
    lower = R[:, leg.shin[0]] @ (rig.R_rest[leg.shin[0]].T @ (rig.head_m[leg.foot[0]] - rig.head_m[leg.shin[0]]))
    area = np.linalg.norm(np.cross(upper, lower), axis=1)  # l₁ l₂ sin φ
    along, reach = unit(upper + lower), np.linalg.norm(upper + lower, axis=1)
    least = np.sin(BENT) * np.linalg.norm(upper[0]) * np.linalg.norm(lower[0])
    k = np.maximum(reach**2 / (2.0 * np.maximum(area, least)), 1.0)
    return np.eye(3) + (k - 1.0)[:, None, None] * along[:, :, None] * along[:, None, :]


def carry_root(
    stands: list[Stand],
    ankles: Mapping[str, np.ndarray],
    hips: Mapping[str, np.ndarray],
    stiff: Mapping[str, np.ndarray],
    fps: float,
    leg_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corrections of the root: shift c (T, 3), rotation ω (T, 3) [rad], and the contacts' places X (K, 3; z is 0).  (1)

    By side: ankles (T, 3), hip joints relative to the middle of the hips (T, 3), and W^½ (T, 3, 3).
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    t, k = len(next(iter(ankles.values()))), len(stands)
    if not stands:
        return np.zeros((t, 3)), np.zeros((t, 3)), np.zeros((0, 3))
    frame = np.concatenate([np.arange(s.begin, s.end) for s in stands])
    which = np.repeat(np.arange(k), [s.end - s.begin for s in stands])
    W = np.concatenate([stiff[s.side][s.begin : s.end] for s in stands])  # (n, 3, 3)
    misfit = np.concatenate([s.path_m - ankles[s.side][s.begin : s.end] for s in stands])
    lever = W @ -cross_matrix(np.concatenate([hips[s.side][s.begin : s.end] for s in stands]))  # ω × h = −[h]× ω
    A = sparse.hstack(
        [
            _placed(np.concatenate([W, lever], axis=2), 6 * frame[:, None] + np.arange(6), 6 * t),  # c and ω by frame
            _placed(-W[:, :, :2], 2 * which[:, None] + np.arange(2), 2 * k),
        ]
    )
    smooth = _roughness(t, 2) * (SMOOTH_S * fps) ** 4 + _roughness(t, 1) * LEVEL * (SMOOTH_S * fps) ** 2
    shifts, turns = np.diag([1.0] * 3 + [0.0] * 3), np.diag([0.0] * 3 + [1.0] * 3) * (TILT * leg_m) ** 2
    hold = sparse.kron(smooth + HOLD * sparse.identity(t), shifts) + sparse.kron(smooth + sparse.identity(t), turns)
    normal = (A.T @ A + sparse.block_diag([hold, 1e-9 * sparse.identity(2 * k)])).tocsc()
    solved = splu(normal, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})  # a band with a border
    x = solved.solve(A.T @ np.einsum("nij,nj->ni", W, misfit).ravel())
    frames = x[: 6 * t].reshape(t, 6)
    return frames[:, :3], frames[:, 3:], np.column_stack([x[6 * t :].reshape(k, 2), np.zeros(k)])


def _placed(blocks: np.ndarray, columns: np.ndarray, width: int) -> "sparse.csr_matrix":
    """Blocks (n, 3, m), one below the other, at their columns (n, m)."""
    from scipy import sparse

    n, _, m = blocks.shape
    rows = np.broadcast_to(np.arange(3 * n).reshape(n, 3, 1), blocks.shape)
    return sparse.csr_matrix((blocks.ravel(), (rows.ravel(), np.broadcast_to(columns[:, None, :], blocks.shape).ravel())), (3 * n, width))


def _roughness(t: int, order: int) -> "sparse.csr_matrix":
    """M (t, t): xᵀ M x is the sum of the squared differences of first or second order of x; zero for too few frames."""
    from scipy import sparse

    if t < order + 1:
        return sparse.csr_matrix((t, t))
    bend = sparse.diags([[-1.0, 1.0], [1.0, -2.0, 1.0]][order - 1], list(range(order + 1)), shape=(t - order, t))
    return (bend.T @ bend).tocsr()


def step_over(leg: Leg, R: np.ndarray, ankle: np.ndarray, least_m: float, swinging: np.ndarray) -> np.ndarray:
    """R with a swinging foot's toes straightened, then the foot levelled, where its sole would be lower than `least_m`, by no more than
    it takes."""
    rig, foot = leg.rig, leg.foot[0]
    if leg.toe:
        toe = leg.toe[0]
        straight = R[:, foot] @ (rig.R_rest[foot].T @ rig.R_rest[toe]) @ np.swapaxes(R[:, toe], 1, 2)
        R = _raised(leg, R, leg.toe, vector_from_matrix(straight), ankle, least_m, swinging)
    level = shortest((R[:, foot] @ rig.R_rest[foot].T)[:, :, 2], np.array([0.0, 0.0, 1.0]))
    return _raised(leg, R, (*leg.foot, *leg.toe), vector_from_matrix(level), ankle, least_m, swinging)


def _raised(
    leg: Leg, R: np.ndarray, bones: tuple[int, ...], turn: np.ndarray, ankle: np.ndarray, least_m: float, swinging: np.ndarray
) -> np.ndarray:
    """R with `bones` turned by the least fraction of the Rodrigues vectors `turn` (T, 3) that raises the sole to `least_m`, found by
    bisection; unchanged in frames where the turn lowers the sole."""
    before = ankle[:, 2] + lowest(leg, R) - least_m
    some = np.flatnonzero(swinging & (before < 0.0))
    some = some[(ankle[:, 2] + lowest(leg, _turned(R, bones, turn)) - least_m)[some] > before[some]]
    if not len(some):
        return R
    little, much = np.zeros(len(some)), np.ones(len(some))
    for _ in range(BISECTIONS):
        part = (little + much) / 2
        clear = ankle[some, 2] + lowest(leg, _turned(R[some], bones, turn[some] * part[:, None])) >= least_m
        little, much = np.where(clear, little, part), np.where(clear, part, much)
    R = R.copy()
    R[some] = _turned(R[some], bones, turn[some] * much[:, None])
    return R


def _turned(R: np.ndarray, bones: tuple[int, ...], vector: np.ndarray) -> np.ndarray:
    R, turn = R.copy(), matrix_from_vector(vector)
    for bone in bones:
        R[:, bone] = turn @ R[:, bone]
    return R


def ankle_goals(
    leg: Leg, R: np.ndarray, stands: list[Stand], places: np.ndarray, ankle: np.ndarray, blend: float
) -> tuple[np.ndarray, np.ndarray]:
    """The ankle's goal (T, 3), and R with swinging feet turned where they must be. The goal is planted in contacts, returns to `ankle`
    (T, 3) over `blend` frames, and is never so low that the sole is in the floor."""
    own = [(stand, place) for stand, place in zip(stands, places) if stand.side == leg.side]
    goal, swinging = ankle.copy(), np.ones(len(ankle), dtype=bool)
    for k, (stand, place) in enumerate(own):
        pull = stand.path_m + place - ankle[stand.begin : stand.end]
        goal += blended_out(pull, [(s.begin, s.end) for s, _ in own], k, len(ankle), blend)
        swinging[stand.begin : stand.end] = False
    leg_m = float(np.linalg.norm(leg.rig.head_m[leg.thigh[0]] - leg.rig.head_m[leg.foot[0]]))
    R = step_over(leg, R, goal, leg.floor_m - RAISED * leg_m, swinging)
    goal[:, 2] += np.maximum(leg.floor_m - goal[:, 2] - lowest(leg, R), 0.0)
    return goal, R


def bend_limb(limb: Limb, R: np.ndarray, root_m: np.ndarray, goal_m: np.ndarray, bend_towards: np.ndarray) -> np.ndarray:
    """R with a leg's or an arm's two segments turned so that its end is at goal (T, 3), its root staying at (T, 3).  (3)

    `bend_towards` (T, 3): the direction in which a straight knee or elbow would bend. A goal out of reach is approached as far as the limb
    is long.
    """
    R, rig = R.copy(), limb.rig
    a, b = limb.upper[0], limb.lower[0]
    upper = R[:, a] @ (rig.R_rest[a].T @ (rig.head_m[b] - rig.head_m[a]))
    lower = R[:, b] @ (rig.R_rest[b].T @ (rig.head_m[limb.end] - rig.head_m[b]))
    l1, l2 = np.linalg.norm(upper[0]), np.linalg.norm(lower[0])
    now, then = upper + lower, goal_m - root_m
    d = np.linalg.norm(then, axis=1)
    d = np.clip(d, abs(l1 - l2) + 1e-6, np.maximum((l1 + l2) * REACH, np.minimum(np.linalg.norm(now, axis=1), l1 + l2)))
    along, before = unit(then), unit(now)
    out = upper - before * np.sum(upper * before, axis=1, keepdims=True)
    ahead = bend_towards - before * np.sum(bend_towards * before, axis=1, keepdims=True)
    lack = np.maximum(STRAIGHT * l1 - np.linalg.norm(out, axis=1), 0.0)
    pole = rotate(shortest(before, along), unit(out + lack[:, None] * unit(ahead)))
    x = (l1**2 - l2**2 + d**2) / (2 * d)
    y = np.sqrt(np.maximum(l1**2 - x**2, 0.0))
    joint = along * x[:, None] + pole * y[:, None]  # (3)
    moved = np.linalg.norm(goal_m - root_m - now, axis=1) > 1e-9
    for bones, old, new in ((limb.upper, upper, joint), (limb.lower, lower, along * d[:, None] - joint)):
        turn = shortest(old, new)
        for bone in bones:
            R[moved, bone] = turn[moved] @ R[moved, bone]
    return R
