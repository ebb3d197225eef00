"""A metarig of Rigify in the proportions of a measured body, from which Rigify generates the controls.

The bones have the body's names. Pelvis, spine, chest, neck, head and shoulders get one control each; arms and legs are Rigify's limbs with
IK and FK. A solver of IK needs a bent limb: elbows and knees are moved by BEND_M, so that their bones deviate by about a degree from those
of the body, and are longer by BEND_M² / (2 length), 0.05 mm. A foot ends where the body's toes begin, so that they turn about the ball.

A finger has a control for each bone, whose rotation the body's bone copies, and a master: its scale along y curls the finger. Rigify's own
bones of a finger, which it stretches from control to control, do not have the twist of the first control; they are removed.
"""

import bpy
import numpy as np
from mathutils import Vector

from ...core.foundation.errors import InputError

BEND_M = 0.005
TOE_M, HEEL_M, HEEL_WIDTH_M = 0.06, 0.05, 0.08
SINGLE = ("pelvis", "spine", "chest", "neck", "head", "shoulder.L", "shoulder.R")  # bones with a control of their own
LIMBS = {"arm": ("upper_arm", "forearm", "hand"), "leg": ("thigh", "shin", "foot")}
FINGERS = ("thumb", "f_index", "f_middle", "f_ring", "f_pinky")  # of three bones: thumb.01.R to thumb.03.R
PARENTS = {"spine": "pelvis", "chest": "spine", "neck": "chest", "head": "neck", "shoulder": "chest", "arm": "shoulder", "leg": "pelvis"}
PREFIX = "Metarig of "
DRIVE = "BODY-"  # prefix of the bones of a control rig that the body's bones copy


def control_of(bone: str) -> str:
    """The FK control of a bone of the body."""
    part, _, side = bone.partition(".")
    return f"{part}_fk.{side}" if any(part in chain for chain in LIMBS.values()) else bone


def master_of(limb: str) -> str:
    """The bone with the switches of a limb ("thigh.L", its first bone), such as that between IK and FK."""
    part, _, side = limb.partition(".")
    return f"{part}_parent.{side}"


def needed_bones() -> tuple[str, ...]:
    """The bones that a body needs for a control rig."""
    return (*SINGLE, *(f"{bone}.{side}" for side in "LR" for bones in LIMBS.values() for bone in bones))


def fingers_of(body: bpy.types.Object, side: str) -> list[tuple[str, ...]]:
    """The bones of each finger that a body has."""
    chains = [tuple(f"{finger}.0{k}.{side}" for k in (1, 2, 3)) for finger in FINGERS]
    return [chain for chain in chains if all(name in body.data.bones for name in chain)]


def digits_of(body: bpy.types.Object) -> tuple[str, ...]:
    """The bones of a body's fingers and toes, parents first; none of a body without a modelled skin."""
    toes = [name for name in ("toe.L", "toe.R") if name in body.data.bones]
    return (*(name for side in "LR" for chain in fingers_of(body, side) for name in chain), *toes)


def driven_bones(body: bpy.types.Object) -> tuple[str, ...]:
    """The bones of a body, below its root, that copy those of a control rig."""
    return (*needed_bones(), *digits_of(body))


def unused_bones(rig: bpy.types.Object, body: bpy.types.Object) -> list[str]:
    """The bones of a generated rig's fingers that move nothing: those that stretch, and the controls of the tips that they end at."""
    chains = [chain for side in "LR" for chain in fingers_of(body, side)]
    names = [f"{prefix}{name}" for chain in chains for name in chain for prefix in ("ORG-", "MCH-", "DEF-")]
    return [name for name in (*names, *(f"{chain[0]}.001" for chain in chains)) if name in rig.data.bones]


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
        _add_toe_and_heel(metarig, body, side)
        for finger in fingers_of(body, side):
            for name, parent in zip(finger, (f"hand.{side}", *finger)):
                _copy(metarig, body, name, parent, connected=name != finger[0])
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


def _add_toe_and_heel(metarig: bpy.types.Object, body: bpy.types.Object, side: str) -> None:
    bones, own = metarig.data.edit_bones, body.data.bones.get(f"toe.{side}")
    foot = bones[f"foot.{side}"]
    if own is not None:
        foot.tail = own.head_local
    forward = Vector((foot.vector.x, foot.vector.y, 0.0)).normalized()
    toe, heel = bones.new(f"toe.{side}"), bones.new(f"heel.02.{side}")
    toe.head, toe.tail = foot.tail, foot.tail + TOE_M * forward if own is None else own.tail_local
    toe.parent, toe.use_connect = foot, True
    back = Vector((foot.head.x, foot.head.y, 0.0)) - HEEL_M * forward
    across = 0.5 * HEEL_WIDTH_M * Vector((1.0, 0.0, 0.0))
    heel.head, heel.tail, heel.parent = back - across, back + across, foot


def _set_types(metarig: bpy.types.Object) -> None:
    for row, name in enumerate(dict.fromkeys(_group(bone.name) for bone in metarig.data.bones), 1):
        collection = metarig.data.collections.new(name)
        collection.rigify_ui_row = row
        for bone in metarig.data.bones:
            if _group(bone.name) == name:
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
        for finger in fingers_of(metarig, side):
            bone = metarig.pose.bones[finger[0]]
            bone.rigify_type = "limbs.super_finger"
            bone.rigify_parameters.primary_rotation_axis, bone.rigify_parameters.bbones = "X", 1  # the body's fingers flex about x


def _group(name: str) -> str:
    """The bone collection of a bone of the metarig."""
    part, side = name.split(".")[0], name[-2:]
    if part in FINGERS:
        return f"Fingers{side}"
    limb = next((limb for limb, chain in LIMBS.items() if part in chain or (limb == "leg" and part in ("toe", "heel"))), "")
    return f"{limb.capitalize()}{side}" if limb else "Torso"


def bent(rig: bpy.types.Object, body: bpy.types.Object, name: str) -> np.ndarray:
    """A (3, 3): rotates the rest direction of the control rig's bone to that of the body's, where the metarig moved the joint between two
    bones. Other controls rotate as the body's bones, whatever their direction."""
    if not any(name[:-2] in chain[:2] for chain in LIMBS.values()):
        return np.eye(3)
    here, there = (np.array(o.data.bones[bone].matrix_local)[:3, 1] for o, bone in ((body, name), (rig, f"ORG-{name}")))
    return np.array(Vector(there).rotation_difference(Vector(here)).to_matrix())
