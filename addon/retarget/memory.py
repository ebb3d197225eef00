"""What an action remembers of its motion beyond what its rig shows (core's `Unshown`): a custom property, good for as long as the keys
are as they were written."""

import hashlib
from dataclasses import replace

import bpy
import numpy as np

from ...core.motion.retarget.rig import Motion
from ...core.motion.retarget.unshown import Unshown, from_text, to_text

KEY = "tricap_unshown"


def remember(action: bpy.types.Action, unshown: Unshown) -> None:
    """Keep it with the action."""
    action[KEY] = {"motion": to_text(unshown), "keys": digest(action)}


def recalled(armature_object: bpy.types.Object, motion: Motion) -> Motion:
    """The motion, read from an armature, with what its action remembers, or with a note why not.

    Raises:
        InputError: what it remembers is damaged.
    """
    action = played_action(armature_object)
    if action is None:
        return motion
    if digest(action) != action[KEY]["keys"]:
        note = f"“{action.name}” was edited: what its rig could not show of its source is left out (corrections in a layer above keep it)"
        return replace(motion, notes=(*motion.notes, note))
    return replace(motion, unshown=from_text(action[KEY]["motion"]).at(motion.frames))


def played_action(armature_object: bpy.types.Object) -> bpy.types.Action | None:
    """The action that remembers something, if the armature plays one such at its own time."""
    data = armature_object.animation_data
    strips = [strip for track in data.nla_tracks if not track.mute for strip in track.strips if not strip.mute]
    own_time = [s.action for s in strips if s.action and s.scale == 1.0 and s.repeat == 1.0 and s.frame_start == s.action_frame_start]
    found = [action for action in (data.action, *own_time) if action is not None and KEY in action]
    return found[0] if len(found) == 1 else None


def digest(action: bpy.types.Action) -> str:
    """Of all keys of an action: their places and values."""
    total = hashlib.sha256()
    curves = [curve for layer in action.layers for strip in layer.strips for bag in strip.channelbags for curve in bag.fcurves]
    for curve in sorted(curves, key=lambda curve: (curve.data_path, curve.array_index)):
        places = np.empty(2 * len(curve.keyframe_points), dtype=np.float32)
        curve.keyframe_points.foreach_get("co", places)
        total.update(f"{curve.data_path} {curve.array_index}".encode() + places.tobytes())
    return total.hexdigest()
