"""Builds an armature with an action from plain values, for exporters of a motion that is not an armature yet."""

import bpy
import numpy as np
from mathutils import Vector

from ...core.foundation.errors import InputError
from ...core.motion.retarget.retarget import Retargeted
from ...core.motion.retarget.rig import Motion, Rig, channels, head_of
from .apply import set_range
from .write import write_action

SHORTEST_M = 1e-4  # of a bone that an armature can have
LONGEST_NAME = 63
LOOSE = 5e-6  # by the rig's size: a head that moves less relative to its parent is rigidly attached


def build_armature(motion: Motion, name: str) -> bpy.types.Object:
    """An armature object in the open scene that plays the motion; the scene gets its frames and rate.

    Raises:
        InputError: a bone has no length, or a name of more than 63 bytes.
    """
    rig, scene = motion.rig, bpy.context.scene
    armature_object = armature_of_rig(rig, name, scene.collection)
    set_range(scene, motion)
    basis, driven = channels(rig, motion.R), np.ones(len(rig.names), dtype=bool)
    first = int(np.flatnonzero(rig.parents < 0)[0])
    shift_m = motion.head_m[:, first] - rig.head_m[first]
    write_action(
        armature_object,
        Retargeted(
            motion=motion,
            basis=basis,
            shift_m=shift_m,
            carrier=first,
            loose_m=loose_shifts(motion, first),
            driven=driven,
            scale=1.0,
            roles=(),
            contacts=None,
            notes=(),
            removed_travel_m=0.0 * shift_m,
        ),
        name,
    )
    return armature_object


def armature_of_rig(rig: Rig, name: str, collection: bpy.types.Collection) -> bpy.types.Object:
    """An armature object with the bones of a rig, which becomes the active one.

    Raises:
        InputError: a bone has no length, or a name of more than 63 bytes.
    """
    armature = bpy.data.armatures.new(name)
    armature_object = bpy.data.objects.new(name, armature)
    collection.objects.link(armature_object)
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    for b, bone_name in enumerate(rig.names):
        length = float(np.linalg.norm(rig.tail_m[b] - rig.head_m[b]))
        if length < SHORTEST_M:
            bpy.ops.object.mode_set(mode="OBJECT")
            raise InputError(f"The bone “{bone_name}” has no length; give it one in the source.")
        if len(bone_name.encode()) > LONGEST_NAME:
            bpy.ops.object.mode_set(mode="OBJECT")
            raise InputError(
                f"The bone “{bone_name[:40]}…” has a longer name than Blender allows, {LONGEST_NAME} bytes; shorten it in the source."
            )
        bone = armature.edit_bones.new(bone_name)
        bone.head, bone.tail = rig.head_m[b], rig.head_m[b] + length * rig.R_rest[b][:, 1]
        bone.align_roll(Vector(rig.R_rest[b][:, 2]))
        if rig.parents[b] >= 0:
            bone.parent = armature.edit_bones[rig.names[rig.parents[b]]]
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature_object


def loose_shifts(motion: Motion, carrier: int) -> dict[int, np.ndarray]:
    """By bone, how far (T, 3) its head moves in the world relative to its parent, or a root other than `carrier` from its rest."""
    rig, shifts = motion.rig, dict[int, np.ndarray]()
    smallest = LOOSE * float(np.ptp(np.concatenate([rig.head_m, rig.tail_m]), axis=0).max())
    for b in range(len(rig.names)):
        shift_m = motion.head_m[:, b] - head_of(rig, motion.R, motion.head_m, b)
        if b != carrier and float(np.abs(shift_m).max()) > smallest:
            shifts[b] = shift_m
    return shifts
