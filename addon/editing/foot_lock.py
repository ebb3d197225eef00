"""Foot lock on the body's own armature: where a foot stands, inverse kinematics hold its ankle, and it keeps its rotation.

For each foot an empty (*Foot Lock.L*) has the place and rotation of every contact as keys; the constraints of shin and foot follow it with
a keyed influence, which is blended in and out around a contact. All of it can be edited, muted and removed.
"""

from collections.abc import Mapping

import bpy
import numpy as np
from mathutils import Matrix

from ...core.foundation.errors import InputError
from ...core.motion.retarget.contacts import FeetSettings, find_contacts, leg_length, runs, stance
from ...core.motion.retarget.mapping import RigMap
from ...core.motion.retarget.rig import Motion
from ...core.motion.retarget.roles import sided
from ..retarget.apply import map_of
from ..retarget.playing import played_frames
from ..retarget.read import read_motion, read_rig
from ..scene.action import key
from ..scene.standing import bags_of
from .curves import edited_action, motion_curves

LOCK, EMPTY, ACTION = "Foot lock", "Foot Lock", "Foot lock"
ITERATIONS = 500  # of the inverse kinematics
NOTICED_M = 2e-3  # between a foot and its place


def lock_feet(body: bpy.types.Object) -> str:
    """Hold the feet where they stand in the frames that are played; returns a summary.

    Raises:
        InputError: the body has no action or no legs, or no foot stands.
    """
    motion_curves(body)
    remove(body)
    rig = read_rig(body)
    rig_map = map_of(rig)
    motion = read_motion(body, rig, played_frames(bpy.context.scene))
    leg_m = _leg_m(motion, rig_map)
    contacts = find_contacts(motion, rig_map, FeetSettings(), leg_m) if leg_m else None
    if contacts is None:
        raise InputError(f"“{body.name}” has no legs to lock.")
    spans = {side: runs(contacts.ankle[side]) for side in contacts.sides}
    if not any(spans.values()):
        raise InputError("No foot stands on the floor in these frames; nothing to lock.")
    edited_action(body)
    blend = max(1, round(FeetSettings().blend_s * motion.fps))
    for side, standing in spans.items():
        if standing:
            _lock(body, motion, side, rig_map, standing, blend)
    counted = ", ".join(f"foot {side} {len(standing)} times" for side, standing in spans.items())
    return f"Locked: {counted}.{_missed(body, motion, rig_map, spans)}"


def _missed(body: bpy.types.Object, motion: Motion, rig_map: RigMap, spans: Mapping[str, list[tuple[int, int]]]) -> str:
    """A sentence about the frame in which a leg is farthest from reaching its place, "" if all do."""
    rows = sorted({row for standing in spans.values() for a, b in standing for row in range(a, b)})
    now = read_motion(body, motion.rig, [int(motion.frames[row]) for row in rows])
    worst, where = 0.0, 0
    for side, standing in spans.items():
        foot = motion.rig.index[str(rig_map.first(sided("foot", side)))]
        for a, b in standing:
            inside = [i for i, row in enumerate(rows) if a <= row < b]
            off = np.linalg.norm(now.head_m[inside, foot] - np.median(motion.head_m[a:b, foot], axis=0), axis=1)
            if off.max() > worst:
                worst, where = float(off.max()), int(now.frames[inside[int(off.argmax())]])
    return f" In frame {where} a leg is {1e3 * worst:.0f} mm too short; lower the pelvis there." if worst > NOTICED_M else ""


def _leg_m(motion: Motion, rig_map: RigMap) -> float:
    names = {part: rig_map.first(sided(part, "L")) for part in ("thigh", "shin", "foot")}
    found = {part: motion.rig.head_m[motion.rig.index[name]] for part, name in names.items() if name is not None}
    return leg_length(found) if len(found) == len(names) else 0.0


def _lock(body: bpy.types.Object, motion: Motion, side: str, rig_map: RigMap, standing: list[tuple[int, int]], blend: int) -> None:
    foot, shin = rig_map.first(sided("foot", side)), rig_map.bones[sided("shin", side)][-1]
    assert foot is not None
    row = motion.rig.index[foot]
    empty = bpy.data.objects.new(f"{EMPTY}.{side}", None)
    empty.empty_display_type, empty.empty_display_size, empty.rotation_mode = "ARROWS", 0.1, "QUATERNION"
    body.users_collection[0].objects.link(empty)
    begins, influence = _blended(standing, len(motion.frames), blend)
    places = [np.median(motion.head_m[a:b, row], axis=0) for a, b in standing]
    turns = [np.array(Matrix(motion.R[a + stance(motion.R[a:b, row]), row].tolist()).to_quaternion()) for a, b in standing]
    empty.animation_data_create().action = action = bpy.data.actions.new(f"{ACTION} {side}")
    frames = motion.frames[begins]
    for path, values in (("location", places), ("rotation_quaternion", turns)):
        for index, column in enumerate(np.transpose(values)):
            key(action, empty, path, index, frames, column, "CONSTANT")
    chain = len(rig_map.bones[sided("thigh", side)]) + len(rig_map.bones[sided("shin", side)])
    for bone_name, kind in ((shin, "IK"), (foot, "COPY_ROTATION")):
        bone = body.pose.bones[bone_name]
        constraint = bone.constraints.new(kind)
        constraint.name, constraint.target = LOCK, empty
        if kind == "IK":
            constraint.chain_count, constraint.iterations, constraint.use_stretch = chain, ITERATIONS, False
        path = f'{bone.path_from_id()}.constraints["{LOCK}"].influence'
        at, values = motion.frames[list(influence)], np.array(list(influence.values()))
        key(body.animation_data.action, body, path, 0, at, values, group=bone_name)


def _blended(standing: list[tuple[int, int]], count: int, blend: int) -> tuple[list[int], dict[int, float]]:
    """When the place of each contact begins, and the influence by row: one in contacts [first, last + 1), zero in between."""
    begins, influence = [], {0: 0.0}
    for i, (a, b) in enumerate(standing):
        before = max(a - blend, (standing[i - 1][1] + a) // 2 if i else 0, 0)
        after = min(b - 1 + blend, (b + standing[i + 1][0]) // 2 if i + 1 < len(standing) else count - 1, count - 1)
        begins.append(before)
        influence |= {before: influence.get(before, 0.0), a: 1.0, b - 1: 1.0}
        influence.setdefault(after, 0.0)
    return begins, dict(sorted(influence.items()))


def is_locked(body: bpy.types.Object) -> bool:
    """Whether the body has a foot lock, muted or not."""
    return any(LOCK in bone.constraints for bone in body.pose.bones)


def is_active(body: bpy.types.Object) -> bool:
    """Whether the foot lock of the body acts."""
    return any(not bone.constraints[LOCK].mute for bone in body.pose.bones if LOCK in bone.constraints)


def activate(body: bpy.types.Object, active: bool) -> None:
    """Mute the foot lock of the body, or let it act again."""
    for bone in body.pose.bones:
        if LOCK in bone.constraints:
            bone.constraints[LOCK].mute = not active


def remove(body: bpy.types.Object) -> bool:
    """Remove the foot lock of the body with its keys; whether it had one."""
    locked = [bone for bone in body.pose.bones if LOCK in bone.constraints]
    empties = {bone.constraints[LOCK].target for bone in locked} - {None}
    for bone in locked:
        bone.constraints.remove(bone.constraints[LOCK])
    action = body.animation_data.action if body.animation_data is not None else None
    for bag in bags_of(action) if action is not None else ():
        for curve in [curve for curve in bag.fcurves if curve.data_path.endswith(f'constraints["{LOCK}"].influence')]:
            bag.fcurves.remove(curve)
    actions = {empty.animation_data.action for empty in empties if empty.animation_data is not None} - {None}
    bpy.data.batch_remove(empties)
    bpy.data.batch_remove({action for action in actions if action.users == 0})
    return bool(locked)
