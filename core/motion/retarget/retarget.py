"""Retargeting as a whole: the motion of a source onto a target rig.

mapping (both) → contacts (source) → rotations (transfer) → root, scaled by the legs → feet → pose channels
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from ...foundation.errors import InputError
from ...foundation.progress import Monitor
from ...foundation.settings import knob
from ...geometry.rotation import matrix_from_vector, unit
from . import feet
from .contacts import Contacts, FeetSettings, find_contacts
from .hands import keep_hand_distances
from .mapping import MappedMotion, MappedRig, RigMap
from .residual_motion import STATES, ResidualMotion
from .rest_pose import TargetPose, hip_centre, loose_parts, with_person_like_rest
from .restore import lacking, planting_turns, turned_by, with_residual
from .rig import Motion, Rig, channels, head_of
from .roles import SEGMENTS, SIDES, sided
from .transfer import alignments, body_axes, share_twist, turn, with_offsets

SHORTEST_LIMB_M = 1e-4
LYING = 0.3  # height of the head over the hips by their distance: a lower median means that the source lies
STEPS = 4
BESIDE_M = 1.0  # a target that would begin in the source begins so far beside it
PARTS_NAMED = 4  # in a sentence


@dataclass(frozen=True, kw_only=True)
class RetargetSettings:
    """What is transferred of the motion."""

    root: str = knob("travel", "how the body travels: like the source, on the spot, or not at all", choices=("travel", "in place", "still"))
    scale: float = knob(0.0, "size of the target's steps relative to the source's; 0: by the length of the legs", low=0.0, high=1000.0)
    hands: str = knob(
        "free",
        "hands follow their arms, or keep their distances from each other, head, hips and thighs when near",
        choices=("free", "keep"),
    )
    twist: str = knob(
        "bones",
        "spread the twist of limbs over twist bones; “forearms”: a forearm without any takes half of its hand's",
        choices=("off", "bones", "forearms"),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Retargeted:
    """The target's motion with its residual, its pose channels, and how it was computed."""

    motion: Motion
    basis: np.ndarray  # (T, B, 3, 3) pose channels
    shift_m: np.ndarray  # (T, 3) of the carrier's head relative to its parent's motion, in the world
    carrier: int  # the bone whose location channels carry the body; −1 for none
    loose_m: Mapping[int, np.ndarray]  # by bone, the same (T, 3) for parts that do not descend from the body
    driven: np.ndarray  # (B,) bones that get keys
    scale: float
    roles: tuple[str, ...]
    contacts: Contacts | None
    notes: tuple[str, ...]
    removed_travel_m: np.ndarray  # (T, 3) of the body's path, when it moves on the spot

    @property
    def travelling(self) -> Motion:
        """The target's motion with the travel that was removed."""
        return replace(self.motion, head_m=self.motion.head_m + self.removed_travel_m[:, None])


def begun_at_rest(result: Retargeted, source: MappedMotion | None = None) -> Retargeted:
    """The motion moved over the floor so that the body begins where it stands at rest; where that is in the `source`, beside it. A motion
    without a carrier stays as it is."""
    if result.carrier < 0:
        return result
    known = np.flatnonzero(np.isfinite(result.shift_m).all(axis=1))
    aside_m = result.shift_m[known[0]] * (1.0, 1.0, 0.0) if len(known) else np.zeros(3)
    hips = source.map.first("hips") if source is not None else None
    if source is not None and hips is not None and len(known):
        begins_m = result.motion.head_m[known[0], result.carrier] - aside_m
        aside_m = aside_m - _beside_m(begins_m, source.motion.head_m[known, source.motion.rig.index[hips]])
    return replace(
        result,
        motion=replace(result.motion, head_m=result.motion.head_m - aside_m),
        shift_m=result.shift_m - aside_m,
        loose_m={bone: shift - aside_m for bone, shift in result.loose_m.items()},
    )


def _beside_m(begins_m: np.ndarray, path_m: np.ndarray) -> np.ndarray:
    """By how much a body that begins at a place is moved (3,), so that it does not begin in another one, whose path (T, 3) is given: across
    that path, or along x where there is none."""
    if np.linalg.norm((begins_m - path_m[0])[:2]) >= BESIDE_M / 2:
        return np.zeros(3)
    x, y, _ = path_m[-1] - path_m[0]
    length = float(np.hypot(x, y))
    across = np.array([y, -x, 0.0]) / length if length > BESIDE_M / 2 else np.array([1.0, 0.0, 0.0])
    return BESIDE_M * across


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Match:
    """Source and target, and what connects them."""

    source: MappedMotion
    target: MappedRig
    aligned: Mapping[str, np.ndarray]  # A (3, 3) by role
    scale: float  # size of the target relative to the source
    contacts: Contacts | None  # of the source's feet
    legs: Mapping[str, feet.Leg]  # of the target, by side
    floor_m: float  # under the target

    @property
    def ankle_level_m(self) -> float:
        """Height of the ankles of a target that stands."""
        return self.floor_m + (float(np.mean([leg.ankle_m for leg in self.legs.values()])) if self.legs else 0.0)


def retarget(
    source: MappedMotion,
    target: MappedRig,
    settings: RetargetSettings | None = None,
    feet_settings: FeetSettings | None = None,
    monitor: Monitor | None = None,
    floor_m: float = 0.0,
) -> Retargeted:
    """The motion of `source` on the rig `target`; `floor_m` is the floor's height under the target.

    Raises:
        InputError: source and target have no part in common, or limbs have no length.
        Cancelled: the monitor was cancelled.
    """
    settings, feet_settings, monitor = settings or RetargetSettings(), feet_settings or FeetSettings(), monitor or Monitor()
    monitor.step("retargeting", 0, STEPS)
    source, contacts = with_residual(source, feet_settings)
    source, rest_note = with_person_like_rest(source)
    match = _matched(source, target, contacts, settings.scale, feet_settings, floor_m)
    monitor.step("retargeting", 1, STEPS)
    untwisted = turned = turn(source, target, match.aligned)
    if settings.twist != "off":
        turned = share_twist(target, turned, lone_forearms=settings.twist == "forearms")
    carrier = _carrier(target) if "hips" in match.aligned and settings.root != "still" else -1
    free = TargetPose(target=target, R=turned.R, driven=turned.driven, carrier=carrier, shift_m=np.zeros((len(turned.R), 3)))
    monitor.step("retargeting", 2, STEPS)
    pose, planting_shift_m = _grounded(match, free, feet_settings)
    in_place = settings.root == "in place"
    residual = _residual(match, free, pose, planting_shift_m * (0.0, 0.0, 1.0) if in_place else planting_shift_m, feet_settings)
    if settings.twist == "forearms":
        residual = replace(residual, forearm_twists=_lone_forearm_twists(target, untwisted.R, free.R))
    monitor.step("retargeting", 3, STEPS)
    removed_m = (pose.shift_m - pose.shift_m[0]) * (1.0 if in_place else 0.0, 1.0 if in_place else 0.0, 0.0)
    pose = pose.moved(pose.shift_m - removed_m)
    if settings.hands == "keep":
        pose = pose.turned(keep_hand_distances(source, MappedMotion(motion=_motion(source.motion, pose), map=target.map), match.scale))
    notes = (*source.motion.notes, *filter(None, [rest_note, lying_note(source)]), *_notes(match))
    monitor.step("retargeting", STEPS, STEPS)
    return _result(match, pose, removed_m, residual, notes)


def _matched(
    source: MappedMotion, target: MappedRig, contacts: Contacts | None, scale: float, settings: FeetSettings, floor_m: float
) -> _Match:
    """What connects source and target; contacts are found unless they are known, the scale unless it is given."""
    for mapped, which in ((source.mapped_rig, "source"), (target, "target")):
        _check_lengths(mapped, which)
    aligned = alignments(source.mapped_rig, target)
    if not aligned:
        raise InputError(nothing_in_common(source.map, target.map))
    scale = scale or leg_ratio(source.mapped_rig, target)
    leg_m = _leg_m(source.rig, source.map) or source.rig.height_m / 2
    contacts = contacts or find_contacts(source.motion, source.map, settings, leg_m)
    legs = feet.find_legs(target.rig, target.map, floor_m) if "hips" in aligned else {}
    if contacts is not None:
        aligned = aligned | _level(source, aligned, contacts)
    aligned = with_offsets(aligned, target)
    return _Match(source=source, target=target, aligned=aligned, scale=scale, contacts=contacts, legs=legs, floor_m=floor_m)


def nothing_in_common(source: RigMap, target: RigMap) -> str:
    """A sentence that names the parts of two rigs that share none."""

    return (
        f"Source and target have no part of the body in common: the source has {_parts(source)}, the target {_parts(target)}. "
        "Choose another source, or correct the mapping."
    )


def _parts(rig_map: RigMap) -> str:
    return ", ".join([*rig_map.bones][:PARTS_NAMED]) + (" …" if len(rig_map.bones) > PARTS_NAMED else "")


def _motion(source: Motion, pose: TargetPose, residual: ResidualMotion | None = None) -> Motion:
    return Motion(rig=pose.target.rig, fps=source.fps, frames=source.frames, R=pose.R, head_m=pose.head_m, residual=residual)


def _residual(match: _Match, free: TargetPose, planted: TargetPose, planting_shift_m: np.ndarray, settings: FeetSettings) -> ResidualMotion:
    """What the target cannot show of the source's motion; `free` and `planted` are its poses without and with foot contacts."""
    known = match.contacts is not None and match.legs
    return ResidualMotion(
        frames=match.source.motion.frames,
        planting_turns=planting_turns(match.target, free.R, planted.R),
        planting_shift_m=planting_shift_m,
        forearm_twists={},
        contact_settings=asdict(settings),
        contacts={state: getattr(match.contacts, state) if known else {} for state in STATES},
        ankle_level_m=match.ankle_level_m,
        chains=lacking(match.source, match.target, match.aligned, free.R),
    )


def _result(match: _Match, pose: TargetPose, removed_m: np.ndarray, residual: ResidualMotion, notes: tuple[str, ...]) -> Retargeted:
    target, motion = match.target, _motion(match.source.motion, pose, residual)
    loose = [b for b in loose_parts(target.rig, target.map) if pose.driven[b] and b != pose.carrier]
    return Retargeted(
        motion=motion,
        basis=channels(target.rig, pose.R),
        shift_m=pose.shift_m,
        carrier=pose.carrier,
        loose_m={b: motion.head_m[:, b] - head_of(target.rig, pose.R, motion.head_m, b) for b in loose},
        driven=pose.driven,
        scale=match.scale,
        roles=tuple(match.aligned),
        contacts=match.contacts,
        notes=notes,
        removed_travel_m=removed_m,
    )


def _lone_forearm_twists(target: MappedRig, before: np.ndarray, after: np.ndarray) -> dict[str, np.ndarray]:
    """By role the twist of forearms without twist bones, which cannot be recovered from the rig."""
    return {
        role: turned_by(role, target, before, after)
        for role in (sided("forearm", side) for side in SIDES)
        if len(target.map.bones.get(role, ())) == 1 and role not in target.map.twist
    }


def _notes(match: _Match) -> tuple[str, ...]:
    lost = [role for role in match.source.map.bones if role not in match.target.map.bones and "." not in role[:-2]]
    notes = [f"the target has no {', '.join(lost)}: their parents take up the motion"] if lost else []
    if "hips" not in match.aligned:
        which, rig_map = ("target", match.target.map) if "hips" in match.source.map.bones else ("source", match.source.map)
        notes.append(f"the body does not travel: the {which} has no hips, only {_parts(rig_map)}")
    return tuple(notes)


def lying_note(source: MappedMotion) -> str:
    """A sentence if the trunk lies in most frames: so does a file whose up axis was misread."""
    rig, head_m = source.rig, source.motion.head_m
    low, high = (source.map.first(role) for role in ("hips", "head"))
    if low is None or high is None:
        return ""
    up = unit(head_m[:, rig.index[high]] - head_m[:, rig.index[low]])[:, 2]
    return "" if np.median(up) > LYING else "the source lies, or stands on its head; if it should not, choose which axis is up"


def _head(rig: Rig, rig_map: RigMap, part: str, side: str) -> np.ndarray | None:
    name = rig_map.first(sided(part, side))
    return rig.head_m[rig.index[name]] if name else None


def _leg_m(rig: Rig, rig_map: RigMap) -> float:
    """Mean length of thigh and shin; 0 without legs."""
    lengths = []
    for side in SIDES:
        a, b, c = (_head(rig, rig_map, part, side) for part in ("thigh", "shin", "foot"))
        if a is not None and b is not None and c is not None:
            lengths.append(np.linalg.norm(b - a) + np.linalg.norm(c - b))
    return float(np.mean(lengths)) if lengths else 0.0


def leg_ratio(source: MappedRig, target: MappedRig) -> float:
    """The target's size relative to the source's: of the legs if both have some, else of the heights.

    Raises:
        InputError: the legs have no length.
    """
    own, other = _leg_m(source.rig, source.map), _leg_m(target.rig, target.map)
    if own > SHORTEST_LIMB_M and other > SHORTEST_LIMB_M:
        return other / own
    if {"thigh.L", "thigh.R"} & set(source.map.bones) & set(target.map.bones) and min(own, other) <= SHORTEST_LIMB_M:
        raise InputError("The legs of the source or the target have no length; correct the rig's rest pose, or set the scale.")
    heights = source.rig.height_m, target.rig.height_m
    return heights[1] / heights[0] if min(heights) > SHORTEST_LIMB_M else 1.0


def _level(source: MappedMotion, aligned: Mapping[str, np.ndarray], contacts: Contacts) -> dict[str, np.ndarray]:
    """Alignments of the feet and toes that are level when the source's are."""
    level, motion, rig = {}, source.motion, source.rig
    for side in contacts.sides:
        for part in ("foot", "toe"):
            role = sided(part, side)
            if role in aligned:
                b = rig.index[source.map.bones[role][-1]]
                level[role] = feet.level_feet(motion.R[:, b] @ rig.R_rest[b].T, contacts.flat[side], aligned[role])
    return level


def _carrier(target: MappedRig) -> int:
    """The bone that can carry the body: the hips, or the first ancestor that is not connected to its parent."""
    rig = target.rig
    bone = rig.index[target.map.bones["hips"][0]]
    while rig.connected[bone] and rig.parents[bone] >= 0:
        bone = int(rig.parents[bone])
    return bone


def _check_lengths(mapped: MappedRig, which: str) -> None:
    rig = mapped.rig
    for side in SIDES:
        for part, after in SEGMENTS:
            a, b = _head(rig, mapped.map, part, side), _head(rig, mapped.map, after, side)
            if a is not None and b is not None and np.linalg.norm(b - a) < SHORTEST_LIMB_M * max(rig.height_m, 1e-9):
                name = mapped.map.first(sided(part, side))
                raise InputError(f"The bone “{name}” of the {which} has no length; correct the rig's rest pose or map another bone.")


def _grounded(match: _Match, pose: TargetPose, settings: FeetSettings) -> tuple[TargetPose, np.ndarray]:
    """The pose with feet on the floor, and the part of the carrier's shift that plants them (T, 3)."""
    contacts, legs, fps = match.contacts, match.legs, match.source.motion.fps
    if pose.carrier < 0:
        return pose, pose.shift_m
    planting = contacts is not None and settings.mode != "off" and bool(legs)
    if planting and contacts is not None:
        pose = pose.turned(feet.lock_flat(pose.R, legs, contacts, settings, fps))
    path = _travel(match)
    unplanted_m = np.zeros((len(pose.R), 3))
    pose = pose.moved(path - pose.hips_m)
    if not planting or contacts is None:
        return pose, unplanted_m
    heads, R = pose.head_m, pose.R
    stands = feet.find_stands(legs, contacts, R)
    moved, tilt, places = feet.carry_root(
        stands,
        {side: heads[:, leg.foot[0]] for side, leg in legs.items()},
        {side: heads[:, leg.thigh[0]] - path for side, leg in legs.items()},
        {side: feet.stiffness(leg, R) for side, leg in legs.items()},
        fps,
        _leg_m(match.target.rig, match.target.map),
    )
    pose = _tilted(pose, tilt, path + moved)
    return _planted(pose, legs, stands, places, settings.blend_s * fps), moved


def _tilted(pose: TargetPose, tilt: np.ndarray, middle: np.ndarray) -> TargetPose:
    """The hips turned by the Rodrigues vectors `tilt` (T, 3), the middle between the hip joints at `middle` (T, 3)."""
    R, target = pose.R.copy(), pose.target
    for name in target.map.bones["hips"]:
        R[:, target.rig.index[name]] = matrix_from_vector(tilt) @ R[:, target.rig.index[name]]
    pose = pose.turned(R)
    return pose.moved(pose.shift_m + middle - pose.hips_m)


def _travel(match: _Match) -> np.ndarray:
    """The path of the middle of the hips (T, 3): the source's, scaled, with the ankles' levels on the floor as the origin of height."""
    source, target, scale = match.source, match.target, match.scale
    path = hip_centre(source.motion, source.map)
    if match.contacts is None or not match.legs:
        rest_s = source.rig.head_m[source.rig.index[source.map.bones["hips"][0]]]
        rest_t = target.rig.head_m[target.rig.index[target.map.bones["hips"][0]]]
        return rest_t + scale * (path - rest_s)
    return scale * (path - (0.0, 0.0, match.contacts.ankle_level_m)) + (0.0, 0.0, match.ankle_level_m)


def _planted(pose: TargetPose, legs: Mapping[str, feet.Leg], stands: list[feet.Stand], places: np.ndarray, blend: float) -> TargetPose:
    """The pose with the legs bent so that feet in contact are at their places."""
    rig, R, heads = pose.target.rig, pose.R, pose.head_m
    front = -body_axes(rig, pose.target.map)[:, 1]
    for leg in legs.values():
        thigh = leg.thigh[0]
        goal, R = feet.ankle_goals(leg, R, stands, places, heads[:, leg.foot[0]], blend)
        forward = R[:, thigh] @ (rig.R_rest[thigh].T @ front)
        R = feet.bend_limb(leg.limb, R, heads[:, thigh], goal, forward)
    return pose.turned(R)
