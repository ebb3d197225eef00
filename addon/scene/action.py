"""The motion as an action: an F-curve for each DOF with a key in every frame, in groups by bone.

The sigmas are an action of their own, in a locked NLA track below, so that the channels to edit are not among them. The sigma of a DOF is
a custom property of its bone ("sigma elbow.R flexion"), in the unit of its channel: radians, or metres for the base. That of a bone's
place ("sigma forearm.R", metres) is the larger one of the joints at its ends, without what is common to all frames.
"""

from collections.abc import Mapping, Sequence
from math import pi

import bpy
import numpy as np

from ...core.body.shape import BodyShape
from ...core.body.skeleton import Bone
from ...core.motion.retarget.rig import needed_keys
from ...core.motion.tables import JointTable
from . import armature
from .standing import DOFS_KEY, MEASURED_KEY, Standing

NAME, SIMPLE_NAME, UNCERTAINTY = "Measured motion", "Simplified motion", "Uncertainty"
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
    place_sigma: Mapping[str, np.ndarray] | None = None,
) -> bpy.types.Action:
    """Key the armature with the motion: frames (T,), values and sigma (T, D) in radians and metres. NaN gets no key.

    `place_sigma` (T,) [m]: how well the places of bones are known.
    """
    channels = armature.channel_of(shape, stand)
    armature_object.data[DOFS_KEY] = {name: {"bone": c.bone, "path": c.path, "index": c.index} for name, c in channels.items()}
    sigmas = {name: (channels[name].bone, column) for name, column in zip(dof_names, sigma.T)}
    _add_uncertainty(armature_object, sigmas | {name: (name, column) for name, column in (place_sigma or {}).items()}, frames)
    action = bpy.data.actions.new(NAME)
    armature_object.animation_data.action = action
    for column, name in enumerate(dof_names):
        bone_name, channel, index, sign, offset = channels[name]
        pose_bone = armature_object.pose.bones[bone_name]
        path = pose_bone.path_from_id()
        key(action, armature_object, f"{path}.{channel}", index, frames, sign * values[:, column] + offset, group=bone_name)
    motion = {name: values[:, column] for column, name in enumerate(dof_names)}
    for bone in (bone for bone in armature.rig_bones(shape) if bone.dofs):
        _mute_exceeded_limits(armature_object.pose.bones[bone.name], bone, motion)
    return action


def place_sigmas(shape: BodyShape, joints: JointTable, frames: np.ndarray) -> dict[str, np.ndarray]:
    """By bone of the armature the larger sigma (T,) [m] of the joints at its ends, without what is common to all frames, as in the report;
    NaN in frames that the table lacks. Tables of earlier versions have only the whole sigmas."""
    rows = {int(frame): row for row, frame in enumerate(joints.frames)}
    at = np.array([rows.get(int(frame), len(rows)) for frame in frames], dtype=np.intp)
    own = {name: np.where(np.isfinite(sigma), sigma, joints.sigma_m[name]) for name, sigma in joints.frame_sigma_m.items()}
    found = {}
    for bone in armature.rig_bones(shape):
        ends = [own[joint] for joint in (bone.head_joint, bone.tail_joint) if joint in own]
        if len(ends) == 2:
            found[bone.name] = np.append(np.maximum(*ends), np.nan)[at]
    return found


def _add_uncertainty(armature_object: bpy.types.Object, sigmas: Mapping[str, tuple[str, np.ndarray]], frames: np.ndarray) -> None:
    """Sigmas as an action in a locked NLA track: by name the bone and the values (T,)."""
    data, action = armature_object.animation_data_create(), bpy.data.actions.new(UNCERTAINTY)
    data.action = action
    for name, (bone_name, sigma) in sigmas.items():
        pose_bone = armature_object.pose.bones[bone_name]
        pose_bone[f"sigma {name}"] = 0.0
        key(action, armature_object, f'{pose_bone.path_from_id()}["sigma {name}"]', 0, frames, sigma, group=bone_name)
    slot, data.action = data.action_slot, None
    if not len(frames):
        return
    track = data.nla_tracks.new()
    track.name = UNCERTAINTY
    strip = track.strips.new(UNCERTAINTY, int(frames[0]), action)
    if slot is not None and strip.action_slot is None:
        strip.action_slot = slot
    track.lock = True


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
        key(action, armature_object, path, index, frames[kept], sign * values[kept, column] + offset, group=bone_name)
    return action


def key(
    action: bpy.types.Action,
    owner: bpy.types.Object,
    path: str,
    index: int,
    frames: np.ndarray,
    values: np.ndarray,
    interpolation: str = "LINEAR",
    group: str = "",
) -> None:
    """Key one channel of an object in these frames; NaN gets no key. `group`: of the channels in the Dope Sheet."""
    curve = action.fcurve_ensure_for_datablock(owner, path, index=index)
    if group:
        groups = action.layers[0].strips[0].channelbag(owner.animation_data.action_slot).groups
        curve.group = groups.get(group) or groups.new(group)
    set_keys(curve, frames, values, interpolation)


def set_keys(curve: bpy.types.FCurve, frames: np.ndarray, values: np.ndarray, interpolation: str = "LINEAR") -> None:
    """Give a curve these keys (T,) in place of its own; NaN gets no key."""
    known = np.isfinite(values)
    points = curve.keyframe_points
    points.clear()
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
