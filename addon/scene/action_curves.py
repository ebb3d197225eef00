"""The curves of actions."""

import hashlib

import bpy
import numpy as np


def bags_of(action: bpy.types.Action) -> list[bpy.types.ActionChannelbag]:
    """The bags with the curves of an action, one for each slot."""
    return [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]


def curves_of(action: bpy.types.Action) -> list[bpy.types.FCurve]:
    """All curves of an action."""
    return [curve for bag in bags_of(action) for curve in bag.fcurves]


def keys_digest(action: bpy.types.Action) -> str:
    """A digest of the frames and values of all keys of an action."""
    total = hashlib.sha256()
    for curve in sorted(curves_of(action), key=lambda curve: (curve.data_path, curve.array_index)):
        keys = np.empty(2 * len(curve.keyframe_points), dtype=np.float32)
        curve.keyframe_points.foreach_get("co", keys)
        total.update(f"{curve.data_path} {curve.array_index}".encode() + keys.tobytes())
    return total.hexdigest()
