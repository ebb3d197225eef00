"""A control rig over the motion of a new build: made anew, with the corrections and layers that the earlier one played."""

from dataclasses import dataclass
from typing import Any

import bpy
from mathutils import Matrix

from ..scene import stored
from ..scene.standing import controls_of_body
from .base_layer import BASE_KEY
from .control_rig import make_control_rig

LAYER = ("action_blend_type", "action_extrapolation", "action_influence")  # of the animation data
TRACK = ("mute", "lock")
STRIP = (
    "action_frame_start",
    "action_frame_end",
    "scale",
    "repeat",
    "blend_in",
    "blend_out",
    "use_auto_blend",
    "use_reverse",
    "blend_type",
    "extrapolation",
    "influence",
    "mute",
)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Played:
    """An action with the slot of it that is played, and how: the values of `LAYER` or `STRIP`."""

    action: bpy.types.Action
    slot: str
    how: dict[str, Any]
    name: str = ""
    start: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Controls:
    """What an animator did with a control rig; the actions live on only if something else keeps them."""

    name: str
    active: _Played | None
    tracks: list[tuple[str, dict[str, Any], list[_Played]]]  # without the base layer
    properties: dict[str, dict[str, float]]  # by bone: switches and influences
    from_body: Matrix  # from the place of the body's object to that of the rig's


def remember(body: bpy.types.Object) -> Controls | None:
    """What there is of a body's control rig; None without one."""
    rig = controls_of_body(body)
    if rig is None:
        return None
    data, base = rig.animation_data, stored.data_block(rig, BASE_KEY, bpy.types.Action)
    tracks = [] if data is None else [t for t in data.nla_tracks if base not in [strip.action for strip in t.strips]]
    active = data.action if data is not None else None
    return Controls(
        name=rig.name,
        active=_Played(action=active, slot=_slot(data), how=_values(data, LAYER)) if active is not None and active.slots else None,
        tracks=[(track.name, _values(track, TRACK), [_strip(strip) for strip in track.strips if strip.action]) for track in tracks],
        properties={bone.name: {k: v for k, v in bone.items() if isinstance(v, (int, float))} for bone in rig.pose.bones},
        from_body=body.matrix_world.inverted_safe() @ rig.matrix_world,
    )


def make_again(body: bpy.types.Object, controls: Controls) -> bpy.types.Object:
    """Make a body's control rig, and let it play what the earlier one played over its base layer.

    Raises:
        InputError: see `make_control_rig`.
    """
    rig = make_control_rig(body).rig
    rig.name = controls.name
    rig.matrix_world = body.matrix_world @ controls.from_body
    for bone in rig.pose.bones:
        for name, value in controls.properties.get(bone.name, {}).items():
            if name in bone:
                bone[name] = value
    data = rig.animation_data
    for name, how, strips in controls.tracks:
        track = data.nla_tracks.new()
        track.name = name
        for played in strips:
            strip = track.strips.new(played.name, round(played.start), played.action)
            _play(strip, played)
            strip.frame_start = played.start
        _set(track, how)
    if controls.active is not None:
        empty, data.action = data.action, controls.active.action
        _play(data, controls.active)
        if empty is not None and not empty.users:
            bpy.data.actions.remove(empty)
    bpy.context.view_layer.update()
    return rig


def _strip(strip: bpy.types.NlaStrip) -> _Played:
    return _Played(action=strip.action, slot=_slot(strip), how=_values(strip, STRIP), name=strip.name, start=strip.frame_start)


def _slot(player: Any) -> str:
    return player.action_slot.identifier if player.action_slot is not None else ""


def _values(thing: Any, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(thing, name) for name in names}


def _set(thing: Any, values: dict[str, Any]) -> None:
    for name, value in values.items():
        setattr(thing, name, value)


def _play(player: Any, played: _Played) -> None:
    """Let animation data or a strip play the slot that it played."""
    slot = next((slot for slot in played.action.slots if slot.identifier == played.slot), None)
    if slot is not None:
        player.action_slot = slot
    _set(player, played.how)
