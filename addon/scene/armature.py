"""The armature: the skeleton in its rest pose, with pose channels that ARE the degrees of freedom.

Blender's pose of a bone is  M_bone = M_parent · Rest_rel · Euler(channels in its rotation mode), which is equation (1) of
core.body.skeleton. So a bone gets the skeleton's rest frame (y from head to tail) and rotation mode, and its Euler channels are
the angles of the DOFs; channels without a DOF are locked. The base of the model is a bone of its own, `root`, with the world's
axes at the world's origin: its location channels are the base DOFs in metres.
"""

from math import isfinite, pi

import bpy
import numpy as np
from mathutils import Vector

from ...core.body.shape import BodyShape
from ...core.body.skeleton import Bone, Dof, bone_frames
from ...core.motion.retarget.roles import model_roles

ROOT = "root"
ROOT_LENGTH_M = 0.1
NAME = "Body"
ROLES_KEY = "tricap_roles"  # custom property of armature data: the bone of each part of the body
JOINTS_KEY = "tricap_joints"  # custom property of armature data: by joint, a bone that begins or ends there


def add_armature(collection: bpy.types.Collection, shape: BodyShape) -> bpy.types.Object:
    """An armature object in the rest pose of the person's skeleton, in object mode, pose channels ready to be keyed."""
    armature = bpy.data.armatures.new(NAME)
    armature.display_type = "STICK"
    armature_object = bpy.data.objects.new(NAME, armature)
    armature_object.show_in_front = True
    armature[ROLES_KEY] = model_roles(bone.name for bone in shape.skeleton.bones)
    skeleton = shape.skeleton
    ends = [{"bone": skeleton.bones[b].name, "at_tail": at_tail} for b, at_tail in skeleton.joint_bones]
    armature[JOINTS_KEY] = dict(zip(skeleton.joint_names, ends))
    collection.objects.link(armature_object)
    _edit_bones(armature_object, shape)
    _bone_collections(armature)
    for pose_bone in armature_object.pose.bones:
        pose_bone.lock_location = pose_bone.lock_rotation = pose_bone.lock_scale = (True, True, True)
    _free_base(armature_object.pose.bones[ROOT], shape.skeleton.base_dofs)
    for bone in shape.skeleton.bones:
        _free_rotation(armature_object.pose.bones[bone.name], bone)
    return armature_object


def channel_of(shape: BodyShape) -> dict[str, tuple[str, str, int]]:
    """The channel of each DOF: its name -> (bone, "location" or "rotation_euler", index)."""
    channels = {dof.name: (ROOT, "location", "xyz".index(dof.axis)) for dof in shape.skeleton.base_dofs}
    for bone in shape.skeleton.bones:
        channels |= {dof.name: (bone.name, "rotation_euler", "xyz".index(dof.axis)) for dof in bone.dofs}
    return channels


def _edit_bones(armature_object: bpy.types.Object, shape: BodyShape) -> None:
    skeleton = shape.skeleton
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
        edit_bone = bones.new(bone.name)
        edit_bone.head, edit_bone.tail = head, head + length * frame[:, 1]
        edit_bone.align_roll(Vector(frame[:, 2]))
        edit_bone.parent = bones[bone.parent or ROOT]
        edit_bone.use_connect = bool(connected)
    bpy.ops.object.mode_set(mode="OBJECT")


def _bone_collections(armature: bpy.types.Armature) -> None:
    """Bone collections: base, trunk, and the limbs of each side, by the bones' names and their ancestors."""
    for bone in armature.bones:
        name = "Base" if bone.name == ROOT else _region(bone)
        (armature.collections.get(name) or armature.collections.new(name)).assign(bone)


def _region(bone: bpy.types.Bone) -> str:
    side = {".R": " right", ".L": " left"}.get(bone.name[-2:])
    if side is None:
        return "Trunk"
    line = {each.name[:-2] for each in (bone, *bone.parent_recursive, *bone.children_recursive) if each.name[-2:] == bone.name[-2:]}
    return ("Arm" if line & {"upper_arm", "forearm"} else "Leg" if line & {"thigh", "shin"} else "Limb") + side


def _free_base(root: bpy.types.PoseBone, dofs: tuple[Dof, ...]) -> None:
    root.rotation_mode = "XYZ"
    for dof in dofs:
        root.lock_location["xyz".index(dof.axis)] = False


def _free_rotation(pose_bone: bpy.types.PoseBone, bone: Bone) -> None:
    """Unlock the bone's DOFs; their limits become IK limits and a Limit Rotation constraint."""
    pose_bone.rotation_mode = bone.rotation_mode
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
