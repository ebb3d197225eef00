"""Writes a retargeted motion as an action of the target: all keys of an F-curve at once, in the bones' own rotation modes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...core.geometry.rotation import continuous, euler_from_matrix, quaternion_from_matrix, transposed
from ...core.motion.retarget.residual_motion import ResidualMotion, to_text
from ...core.motion.retarget.retarget import Retargeted
from ...core.motion.retarget.rig import needed_keys
from ..editing.curves import replace_keys
from ..scene.action import key
from ..scene.action_curves import curves_of, keys_digest
from .read import RESIDUAL_KEY, scale_of, world_matrix

CHANNEL = {"QUATERNION": ("rotation_quaternion", 4), "AXIS_ANGLE": ("rotation_axis_angle", 4)}
REST = {
    "rotation_quaternion": (1, 0, 0, 0),
    "rotation_axis_angle": (0, 0, 1, 0),
    "rotation_euler": (0, 0, 0),
    "location": (0, 0, 0),
    "scale": (1, 1, 1),
}

RestChannel = tuple[str, str, np.ndarray]  # bone, path and rest values of a channel


@dataclass(frozen=True, kw_only=True)
class Written:
    """The new action; `raw`, the action with a key in every frame if the new one has fewer; the number of keys; and the constraints that
    were muted because they would override the action."""

    action: bpy.types.Action
    raw: bpy.types.Action | None
    keys: int
    muted: tuple[str, ...]


def write_action(
    target: bpy.types.Object,
    result: Retargeted,
    name: str,
    *,
    tolerance_deg: float = 0.0,
    properties: Mapping[str, Mapping[str, float]] | None = None,
) -> Written:
    """Give the target a new action with the motion; the earlier one stays in the file. Main thread only.

    `tolerance_deg`: remove keys as long as no rotation changes by more, and add an action with all keys, too; 0 keys every frame.
    `properties`: by bone, custom properties that the action sets once, such as FK instead of IK.
    """
    earlier = target.animation_data_create().action
    if earlier is not None:
        earlier.use_fake_user = True
    resting, properties = _reset_undriven(target, result), properties or {}
    raw = None
    if tolerance_deg > 0:
        raw, _ = _new_action(target, result, f"{name} (every frame)", 0.0, resting, properties)
        raw.use_fake_user = True
    action, keys = _new_action(target, result, name, tolerance_deg, resting, properties)
    return Written(action=action, raw=raw, keys=keys, muted=_mute_constraints(target, result))


def _new_action(
    target: bpy.types.Object,
    result: Retargeted,
    name: str,
    tolerance_deg: float,
    resting: Sequence[RestChannel],
    properties: Mapping[str, Mapping[str, float]],
) -> tuple[bpy.types.Action, int]:
    """A new action of the target with the motion, and its number of keys."""
    action = bpy.data.actions.new(name)
    target.animation_data.action = action
    frames, rig = result.motion.frames, result.motion.rig
    keys = 0
    turn = np.radians(tolerance_deg) / 2
    shift = turn * float(np.ptp(rig.head_m, axis=0).max()) / scale_of(target)
    for bone, channel, values in _driven_channels(target, result):
        keep = needed_keys(frames, values, shift if channel == "location" else turn)
        keys += _key(action, target, f"{bone.path_from_id()}.{channel}", frames[keep], values[keep], bone.name)
    keys += sum(_key(action, target, path, frames[:1], rest[None], bone) for bone, path, rest in resting)
    return action, keys + _key_properties(action, target, properties, frames[:1])


def _driven_channels(target: bpy.types.Object, result: Retargeted) -> Iterator[tuple[bpy.types.PoseBone, str, np.ndarray]]:
    """Bone, name and values (T, 3 or 4) of each channel that the motion drives."""
    names = result.motion.rig.names
    for b in np.flatnonzero(result.driven):
        bone = target.pose.bones[names[b]]
        yield bone, *rotation_values(bone, result.basis[:, b])
    shifts = dict(result.loose_m) | ({result.carrier: result.shift_m} if result.carrier >= 0 else {})
    for b, shift_m in shifts.items():
        bone = target.pose.bones[names[b]]
        yield bone, "location", location_values(target, bone, result, b, shift_m)


def replace_frames(target: bpy.types.Object, action: bpy.types.Action, result: Retargeted) -> None:
    """Put the motion into an action that `write_action` wrote, in the motion's own frames; the keys of other frames stay."""
    curves, frames = {(curve.data_path, curve.array_index): curve for curve in curves_of(action)}, result.motion.frames
    for bone, channel, values in _driven_channels(target, result):
        own = [curves.get((f"{bone.path_from_id()}.{channel}", i)) for i in range(values.shape[1])]
        if None in own:
            continue
        before = np.array([[curve.evaluate(frame) for curve in own] for frame in frames])
        if channel == "rotation_quaternion":  # of the two that mean the same rotation, and so of angles, the one next to the neighbours
            values = values * np.where((before * values).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        elif channel == "rotation_euler":
            values = values + 2 * np.pi * np.round((before - values) / (2 * np.pi))
        for curve, column in zip(own, values.T, strict=True):
            replace_keys(curve, frames, column)


def rotation_values(bone: bpy.types.PoseBone, basis: np.ndarray) -> tuple[str, np.ndarray]:
    """Name and values (T, 3 or 4) of the rotation channels of a bone, in its mode, without jumps."""
    if bone.rotation_mode not in CHANNEL:
        return "rotation_euler", euler_from_matrix(basis, bone.rotation_mode)
    q = continuous(quaternion_from_matrix(basis))
    if bone.rotation_mode == "QUATERNION":
        return "rotation_quaternion", q
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    axis = np.divide(q[:, 1:], sine, out=np.tile([0.0, 1.0, 0.0], (len(q), 1)), where=sine > 1e-9)
    return "rotation_axis_angle", np.concatenate([2 * np.arctan2(sine, q[:, :1]), axis], axis=1)


def location_values(target: bpy.types.Object, bone: bpy.types.PoseBone, result: Retargeted, b: int, shift_m: np.ndarray) -> np.ndarray:
    """The location channels (T, 3) of bone b, which shifts by `shift_m` (T, 3) in the world."""
    shift = shift_m / scale_of(target)
    if bone.bone.use_local_location:
        carried = result.motion.R[:, b] @ transposed(result.basis[:, b])
        return np.einsum("tji,tj->ti", carried, shift)
    world = world_matrix(target)[:3, :3] / scale_of(target)
    return shift @ world


def _key(action: bpy.types.Action, owner: bpy.types.Object, path: str, frames: np.ndarray, values: np.ndarray, group: str) -> int:
    for i in range(values.shape[1]):
        key(action, owner, path, i, frames, values[:, i], group=group)
    return len(frames) * values.shape[1]


def _reset_undriven(target: bpy.types.Object, result: Retargeted) -> list[RestChannel]:
    """Reset channels that the motion does not drive but that an earlier pose has changed; returns them for a key each."""
    rig, resting = result.motion.rig, list[RestChannel]()
    driven_paths = {driver.data_path for driver in target.animation_data.drivers}
    for bone in target.pose.bones:
        b = rig.index.get(bone.name, -1)  # −1: a control rig has only its controls
        rotation = CHANNEL.get(bone.rotation_mode, ("rotation_euler", 3))[0]
        for channel in (rotation, "location", "scale"):
            keyed = (channel == rotation and result.driven[b]) or (channel == "location" and (b == result.carrier or b in result.loose_m))
            if (b >= 0 and keyed) or f"{bone.path_from_id()}.{channel}" in driven_paths:
                continue
            now, rest = np.array(getattr(bone, channel)), np.array(REST[channel], dtype=float)
            moved = abs(now[0]) > 1e-6 if channel == "rotation_axis_angle" else np.abs(now - rest).max() > 1e-6
            if moved:
                setattr(bone, channel, rest)
                resting.append((bone.name, f"{bone.path_from_id()}.{channel}", rest))
    return resting


def _key_properties(
    action: bpy.types.Action, target: bpy.types.Object, properties: Mapping[str, Mapping[str, float]], at: np.ndarray
) -> int:
    """Key each of these custom properties that the rig has, once."""
    keys = 0
    for name, values in properties.items():
        bone = target.pose.bones.get(name)
        for prop, value in values.items() if bone is not None else ():
            if prop in bone:
                bone[prop] = type(bone[prop])(value)
                path = f'{bone.path_from_id()}["{bpy.utils.escape_identifier(prop)}"]'
                keys += _key(action, target, path, at, np.full((1, 1), value), name)
    return keys


def _mute_constraints(target: bpy.types.Object, result: Retargeted) -> tuple[str, ...]:
    """Mute the constraints of driven bones, which would change the motion."""
    muted = []
    for b in np.flatnonzero(result.driven):
        for constraint in target.pose.bones[result.motion.rig.names[b]].constraints:
            if not constraint.mute:
                constraint.mute = True
                muted.append(f"{result.motion.rig.names[b]}: {constraint.name}")
    return tuple(muted)


def store_residual_motion(action: bpy.types.Action, residual: ResidualMotion) -> None:
    """Store with an action the part of its motion that its rig cannot show; it is valid as long as the keys stay as they are now."""
    action[RESIDUAL_KEY] = {"motion": to_text(residual), "keys": keys_digest(action)}


def push_to_strip(target: bpy.types.Object, action: bpy.types.Action) -> bpy.types.NlaStrip:
    """Push the action down to a strip on a new NLA track, so that corrections can be layered over it."""
    data = target.animation_data
    slot = getattr(data, "action_slot", None)
    data.action = None
    track = data.nla_tracks.new()
    track.name = action.name
    strip = track.strips.new(action.name, int(np.floor(action.frame_range[0])), action)
    if slot is not None and getattr(strip, "action_slot", None) is None:
        strip.action_slot = slot
    return strip
