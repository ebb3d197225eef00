"""The armature: the skeleton in its rest pose, with pose channels that ARE the degrees of freedom.

Blender's pose of a bone is  M_bone = M_parent · Rest_rel · Euler(channels in its rotation mode), which is equation (1) of
core.body.skeleton. So a bone gets the skeleton's rest frame (y from head to tail) and rotation mode, and its Euler channels are
the angles of the DOFs; channels without a DOF are locked. The base of the model is a bone of its own, `root`, with the world's
axes: its location channels are the base DOFs in metres. Of a whole body, which stands on the floor (`standing.py`), the height is a
location channel of the pelvis instead, relative to the rest pose.
"""

from math import isfinite, pi
from typing import Any, NamedTuple

import bpy
import numpy as np
from mathutils import Vector

from ...core.body.shape import BodyShape
from ...core.body.skeleton import Bone, bone_frames
from ...core.body.skin.fingers import FINGER_BONE
from ...core.motion.retarget.roles import model_roles
from .standing import LIFT_KEY, ROOT, Standing, base_height

ROOT_LENGTH_M = 0.1
NAME = "Body"
PALETTES = {".R": "THEME01", ".L": "THEME04"}  # colours of the sides: red and blue; the middle is yellow
ROLES_KEY = "tricap_roles"  # custom property of armature data: the bone of each part of the body
SNAPS_KEY = "tricap_snaps"  # custom property of a control rig: by limb, the arguments of Rigify's snapping
JOINTS_KEY = "tricap_joints"  # custom property of armature data: by joint, a bone that begins or ends there


def add_armature(collection: bpy.types.Collection, shape: BodyShape, stand: Standing | None = None) -> bpy.types.Object:
    """An armature object in the rest pose of the person's skeleton, in object mode, pose channels ready to be keyed.

    `stand`: the rest pose stands on the floor, and so does the object.
    """
    armature = bpy.data.armatures.new(NAME)
    armature.display_type = "STICK"
    armature_object = bpy.data.objects.new(NAME, armature)
    armature_object.show_in_front = True
    armature[ROLES_KEY] = model_roles(bone.name for bone in shape.skeleton.bones)
    armature[JOINTS_KEY] = _joint_ends(shape)
    collection.objects.link(armature_object)
    _edit_bones(armature_object, shape, stand.lift_m if stand else 0.0)
    _bone_collections(armature)
    for pose_bone in armature_object.pose.bones:
        pose_bone.lock_location = pose_bone.lock_rotation = pose_bone.lock_scale = (True, True, True)
    channels = channel_of(shape, stand)
    armature_object.pose.bones[ROOT].rotation_mode = "XYZ"
    for bone in rig_bones(shape):
        _free_rotation(armature_object.pose.bones[bone.name], bone)
    for dof in shape.skeleton.base_dofs:
        armature_object.pose.bones[channels[dof.name].bone].lock_location[channels[dof.name].index] = False
    if stand is not None:
        armature_object.location.z = stand.floor_m
        armature[LIFT_KEY] = stand.lift_m
    return armature_object


def _joint_ends(shape: BodyShape) -> dict[str, dict[str, Any]]:
    """By joint, a bone of the armature that begins or ends there."""
    ends: dict[str, dict[str, Any]] = {}
    for bone in (bone for bone in rig_bones(shape) if not is_finger(bone)):
        ends.setdefault(bone.head_joint, {"bone": bone.name, "at_tail": False})
        ends.setdefault(bone.tail_joint, {"bone": bone.name, "at_tail": True})
    return {joint: ends[joint] for joint in shape.skeleton.joint_names if joint in ends}


class Channel(NamedTuple):
    """The channel of a DOF: its values are those of the DOF times `sign` plus `offset`."""

    bone: str
    path: str  # "location" or "rotation_euler"
    index: int
    sign: float = 1.0
    offset: float = 0.0


def channel_of(shape: BodyShape, stand: Standing | None = None) -> dict[str, Channel]:
    """The channel of each DOF, by its name. Of a body that stands, the base bone has the height."""
    channels = {dof.name: Channel(ROOT, "location", "xyz".index(dof.axis)) for dof in shape.skeleton.base_dofs}
    upright = base_height(shape) if stand is not None else None
    if stand is not None and upright is not None:
        bone_name, index, sign = upright
        height = next(dof.name for dof in shape.skeleton.base_dofs if dof.axis == "z")
        channels[height] = Channel(bone_name, "location", index, sign, -sign * (stand.lift_m + stand.floor_m))
    for bone in rig_bones(shape):
        channels |= {dof.name: Channel(bone.name, "rotation_euler", "xyz".index(dof.axis)) for dof in bone.dofs}
    return channels


def rig_bones(shape: BodyShape) -> list[Bone]:
    """The bones of the skeleton that are bones of the armature: all but rigid connections without flesh (from the nape to the collarbone,
    half the pelvis, from the wrist to the fingers), which no rig has. Fingers and toes have bones, which nothing moves but the animator."""
    skeleton, fleshy = shape.skeleton, set(shape.metaballs.bone_index.tolist())
    return [bone for b, bone in enumerate(skeleton.bones) if bone.dofs or not bone.parent or b in fleshy or is_finger(bone)]


def is_finger(bone: Bone) -> bool:
    """Whether it is a bone of a finger or of the toes."""
    return FINGER_BONE.fullmatch(bone.name) is not None


def _edit_bones(armature_object: bpy.types.Object, shape: BodyShape, lift_m: float) -> None:
    skeleton, kept = shape.skeleton, {bone.name for bone in rig_bones(shape)}
    parent_of = {bone.name: bone.parent for bone in skeleton.bones}
    R, head_m = bone_frames(skeleton, shape.lengths_m, np.zeros(len(skeleton.dof_names)))
    view_layer = bpy.context.view_layer
    view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    bones = armature_object.data.edit_bones
    root = bones.new(ROOT)
    root.head, root.tail = (0.0, 0.0, 0.0), (0.0, ROOT_LENGTH_M, 0.0)
    root.align_roll(Vector((0.0, 0.0, 1.0)))
    root.use_deform = False
    for bone, frame, head, length, connected in zip(skeleton.bones, R, head_m, shape.lengths_m, skeleton.starts_at_tail):
        if bone.name not in kept:
            continue
        edit_bone = bones.new(bone.name)
        place = head + (0.0, 0.0, lift_m)
        edit_bone.head, edit_bone.tail = place, place + length * frame[:, 1]
        edit_bone.align_roll(Vector(frame[:, 2]))
        parent = bone.parent
        while parent and parent not in kept:
            parent = parent_of[parent]
        edit_bone.parent = bones[parent or ROOT]
        edit_bone.use_connect = bool(connected) and parent == bone.parent
    bpy.ops.object.mode_set(mode="OBJECT")


def _bone_collections(armature: bpy.types.Armature) -> None:
    """Bone collections and colours: root, trunk, and the limbs of each side, by the bones' names and their ancestors."""
    for bone in armature.bones:
        name = "Root" if bone.name == ROOT else _region(bone)
        (armature.collections.get(name) or armature.collections.new(name)).assign(bone)
        bone.color.palette = PALETTES.get(bone.name[-2:], "THEME09")


def _region(bone: bpy.types.Bone) -> str:
    side = {".R": " right", ".L": " left"}.get(bone.name[-2:])
    if side is None:
        return "Trunk"
    line = {each.name[:-2] for each in (bone, *bone.parent_recursive, *bone.children_recursive) if each.name[-2:] == bone.name[-2:]}
    return ("Arm" if line & {"upper_arm", "forearm"} else "Leg" if line & {"thigh", "shin"} else "Limb") + side


def _free_rotation(pose_bone: bpy.types.PoseBone, bone: Bone) -> None:
    """Unlock the bone's DOFs; their limits become IK limits and a Limit Rotation constraint."""
    pose_bone.rotation_mode = bone.rotation_mode
    if is_finger(bone):
        pose_bone.lock_rotation = (False, False, False)
        return
    dofs = {dof.axis: dof for dof in bone.dofs}
    limit = pose_bone.constraints.new("LIMIT_ROTATION")
    limit.name, limit.owner_space, limit.euler_order = "Joint limits", "LOCAL", bone.rotation_mode
    limit.use_transform_limit = True
    for i, axis in enumerate("xyz"):
        pose_bone.lock_rotation[i] = axis not in dofs
        setattr(pose_bone, f"lock_ik_{axis}", axis not in dofs)
        if axis in dofs and all(isfinite(bound) for bound in dofs[axis].limits):
            low, high = dofs[axis].limits
            setattr(pose_bone, f"use_ik_limit_{axis}", True)
            setattr(pose_bone, f"ik_min_{axis}", min(max(low, -pi), 0.0))
            setattr(pose_bone, f"ik_max_{axis}", max(min(high, pi), 0.0))
            for name, value in ((f"use_limit_{axis}", True), (f"min_{axis}", low), (f"max_{axis}", high)):
                setattr(limit, name, value)
