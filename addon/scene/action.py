"""The motion as an action: an F-curve for each DOF and for each DOF's sigma, with a key in every frame.

The sigma of a DOF is a custom property of its bone ("sigma elbow.R flexion"), in the unit of its channel:
radians, or metres for the base.
"""

from collections.abc import Mapping, Sequence
from math import pi

import bpy
import numpy as np

from ...core.body.shape import BodyShape
from ...core.body.skeleton import Bone
from ...core.motion.retarget.rig import needed_keys
from . import armature
from .standing import Standing

NAME, SIMPLE_NAME = "Measured motion", "Simplified motion"
MEASURED_KEY = "tricap_measured_motion"  # custom property of the armature: the measured action while another one plays
METRES_PER_RADIAN = 0.2  # converts the tolerance of angles to the base's location: 1° corresponds to 3.5 mm
LIMITS_TOLERANCE_RAD = 1e-6  # overstepping below this is rounding


def add_action(
    armature_object: bpy.types.Object,
    shape: BodyShape,
    frames: np.ndarray,
    dof_names: Sequence[str],
    values: np.ndarray,
    sigma: np.ndarray,
    stand: Standing | None = None,
) -> bpy.types.Action:
    """Key the armature with the motion: frames (T,), values and sigma (T, D) in radians and metres. NaN gets no key."""
    action = bpy.data.actions.new(NAME)
    armature_object.animation_data_create().action = action
    channels = armature.channel_of(shape, stand)
    for column, name in enumerate(dof_names):
        bone_name, channel, index, sign, offset = channels[name]
        pose_bone = armature_object.pose.bones[bone_name]
        path = pose_bone.path_from_id()
        key(action, armature_object, f"{path}.{channel}", index, frames, sign * values[:, column] + offset)
        pose_bone[f"sigma {name}"] = 0.0
        key(action, armature_object, f'{path}["sigma {name}"]', 0, frames, sigma[:, column])
    motion = {name: values[:, column] for column, name in enumerate(dof_names)}
    for bone in armature.rig_bones(shape):
        _mute_exceeded_limits(armature_object.pose.bones[bone.name], bone, motion)
    return action


def add_simplified(
    armature_object: bpy.types.Object,
    shape: BodyShape,
    frames: np.ndarray,
    dof_names: Sequence[str],
    values: np.ndarray,
    tolerance_deg: float,
    stand: Standing | None = None,
) -> bpy.types.Action:
    """Give the armature a second action with fewer keys, with every angle of `values` (T, D) within `tolerance_deg`.

    The measured motion stays in the file as its own action.
    """
    armature_object[MEASURED_KEY] = armature_object.animation_data.action  # the property counts as a user, so that the action is saved
    action = bpy.data.actions.new(SIMPLE_NAME)
    armature_object.animation_data.action = action
    channels = armature.channel_of(shape, stand)
    for column, name in enumerate(dof_names):
        bone_name, channel, index, sign, offset = channels[name]
        known = np.flatnonzero(np.isfinite(values[:, column]))
        tolerance = np.radians(tolerance_deg) * (1.0 if channel == "rotation_euler" else METRES_PER_RADIAN)
        kept = known[needed_keys(frames[known], values[known, column], tolerance)]
        path = f"{armature_object.pose.bones[bone_name].path_from_id()}.{channel}"
        key(action, armature_object, path, index, frames[kept], sign * values[kept, column] + offset)
    return action


def key(
    action: bpy.types.Action,
    owner: bpy.types.Object,
    path: str,
    index: int,
    frames: np.ndarray,
    values: np.ndarray,
    interpolation: str = "LINEAR",
) -> None:
    """Key one channel of an object in these frames; NaN gets no key."""
    known = np.isfinite(values)
    curve = action.fcurve_ensure_for_datablock(owner, path, index=index)
    points = curve.keyframe_points
    points.add(int(known.sum()))
    points.foreach_set("co", np.stack([frames[known], values[known]], axis=-1).astype(np.float32).ravel())
    kind = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items[interpolation].value
    points.foreach_set("interpolation", np.full(len(points), kind, dtype=np.int32))
    curve.update()


def _mute_exceeded_limits(pose_bone: bpy.types.PoseBone, bone: Bone, motion: Mapping[str, np.ndarray]) -> None:
    """Mute the joint limits that the measured motion exceeds, so that they do not change it.

    The constraint decomposes the pose again, which gives the same angles only below 90° about the middle axis and 180° about the others.
    """
    constraint = pose_bone.constraints["Joint limits"]
    for dof in bone.dofs:
        angles = motion.get(dof.name, np.zeros(1))
        reach = pi / 2 if dof.axis == bone.rotation_mode[1].lower() else pi
        low, high = max(dof.limits[0], -reach), min(dof.limits[1], reach)
        if np.nanmin(angles, initial=0.0) < low - LIMITS_TOLERANCE_RAD or np.nanmax(angles, initial=0.0) > high + LIMITS_TOLERANCE_RAD:
            constraint.mute = True
