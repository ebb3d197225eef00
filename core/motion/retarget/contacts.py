"""Foot contacts: detected from the motion, with hysteresis, separately for heel (the ankle) and ball (the toe's joint).

A contact of a joint begins when it is both slow and low, and ends when it is clearly faster or higher: two thresholds, so that noise does
not make it flicker. Speeds and heights are those of a person with legs of 0.9 m; other sizes are scaled. The foot is flat while both joints
are in contact and the foot does not turn; a lifting heel rolls about the ball and its contact ends.

Feet that were planted in an editor do not move at all. Their contact is exactly that interval; slow motion before and after is landing and
leaving. So planted feet stay as they are when a motion is retargeted again.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...foundation.settings import knob
from ...geometry.rotation import angle_of, quaternion_from_matrix, unit
from .mapping import RigMap
from .rig import Motion
from .roles import SIDES, sided

LEG_M = 0.9  # length of the legs for which the settings hold
LOW_PERCENTILE = 3.0  # of a joint's heights: its lowest level
LEVEL_PERCENTILE = 15.0  # of the ankles' heights in contacts: their level on the floor
SMOOTH_S = 0.05  # window of the moving average before the speed
ROCKING_DEG = (3.0, 5.0)  # a foot rotated by less from its typical rotation becomes flat; by more, it rolls
STILL_M = 1e-4  # a joint that moves by less was planted; that of a living foot moves by more …
STILL_S = 0.1  # … in this time
STILL_DEG = 0.05  # a foot whose median rotation is less was planted
LEFT_M = 3e-4  # a planted joint that is farther away has left
STEEP = 0.95  # z of a unit vector: a foot bone that is steeper is an importer's guess, without the length of a foot
SAMPLES = 64  # rotations that are compared to find the typical one


@dataclass(frozen=True, kw_only=True)
class FeetSettings:
    """Detection of foot contacts, and foot locking."""

    mode: str = knob("auto", "foot contacts: never, detected, or whenever a foot is low", choices=("off", "auto", "always"))
    land_speed_m_s: float = knob(0.25, "a contact begins below this speed", unit="m/s", low=0.01, high=5.0)
    leave_speed_m_s: float = knob(0.45, "a contact ends above this speed", unit="m/s", low=0.01, high=5.0)
    land_height_m: float = knob(0.05, "a contact begins below this height over the joint's lowest level", unit="m", low=0.0, high=1.0)
    leave_height_m: float = knob(0.08, "a contact ends above this height over the joint's lowest level", unit="m", low=0.0, high=1.0)
    shortest_s: float = knob(0.06, "shorter contacts and shorter gaps are ignored", unit="s", low=0.0, high=1.0)
    blend_s: float = knob(0.15, "time over which a foot lock is blended out", unit="s", low=0.0, high=2.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Contacts:
    """By side: frames (T,) in which the ankle (heel) and the toe's joint (ball) are in contact, and in which the foot is flat; and the
    ankles' level on the floor [m]."""

    ankle: Mapping[str, np.ndarray]
    toe: Mapping[str, np.ndarray]
    flat: Mapping[str, np.ndarray]
    ankle_level_m: float

    @property
    def sides(self) -> tuple[str, ...]:
        """The sides that have a foot."""
        return tuple(self.ankle)


def leg_length(rig_joints: Mapping[str, np.ndarray]) -> float:
    """Length of thigh and shin, from positions of "thigh", "shin" and "foot"."""
    return float(np.linalg.norm(rig_joints["shin"] - rig_joints["thigh"]) + np.linalg.norm(rig_joints["foot"] - rig_joints["shin"]))


def find_contacts(motion: Motion, rig_map: RigMap, settings: FeetSettings, leg_m: float) -> Contacts | None:
    """The contacts of both feet; None if the motion has no legs."""
    ankle, toe, flat, levels = {}, {}, {}, []
    for side in SIDES:
        name = rig_map.first(sided("foot", side))
        if name is None or sided("shin", side) not in rig_map.bones:
            continue
        foot = motion.rig.index[name]
        places, ball = motion.head_m[:, foot], ball_places(motion, rig_map, side)
        heel = stands(places, motion.fps, settings, leg_m / LEG_M)
        toe[side] = heel & False if ball is None else stands(ball, motion.fps, settings, leg_m / LEG_M)
        both = heel & toe[side] if toe[side].any() else heel
        flat[side] = steady(motion.R[:, foot], both)
        ankle[side] = heel & (flat[side] | ~toe[side])
        levels.append(np.percentile(places[heel, 2] if heel.any() else places[:, 2], LEVEL_PERCENTILE))
    return Contacts(ankle=ankle, toe=toe, flat=flat, ankle_level_m=float(np.mean(levels))) if ankle else None


def ball_places(motion: Motion, rig_map: RigMap, side: str) -> np.ndarray | None:
    """The ball of the foot (T, 3): the toe's joint, or the end of a foot without toes."""
    toe, foot = rig_map.first(sided("toe", side)), rig_map.bones[sided("foot", side)][-1]
    if toe is not None:
        return motion.head_m[:, motion.rig.index[toe]]
    b = motion.rig.index[foot]
    along = motion.rig.tail_m[b] - motion.rig.head_m[b]
    if abs(unit(along)[2]) > STEEP:
        return None
    return motion.head_m[:, b] + motion.R[:, b] @ (motion.rig.R_rest[b].T @ along)


def stands(places: np.ndarray, fps: float, settings: FeetSettings, scale: float) -> np.ndarray:
    """Frames (T,) in which a joint at `places` (T, 3) is in contact."""
    from scipy.ndimage import uniform_filter1d

    if settings.mode == "off":
        return np.zeros(len(places), dtype=bool)
    window = max(1, 2 * round(SMOOTH_S * fps / 2) + 1)
    smooth = uniform_filter1d(places, window, axis=0, mode="nearest")
    speed = np.linalg.norm(np.gradient(smooth, axis=0), axis=1) * fps if len(places) > 1 else np.zeros(1)
    height = places[:, 2] - np.percentile(places[:, 2], LOW_PERCENTILE)
    slow, fast = settings.land_speed_m_s * scale, max(settings.leave_speed_m_s, settings.land_speed_m_s) * scale
    if settings.mode == "always":
        slow = fast = np.inf
    low, high = settings.land_height_m * scale, max(settings.leave_height_m, settings.land_height_m) * scale
    on = hysteresis((speed < slow) & (height < low), (speed > fast) | (height > high))
    shortest = settings.shortest_s * fps
    return planted(places, without_short(without_short(on, False, shortest), True, shortest), STILL_S * fps)


def planted(places: np.ndarray, on: np.ndarray, shortest: float) -> np.ndarray:
    """`on` (T,), with contacts in which the joint at `places` (T, 3) is still for `shortest` frames reduced to the part in which it stays
    there."""
    result = on.copy()
    for a, b in runs(on):
        level = places[a:b, :2]  # the ankle rises and sinks as the foot rolls
        still = np.append(np.linalg.norm(np.diff(level, axis=0), axis=1) < STILL_M / max(shortest, 1.0), False)
        if max((last + 1 - first for first, last in runs(still)), default=0) >= max(shortest, 2.0):
            result[a:b] = False
            for first, last in runs(still):
                near = np.linalg.norm(level - level[(first + last) // 2], axis=1) < LEFT_M
                begin, end = next(span for span in runs(near) if span[0] <= first < span[1])
                result[a + begin : a + end] |= last > first + 1
    return result


def steady(R: np.ndarray, on: np.ndarray) -> np.ndarray:
    """Frames (T,) of `on` in which the foot R (T, 3, 3) has the typical rotation of that contact."""
    flat = np.zeros_like(on)
    for a, b in runs(on):
        turned = np.degrees(angle_of(R[a + stance(R[a:b])].T @ R[a:b]))
        little, much = ROCKING_DEG if np.median(turned) > STILL_DEG else (STILL_DEG, STILL_DEG)
        flat[a:b] = hysteresis(turned < little, turned > much)
    return flat


def stance(R: np.ndarray) -> int:
    """The index of the most typical of the rotations (T, 3, 3): the least median angle to the others."""
    some = np.unique(np.linspace(0, len(R) - 1, SAMPLES).round().astype(int))
    q = quaternion_from_matrix(R[some])
    return int(some[np.argmax(np.median(np.abs(q @ q.T), axis=1))])


def hysteresis(begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """True from a frame with `begin` until one with `end`; also back in time from `begin` until one with `end`."""
    on = begin & ~end
    for step in (1, -1):
        state, order = False, range(len(begin))[::step]
        for t in order:
            state = not end[t] and (state or bool(begin[t]))
            on[t] |= state
    return on


def runs(on: np.ndarray) -> list[tuple[int, int]]:
    """Runs [first, last + 1) in which `on` (T,) is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2])]


def without_short(on: np.ndarray, value: bool, shortest: float) -> np.ndarray:
    """`on` with runs of `value` that are shorter than `shortest` frames inverted, except those at the ends."""
    result = on.copy()
    for a, b in runs(on == value):
        if b - a < shortest and a > 0 and b < len(on):
            result[a:b] = not value
    return result
