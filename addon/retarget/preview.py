"""A live preview: the target follows the source by constraints, before anything is baked.

Each part of the target follows an empty parented to the source's bone, rotated by the difference of the two rest poses:

    R_t = R_s · K,   K = R_s,restᵀ · A · R_t,rest                      (2) of core.motion.retarget.transfer

The hips follow an empty driven by the source's hips, scaled. Feet are not planted in the preview. Removing it restores the rig.
"""

import bpy
import numpy as np
from mathutils import Matrix

from ...core.foundation.errors import InputError
from ...core.motion.retarget.mapping import MappedRig, RigMap
from ...core.motion.retarget.retarget import leg_ratio, nothing_in_common
from ...core.motion.retarget.roles import part_of
from ...core.motion.retarget.transfer import alignments, untwisted_bone, with_offsets
from ..scene import stored

NAME = "Tricap preview"
EARLIER_KEY = "tricap_before_preview"  # custom property of the target: the earlier values of its controls' properties


def add_preview(source: bpy.types.Object, source_rig: MappedRig, target: bpy.types.Object, target_rig: MappedRig) -> int:
    """Constrain the target to the source; the number of bones that follow.

    Raises:
        InputError: source and target have no part of the body in common.
    """
    remove_preview(target)
    aligned = with_offsets(alignments(source_rig, target_rig), target_rig)
    if not aligned:
        raise InputError(nothing_in_common(source_rig.map, target_rig.map))
    collection = bpy.data.collections.new(NAME)
    bpy.context.scene.collection.children.link(collection)
    count = 0
    for role, A in aligned.items():
        follows = untwisted_bone(source_rig.map.bones[role], role)
        R_s = source_rig.rig.R_rest[source_rig.rig.index[follows]]
        chain = target_rig.map.bones[role]
        for bone in chain if part_of(role) not in ("hand", "neck", "spine") else chain[-1:]:
            K = R_s.T @ A @ target_rig.rig.R_rest[target_rig.rig.index[bone]]
            _follow(target.pose.bones[bone], _empty(collection, source, follows, K, f"{NAME} {bone}"))
            count += 1
    if "hips" in aligned:
        hips = source_rig.map.bones["hips"][0], target_rig.map.bones["hips"][0]
        _drive_hips(collection, source, hips[0], target, hips[1], leg_ratio(source_rig, target_rig))
    _set_control_properties(target, target_rig.map)
    collection.hide_viewport = collection.hide_render = True
    return count


def remove_preview(target: bpy.types.Object) -> int:
    """Remove the preview's constraints and empties; returns the number of constraints."""
    count = 0
    for bone in target.pose.bones:
        for constraint in [c for c in bone.constraints if c.name.startswith(NAME)]:
            bone.constraints.remove(constraint)
            count += 1
    for name, values in stored.rows(target, EARLIER_KEY).items():
        for key, value in values.items() if name in target.pose.bones else ():
            target.pose.bones[name][key] = value
    target.pop(EARLIER_KEY, None)
    if not any(c.name.startswith(NAME) for o in bpy.data.objects if o.type == "ARMATURE" for b in o.pose.bones for c in b.constraints):
        for collection in [c for c in bpy.data.collections if c.name.startswith(NAME)]:
            bpy.data.batch_remove(list(collection.objects))
            bpy.data.collections.remove(collection)
    return count


def _set_control_properties(target: bpy.types.Object, rig_map: RigMap) -> None:
    """Set the properties with which the controls drive the rig (FK instead of IK), and store their values."""
    earlier: dict[str, dict[str, float]] = {}
    for name, values in rig_map.control_rig.properties.items() if rig_map.control_rig is not None else ():
        bone = target.pose.bones.get(name)
        for key, value in values.items() if bone is not None else ():
            if key in bone:
                earlier.setdefault(name, {})[key] = bone[key]
                bone[key] = type(bone[key])(value)
    if earlier:
        target[EARLIER_KEY] = earlier
        target.update_tag()


def _empty(collection: bpy.types.Collection, source: bpy.types.Object, bone: str, K: np.ndarray, name: str) -> bpy.types.Object:
    """An empty parented to a bone of the source, where it sits at the tail."""
    empty = bpy.data.objects.new(name, None)
    collection.objects.link(empty)
    empty.parent, empty.parent_type, empty.parent_bone = source, "BONE", bone
    empty.matrix_basis = Matrix(K).to_4x4()
    return empty


def _follow(bone: bpy.types.PoseBone, empty: bpy.types.Object) -> None:
    constraint = bone.constraints.new("COPY_ROTATION")
    constraint.name, constraint.target = NAME, empty
    constraint.target_space = constraint.owner_space = "WORLD"


def _drive_hips(
    collection: bpy.types.Collection, source: bpy.types.Object, source_hips: str, target: bpy.types.Object, hips: str, scale: float
) -> None:
    """The location of the hips: the source's, times the ratio of the leg lengths, by drivers."""
    empty = bpy.data.objects.new(f"{NAME} place", None)
    collection.objects.link(empty)
    for i, axis in enumerate("XYZ"):
        driver = empty.driver_add("location", i).driver
        driver.type = "SCRIPTED"
        variable = driver.variables.new()
        variable.name, variable.type = "p", "TRANSFORMS"
        variable.targets[0].id, variable.targets[0].bone_target = source, source_hips
        variable.targets[0].transform_type, variable.targets[0].transform_space = f"LOC_{axis}", "WORLD_SPACE"
        driver.expression = f"p * {scale!r}"
    constraint = target.pose.bones[hips].constraints.new("COPY_LOCATION")
    constraint.name, constraint.target = NAME, empty
