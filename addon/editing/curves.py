"""The curves of a body's action and of its uncertainty, as arrays."""

import re
from collections.abc import Mapping

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ..scene import stored
from ..scene.action import UNCERTAINTY, set_keys
from ..scene.action_curves import curves_of
from ..scene.standing import MEASURED_KEY, controls_of_body

EDITED = "Edited motion"
BONE = re.compile(r'pose\.bones\["((?:[^"\\]|\\.)*)"\]\.?(.*)')
CHANNELS = ("location", "rotation_euler")


def bone_of(curve: bpy.types.FCurve) -> str:
    """The bone of a curve, "" for a curve of the object."""
    found = BONE.fullmatch(curve.data_path)
    return found[1] if found else ""


def motion_curves(body: bpy.types.Object, *, selected: bool = False) -> list[bpy.types.FCurve]:
    """The curves of a body's active action that move its bones; with `selected`, in pose mode, those of the selected bones.

    Raises:
        InputError: it plays no action of its own, a control rig drives it, or no bone with keys is selected.
    """
    rig, data = controls_of_body(body), body.animation_data
    if rig is not None:
        raise InputError(f"“{rig.name}” drives “{body.name}”; edit the motion before the control rig is made, or delete that first.")
    if data is None or data.action is None or data.action_slot is None:
        raise InputError(f"“{body.name}” has no action to edit; choose one in the Action Editor, or build the rig again (step 7).")
    curves = [c for c in curves_of(data.action) if (at := BONE.fullmatch(c.data_path)) and at[2] in CHANNELS and len(c.keyframe_points)]
    if selected and body.mode == "POSE":
        chosen = {bone.name for bone in bpy.context.selected_pose_bones_from_active_object or ()}
        curves = [curve for curve in curves if bone_of(curve) in chosen]
    if not curves:
        raise InputError("No selected bone has keys; select other bones, or leave Pose Mode to edit all.")
    return curves


def edited_action(body: bpy.types.Object, name: str = EDITED) -> bpy.types.Action:
    """The body's action, ready for edits: of the measured motion a copy, which leaves the measured one as it is."""
    data = body.animation_data
    if stored.data_block(body, MEASURED_KEY, bpy.types.Action) is None:
        body[MEASURED_KEY] = data.action  # counts as a user, so that it is saved
        slot = data.action_slot.identifier
        data.action = data.action.copy()
        data.action.name = name
        data.action_slot = next(s for s in data.action.slots if s.identifier == slot)
    return data.action


def keys_of(curve: bpy.types.FCurve) -> tuple[np.ndarray, np.ndarray]:
    """Frames (T,) and values (T,) of a curve's keys."""
    flat = np.empty(2 * len(curve.keyframe_points), dtype=np.float32)
    curve.keyframe_points.foreach_get("co", flat)
    frames, values = flat.reshape(-1, 2).T.astype(float)
    return frames, values


def replace_keys(curve: bpy.types.FCurve, frames: np.ndarray, values: np.ndarray) -> None:
    """Give a curve keys with these values (n,) in some frames (n,); those of other frames stay."""
    at, earlier = keys_of(curve)
    others = ~np.isin(at, frames)
    at, values = np.concatenate([at[others], frames]), np.concatenate([earlier[others], values])
    order = np.argsort(at)
    set_keys(curve, at[order], values[order])


def sigma_curves(body: bpy.types.Object) -> Mapping[str, bpy.types.FCurve]:
    """The curves of a body's sigmas, by the name of their custom property (“sigma elbow.R flexion”); empty where it has none."""
    tracks = body.animation_data.nla_tracks if body.animation_data is not None else ()
    actions = [strip.action for track in tracks if track.name == UNCERTAINTY for strip in track.strips if strip.action is not None]
    return {curve.data_path.rpartition('["')[2][:-2]: curve for action in actions for curve in curves_of(action)}
