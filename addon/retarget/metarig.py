"""A metarig of Rigify in the proportions of a measured body, from which Rigify generates the controls.

The bones have the body's names. Pelvis, spine, chest, neck, head and shoulders get one control each; arms and legs are Rigify's limbs with
IK and FK. A solver of IK needs a bent limb: elbows and knees are moved by BEND_M, so that their bones deviate by about a degree from those
of the body, and are longer by BEND_M² / (2 length), 0.05 mm.
"""

import bpy
import numpy as np
from mathutils import Vector

from ...core.foundation.errors import InputError

BEND_M = 0.005
TOE_M, HEEL_M, HEEL_WIDTH_M = 0.06, 0.05, 0.08
SINGLE = ("pelvis", "spine", "chest", "neck", "head", "shoulder.L", "shoulder.R")  # bones with a control of their own
LIMBS = {"arm": ("upper_arm", "forearm", "hand"), "leg": ("thigh", "shin", "foot")}
PARENTS = {"spine": "pelvis", "chest": "spine", "neck": "chest", "head": "neck", "shoulder": "chest", "arm": "shoulder", "leg": "pelvis"}
PREFIX = "Metarig of "
DRIVE = "BODY-"  # prefix of the bones of a control rig that the body's bones copy


def control_of(bone: str) -> str:
    """The FK control of a bone of the body."""
    part, _, side = bone.partition(".")
    return f"{part}_fk.{side}" if any(part in chain for chain in LIMBS.values()) else bone


def needed_bones() -> tuple[str, ...]:
    """The bones that a body needs for a control rig."""
    return (*SINGLE, *(f"{bone}.{side}" for side in "LR" for bones in LIMBS.values() for bone in bones))


def add_metarig(body: bpy.types.Object, collection: bpy.types.Collection) -> bpy.types.Object:
    """The metarig of a body, in the body's own space.

    Raises:
        InputError: the body lacks a bone.
    """
    missing = [name for name in needed_bones() if name not in body.data.bones]
    if missing:
        raise InputError(f"A control rig needs a whole body, and “{body.name}” has no bone “{missing[0]}”.")
    metarig = bpy.data.objects.new(PREFIX + body.name, bpy.data.armatures.new(PREFIX + body.name))
    collection.objects.link(metarig)
    bpy.context.view_layer.objects.active = metarig
    bpy.ops.object.mode_set(mode="EDIT")
    for name in SINGLE:
        part, _, side = name.partition(".")
        parent = PARENTS.get(part, "")
        _copy(metarig, body, name, parent)
    for side in "LR":
        for limb, chain in LIMBS.items():
            parent = PARENTS[limb] if limb == "leg" else f"{PARENTS[limb]}.{side}"
            for bone in chain:
                _copy(metarig, body, f"{bone}.{side}", parent, connected=bone != chain[0])
                parent = f"{bone}.{side}"
            _bend(metarig, *(f"{bone}.{side}" for bone in chain[:2]))
        _add_toe_and_heel(metarig, side)
    bpy.ops.object.mode_set(mode="OBJECT")
    _set_types(metarig)
    return metarig


def _copy(metarig: bpy.types.Object, body: bpy.types.Object, name: str, parent: str, *, connected: bool = False) -> None:
    bone, rest = metarig.data.edit_bones.new(name), body.data.bones[name]
    bone.head, bone.tail = rest.head_local, rest.tail_local
    bone.align_roll(Vector(rest.matrix_local.col[2][:3]))
    if parent:
        bone.parent = metarig.data.edit_bones[parent]
    bone.use_connect = connected


def _bend(metarig: bpy.types.Object, upper: str, lower: str) -> None:
    """Move the joint between two bones against the direction of positive flexion, which is the z axis of the lower bone."""
    bones = metarig.data.edit_bones
    joint = bones[upper].tail - BEND_M * bones[lower].z_axis
    bones[upper].tail = bones[lower].head = joint


def _add_toe_and_heel(metarig: bpy.types.Object, side: str) -> None:
    bones = metarig.data.edit_bones
    foot = bones[f"foot.{side}"]
    forward = Vector((foot.vector.x, foot.vector.y, 0.0)).normalized()
    toe, heel = bones.new(f"toe.{side}"), bones.new(f"heel.02.{side}")
    toe.head, toe.tail, toe.parent, toe.use_connect = foot.tail, foot.tail + TOE_M * forward, foot, True
    back = Vector((foot.head.x, foot.head.y, 0.0)) - HEEL_M * forward
    across = 0.5 * HEEL_WIDTH_M * Vector((1.0, 0.0, 0.0))
    heel.head, heel.tail, heel.parent = back - across, back + across, foot


def _set_types(metarig: bpy.types.Object) -> None:
    for row, name in enumerate(("Torso", "Arm.L", "Arm.R", "Leg.L", "Leg.R"), 1):
        collection = metarig.data.collections.new(name)
        collection.rigify_ui_row = row
        side, limb = name[-2:], LIMBS.get(name[:-2].lower())
        for bone in metarig.data.bones:
            part = bone.name[:-2] if bone.name.endswith((".L", ".R")) else bone.name
            if (bone.name in SINGLE) if limb is None else bone.name.endswith(side) and (part in limb or _is_foot(part) and "Leg" in name):
                collection.assign(bone)
    for name in SINGLE:
        bone = metarig.pose.bones[name]
        bone.rigify_type = "basic.super_copy"
        bone.rigify_parameters.super_copy_widget_type = "circle" if name != "pelvis" else "cube"
    for side in "LR":
        for limb, chain in LIMBS.items():
            bone = metarig.pose.bones[f"{chain[0]}.{side}"]
            bone.rigify_type = f"limbs.{limb}"
            bone.rigify_parameters.segments = bone.rigify_parameters.bbones = 1


def _is_foot(part: str) -> bool:
    return part in ("toe", "heel.02")


def bent(rig: bpy.types.Object, body: bpy.types.Object, name: str) -> np.ndarray:
    """A (3, 3): rotates the rest direction of the control rig's bone to that of the body's."""
    here, there = (np.array(o.data.bones[bone].matrix_local)[:3, 1] for o, bone in ((body, name), (rig, f"ORG-{name}")))
    return np.array(Vector(there).rotation_difference(Vector(here)).to_matrix())
