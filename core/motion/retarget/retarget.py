"""Retargeting as a whole: the motion of a source onto a target rig.

mapping (both) → contacts (source) → rotations (transfer) → root, scaled by the legs → feet → pose channels
"""

from collections.abc import Container, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from ...errors import InputError
from ...progress import Monitor
from ...settings import knob
from . import feet
from .contacts import Contacts, FeetSettings, find_contacts
from .hands import hold_hands
from .mapping import RigMap
from .places import heads_of, hip_centre, loose_parts
from .rest import with_person_like_rest
from .restore import held_turns, lacking, restored, turned_by
from .rig import Motion, Rig, channels, head_of
from .roles import SEGMENTS, SIDES, sided
from .transfer import alignments, body_axes, follow, share_twist, turn
from .turns import matrix_from_vector, unit
from .unshown import STATES, Unshown

SHORTEST_LIMB_M = 1e-4
LYING = 0.3  # height of the head over the hips, per distance


@dataclass(frozen=True, kw_only=True)
class RetargetSettings:
    """What of the motion is taken over."""

    root: str = knob(
        "travel", "how the body moves through the room: as the source, on the spot, or not at all", choices=("travel", "in place", "still")
    )
    scale: float = knob(0.0, "size of the target's steps against the source's; 0: by the length of the legs", low=0.0, high=1000.0)
    hands: str = knob(
        "free",
        "hands follow their arms, or keep their distance from each other, head, hips and thighs where they are near",
        choices=("free", "keep"),
    )
    twist: str = knob(
        "bones",
        "spread the twist of the limbs over twist bones, or half of a hand's also over a forearm that has none",
        choices=("off", "bones", "forearms"),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Retargeted:
    """The target's motion, with what it does not show of the source's; its pose channels, and how it came about."""

    motion: Motion
    basis: np.ndarray  # (T, B, 3, 3) pose channels
    shift_m: np.ndarray  # (T, 3) of the carrier's head against where its parent leaves it, in the world
    carrier: int  # the bone whose location channels carry the body; −1 for none
    loose_m: Mapping[int, np.ndarray]  # by bone, the like (T, 3) of parts that do not hang on the body
    driven: np.ndarray  # (B,) bones that get keys
    scale: float
    roles: tuple[str, ...]
    contacts: Contacts | None
    notes: tuple[str, ...]
    kept_back_m: np.ndarray  # (T, 3) of the body's path, when it moves on the spot

    @property
    def travelling(self) -> Motion:
        """The target's motion as it would go through the room."""
        return replace(self.motion, head_m=self.motion.head_m + self.kept_back_m[:, None])


def retarget(
    source: Motion,
    source_map: RigMap,
    target: Rig,
    target_map: RigMap,
    settings: RetargetSettings | None = None,
    feet_settings: FeetSettings | None = None,
    monitor: Monitor | None = None,
    floor_m: float = 0.0,
) -> Retargeted:
    """The motion of `source` on the rig `target`; `floor_m` is the floor's height under the target.

    Raises:
        InputError: nothing is common to both, or limbs have no length.
        Cancelled: the monitor was cancelled.
    """
    settings, feet_settings, monitor = settings or RetargetSettings(), feet_settings or FeetSettings(), monitor or Monitor()
    monitor.step("retargeting", 0, 4)
    source, source_map, known = restored(source, source_map, feet_settings)
    source, rest_note = with_person_like_rest(source, source_map)
    for rig, rig_map, which in ((source.rig, source_map, "source"), (target, target_map, "target")):
        _check_lengths(rig, rig_map, which)
    aligned = alignments(source.rig, source_map, target, target_map)
    if not aligned:
        raise InputError("Source and target have no part of the body in common; check the two mappings.")
    scale = settings.scale or leg_ratio(source.rig, source_map, target, target_map)
    contacts = known or find_contacts(source, source_map, feet_settings, _leg_m(source.rig, source_map) or source.rig.height_m / 2)
    legs = feet.find_legs(target, target_map, floor_m) if "hips" in aligned else {}
    if contacts is not None:
        aligned = aligned | _level(source, source_map, aligned, contacts)
    untwisted = turned = turn(source, source_map, target, target_map, aligned)
    monitor.step("retargeting", 1, 4)
    if settings.twist != "off":
        turned = share_twist(target, target_map, turned, lone_forearms=settings.twist == "forearms")
    free, driven = turned.R, turned.driven
    travels, carrier = settings.root != "in place", _carrier(target, target_map) if "hips" in aligned and settings.root != "still" else -1
    monitor.step("retargeting", 2, 4)
    R, shift, moved_m = _grounded(
        source, source_map, target, target_map, free, driven, carrier, scale, legs, contacts, feet_settings, floor_m
    )
    unshown = Unshown(
        frames=source.frames,
        held=held_turns(target, target_map, free, R),
        moved_m=moved_m if travels else moved_m * (0.0, 0.0, 1.0),
        twisted=_twisted(target, target_map, untwisted.R, free) if settings.twist == "forearms" else {},
        feet=asdict(feet_settings),
        stands={state: getattr(contacts, state) if contacts is not None and legs else {} for state in STATES},
        level_m=floor_m + _ankle_level(legs),
        chains=lacking(source, source_map, target, target_map, aligned, free),
    )
    monitor.step("retargeting", 3, 4)
    kept_back_m = (shift - shift[0]) * (0.0 if travels else 1.0, 0.0 if travels else 1.0, 0.0)
    shift = shift - kept_back_m
    head = heads_of(target, R, carrier, shift, target_map)
    if settings.hands == "keep":
        held = Motion(rig=target, fps=source.fps, frames=source.frames, R=R, head_m=head)
        R = follow(target, hold_hands(source, source_map, held, target_map, scale), driven)
        head = heads_of(target, R, carrier, shift, target_map)
    moved = Motion(rig=target, fps=source.fps, frames=source.frames, R=R, head_m=head, unshown=unshown)
    notes = (*source.notes, *filter(None, [rest_note, lies(source, source_map)]), *_notes(source_map, target_map, aligned))
    monitor.step("retargeting", 4, 4)
    loose = {b: head[:, b] - head_of(target, R, head, b) for b in loose_parts(target, target_map) if driven[b] and b != carrier}
    return Retargeted(
        motion=moved,
        basis=channels(target, R),
        shift_m=shift,
        carrier=carrier,
        loose_m=loose,
        driven=driven,
        scale=scale,
        roles=tuple(aligned),
        contacts=contacts,
        notes=notes,
        kept_back_m=kept_back_m,
    )


def _twisted(target: Rig, target_map: RigMap, before: np.ndarray, after: np.ndarray) -> dict[str, np.ndarray]:
    """By role how lone forearms were twisted, which cannot be read from them."""
    return {
        role: turned_by(role, target, target_map, before, after)
        for role in (sided("forearm", side) for side in SIDES)
        if len(target_map.bones.get(role, ())) == 1 and role not in target_map.twist
    }


def _ankle_level(legs: Mapping[str, feet.Leg]) -> float:
    """Height of the ankles over the soles in the rest pose."""
    return float(np.mean([leg.ankle_m for leg in legs.values()])) if legs else 0.0


def _notes(source_map: RigMap, target_map: RigMap, common: Container[str]) -> tuple[str, ...]:
    lost = [role for role in source_map.bones if role not in target_map.bones and "." not in role[:-2]]
    notes = [f"the target has no {', '.join(lost)}: their parents take it up"] if lost else []
    return (*notes, *([] if "hips" in common else ["the body does not travel: no hips in common"]))


def lies(motion: Motion, rig_map: RigMap) -> str:
    """A sentence if the trunk lies in most frames: a file with another axis up than was taken does so."""
    low, high = (rig_map.first(role) for role in ("hips", "head"))
    if low is None or high is None:
        return ""
    up = unit(motion.head_m[:, motion.rig.index[high]] - motion.head_m[:, motion.rig.index[low]])[:, 2]
    return "" if np.median(up) > LYING else "the source lies, or stands on its head; if it should not, say which axis is up"


def _place(rig: Rig, rig_map: RigMap, part: str, side: str) -> np.ndarray | None:
    name = rig_map.first(sided(part, side))
    return rig.head_m[rig.index[name]] if name else None


def _leg_m(rig: Rig, rig_map: RigMap) -> float:
    """Mean length of thigh and shin; 0 without legs."""
    lengths = []
    for side in SIDES:
        a, b, c = (_place(rig, rig_map, part, side) for part in ("thigh", "shin", "foot"))
        if a is not None and b is not None and c is not None:
            lengths.append(np.linalg.norm(b - a) + np.linalg.norm(c - b))
    return float(np.mean(lengths)) if lengths else 0.0


def leg_ratio(source: Rig, source_map: RigMap, target: Rig, target_map: RigMap) -> float:
    """The target's size against the source's: of the legs if both have some, else of the heights.

    Raises:
        InputError: the legs have no length.
    """
    own, other = _leg_m(source, source_map), _leg_m(target, target_map)
    if own > SHORTEST_LIMB_M and other > SHORTEST_LIMB_M:
        return other / own
    if {"thigh.L", "thigh.R"} & set(source_map.bones) & set(target_map.bones) and min(own, other) <= SHORTEST_LIMB_M:
        raise InputError("The legs of the source or the target have no length; mend the rig's rest pose, or set the scale.")
    return target.height_m / source.height_m if min(source.height_m, target.height_m) > SHORTEST_LIMB_M else 1.0


def _level(source: Motion, source_map: RigMap, aligned: Mapping[str, np.ndarray], contacts: Contacts) -> dict[str, np.ndarray]:
    """Alignments of the feet and toes that stand level when the source's do."""
    level = {}
    for side in contacts.sides:
        for part in ("foot", "toe"):
            role = sided(part, side)
            if role in aligned:
                b = source.rig.index[source_map.bones[role][-1]]
                level[role] = feet.level_feet(source.R[:, b] @ source.rig.R_rest[b].T, contacts.flat[side], aligned[role])
    return level


def _carrier(target: Rig, target_map: RigMap) -> int:
    """The bone that can carry the body: the hips, or what they hang on if they are connected to it."""
    bone = target.index[target_map.bones["hips"][0]]
    while target.connected[bone] and target.parents[bone] >= 0:
        bone = int(target.parents[bone])
    return bone


def _check_lengths(rig: Rig, rig_map: RigMap, which: str) -> None:
    for side in SIDES:
        for part, after in SEGMENTS:
            a, b = _place(rig, rig_map, part, side), _place(rig, rig_map, after, side)
            if a is not None and b is not None and np.linalg.norm(b - a) < SHORTEST_LIMB_M * max(rig.height_m, 1e-9):
                name = rig_map.first(sided(part, side))
                raise InputError(f"The bone “{name}” of the {which} has no length; mend the rig's rest pose or map another bone.")


def _grounded(
    source: Motion,
    source_map: RigMap,
    target: Rig,
    target_map: RigMap,
    R: np.ndarray,
    driven: np.ndarray,
    carrier: int,
    scale: float,
    legs: Mapping[str, feet.Leg],
    contacts: Contacts | None,
    settings: FeetSettings,
    floor_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R with feet on the floor, the carrier's shift (T, 3), and what of it is for the feet's standing (T, 3)."""
    shift = unmoved = np.zeros((len(R), 3))
    if carrier < 0:
        return R, shift, unmoved
    pinning = contacts is not None and settings.mode != "off" and bool(legs)
    if pinning and contacts is not None:
        R = follow(target, feet.lock_flat(R, legs, contacts, target, settings, source.fps), driven)
    heads = heads_of(target, R, carrier, shift, target_map)
    middle = hip_centre(Motion(rig=target, fps=source.fps, frames=source.frames, R=R, head_m=heads), target_map)
    path = _travel(source, source_map, target, target_map, contacts, scale, legs, floor_m)
    shift = path - middle
    if not pinning or contacts is None:
        return R, shift, unmoved
    heads = heads_of(target, R, carrier, shift, target_map)
    stands = feet.find_stands(legs, contacts, target, R, floor_m)
    moved, tilt, places = feet.carry_root(
        stands,
        {side: heads[:, leg.foot[0]] for side, leg in legs.items()},
        {s: heads[:, leg.thigh[0]] - path for s, leg in legs.items()},
        {side: feet.stiffness(leg, target, R) for side, leg in legs.items()},
        source.fps,
        _leg_m(target, target_map),
    )
    R, shift = _tilted(target, target_map, R, driven, carrier, shift, tilt, path + moved)
    return (
        _pinned(
            target,
            target_map,
            R,
            driven,
            heads_of(target, R, carrier, shift, target_map),
            legs,
            stands,
            places,
            floor_m,
            settings.blend_s * source.fps,
        ),
        shift,
        moved,
    )


def _tilted(
    target: Rig,
    target_map: RigMap,
    R: np.ndarray,
    driven: np.ndarray,
    carrier: int,
    shift: np.ndarray,
    tilt: np.ndarray,
    middle: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The hips turned by the Rodrigues vectors `tilt` (T, 3), the middle between the hip joints being at `middle` (T, 3)."""
    R = R.copy()
    for name in target_map.bones["hips"]:
        R[:, target.index[name]] = matrix_from_vector(tilt) @ R[:, target.index[name]]
    R = follow(target, R, driven)
    now = Motion(rig=target, fps=1.0, frames=np.arange(len(R)), R=R, head_m=heads_of(target, R, carrier, shift, target_map))
    return R, shift + middle - hip_centre(now, target_map)


def _travel(
    source: Motion,
    source_map: RigMap,
    target: Rig,
    target_map: RigMap,
    contacts: Contacts | None,
    scale: float,
    legs: Mapping[str, feet.Leg],
    floor_m: float,
) -> np.ndarray:
    """Where the middle of the hips goes (T, 3): as the source's, scaled, with the ankles' levels on the floor as the origin of height."""
    path = hip_centre(source, source_map)
    if contacts is None or not legs:
        rest_s = source.rig.head_m[source.rig.index[source_map.bones["hips"][0]]]
        rest_t = target.head_m[target.index[target_map.bones["hips"][0]]]
        return rest_t + scale * (path - rest_s)
    return scale * (path - (0.0, 0.0, contacts.ankle_level_m)) + (0.0, 0.0, floor_m + _ankle_level(legs))


def _pinned(
    target: Rig,
    target_map: RigMap,
    R: np.ndarray,
    driven: np.ndarray,
    heads: np.ndarray,
    legs: Mapping[str, feet.Leg],
    stands: list[feet.Stand],
    places: np.ndarray,
    floor_m: float,
    blend: float,
) -> np.ndarray:
    """R with the legs bent so that standing feet stand."""
    front = -body_axes(target, target_map)[:, 1]
    for leg in legs.values():
        thigh = leg.thigh[0]
        goal, R = feet.ankle_goals(leg, target, R, stands, places, heads[:, leg.foot[0]], floor_m, blend)
        forward = R[:, thigh] @ (target.R_rest[thigh].T @ front)
        R = feet.bend_limb(target, R, leg.thigh, leg.shin, leg.foot[0], heads[:, thigh], goal, forward)
    return follow(target, R, driven)


def restarted(motion: Motion, first_frame: float) -> Motion:
    """The same motion, beginning at another frame."""
    return replace(motion, frames=motion.frames - motion.frames[0] + first_frame, unshown=None)
