"""Foot lock on the body's own armature: where a foot stands, inverse kinematics hold its ankle, and it keeps its rotation.

For each foot an empty (*Foot Lock.L*) has the place and rotation of every contact as keys; the constraints of shin and foot follow it with
a keyed influence, which is blended in and out around a contact. Where a leg is too short for that, because the measured knee is straight or
beyond, another empty (*Foot Lock.Pelvis*) lowers the pelvis by some millimetres:

    d_t = h_z − g_z − √(L² − (h − g)²_xy)                                                                            (1)

with the hip h, the place g of the ankle, and the length L of a leg whose knee is bent by `LEAST_BEND`. All of it can be edited, muted and
removed.
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
from ..retarget.playing import keyed_frames
from ..retarget.read import read_motion, read_rig
from ..scene import built
from ..scene.action import key
from ..scene.action_curves import bags_of
from ..scene.standing import all_bodies, controls_of_body, dofs_of
from .curves import edited_action, motion_curves

LOCK, EMPTY, ACTION = "Foot lock", "Foot Lock", "Foot lock"
BEND = f"{LOCK}: bent knee"
ITERATIONS = 500  # of the inverse kinematics
NOTICED_M = 2e-3  # between a foot and its place
PELVIS = "Pelvis"  # of the name of the empty that lowers it
LEAST_BEND = np.radians(8.0)  # of a knee: inverse kinematics do not reach the place of a straight leg
MOST_LOWERED_M = 0.05


def lock_feet(body: bpy.types.Object) -> str:
    """Hold the feet where they stand in the frames that are played; returns a summary.

    Raises:
        InputError: the body has no action or no legs, or no foot stands.
    """
    motion_curves(body)
    remove(body)
    rig = read_rig(body)
    rig_map = map_of(rig)
    motion = read_motion(body, rig, keyed_frames(body))
    leg_m = _leg_m(motion, rig_map)
    contacts = find_contacts(motion, rig_map, FeetSettings(), leg_m) if leg_m else None
    if contacts is None:
        raise InputError(f"“{body.name}” has no legs to lock.")
    spans = {side: runs(contacts.ankle[side]) for side in contacts.sides}
    if not any(spans.values()):
        raise InputError("No foot stands on the floor in these frames; nothing to lock.")
    blend = max(1, round(FeetSettings().blend_s * motion.fps))
    with built.no_edit([edited_action(body)]):
        for side, standing in spans.items():
            if standing:
                _lock(body, motion, side, rig_map, standing, blend)
    lowered = _lower_pelvis(body, motion, rig_map, spans, blend)
    counted = ", ".join(f"foot {side} {len(standing)} times" for side, standing in spans.items())
    built.mark_actions(action for lock in _empties(body) for action in built.actions_of(lock))
    less = f" The pelvis is lowered by up to {1e3 * lowered:.0f} mm, so that straight legs reach." if lowered else ""
    return f"Locked: {counted}.{less}{_missed(body, motion, rig_map, spans)}"


def _lower_pelvis(body: bpy.types.Object, motion: Motion, rig_map: RigMap, spans: Mapping[str, list[tuple[int, int]]], blend: int) -> float:
    """Lower the pelvis where a locked leg is too short; by how much at most [m].  (1)"""
    needed = np.zeros(len(motion.frames))
    for side, standing in spans.items():
        thigh, shin, foot = (motion.rig.index[str(rig_map.first(sided(part, side)))] for part in ("thigh", "shin", "foot"))
        a, b = (float(np.linalg.norm(motion.rig.head_m[i] - motion.rig.head_m[j])) for i, j in ((shin, thigh), (foot, shin)))
        leg_m = float(np.sqrt(a**2 + b**2 + 2 * a * b * np.cos(LEAST_BEND)))
        for first, last in standing:
            away = motion.head_m[first:last, thigh] - np.median(motion.head_m[first:last, foot], axis=0)
            below = np.sqrt(np.maximum(leg_m**2 - (away[:, :2] ** 2).sum(axis=1), 0.0))
            needed[first:last] = np.maximum(needed[first:last], away[:, 2] - below)
    needed = np.clip(needed, 0.0, MOST_LOWERED_M)
    if needed.max() < NOTICED_M / 4:
        return 0.0
    lowered, pelvis = smoothly_above(needed, blend), rig_map.first("hips")
    assert pelvis is not None
    empty = _empty(body, PELVIS)
    for index in range(3):
        key(empty.animation_data.action, empty, "location", index, motion.frames, -lowered if index == 2 else 0.0 * lowered)
    constraint = body.pose.bones[pelvis].constraints.new("COPY_LOCATION")
    constraint.name, constraint.target, constraint.use_offset = LOCK, empty, True
    return float(lowered.max())


def smoothly_above(values: np.ndarray, reach: int) -> np.ndarray:
    """A smooth curve (T,) that is nowhere below some values (T,): the mean of their largest within `reach` frames to both sides."""

    def around(of: np.ndarray) -> np.ndarray:
        return np.lib.stride_tricks.sliding_window_view(np.pad(of, reach, mode="edge"), 2 * reach + 1)

    return np.asarray(around(around(values).max(axis=1)).mean(axis=1))


def _empty(body: bpy.types.Object, name: str) -> bpy.types.Object:
    """An empty of the foot lock with an action of its own."""
    empty = bpy.data.objects.new(f"{EMPTY}.{name}", None)
    empty.empty_display_type, empty.empty_display_size, empty.rotation_mode = "ARROWS", 0.1, "QUATERNION"
    body.users_collection[0].objects.link(empty)
    built.mark_name(empty)
    empty.animation_data_create().action = bpy.data.actions.new(f"{ACTION} {name}")
    return empty


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
    empty = _empty(body, side)
    begins, influence = _blended(standing, len(motion.frames), blend)
    places = [np.median(motion.head_m[a:b, row], axis=0) for a, b in standing]
    turns = [np.array(Matrix(motion.R[a + stance(motion.R[a:b, row]), row].tolist()).to_quaternion()) for a, b in standing]
    action, frames = empty.animation_data.action, motion.frames[begins]
    for path, values in (("location", places), ("rotation_quaternion", turns)):
        for index, column in enumerate(np.transpose(values)):
            key(action, empty, path, index, frames, column, "CONSTANT")
    chain = len(rig_map.bones[sided("thigh", side)]) + len(rig_map.bones[sided("shin", side)])
    for bone_name, kind, name in ((shin, "LIMIT_ROTATION", BEND), (shin, "IK", LOCK), (foot, "COPY_ROTATION", LOCK)):
        bone = body.pose.bones[bone_name]
        constraint = bone.constraints.new(kind)
        constraint.name = name
        if kind == "LIMIT_ROTATION":
            _limit_bend(body, constraint, f"knee.{side} flexion")
        else:
            constraint.target = empty
        if kind == "IK":
            constraint.chain_count, constraint.iterations, constraint.use_stretch = chain, ITERATIONS, False
        path = f'{bone.path_from_id()}.constraints["{name}"].influence'
        at, values = motion.frames[list(influence)], np.array(list(influence.values()))
        key(body.animation_data.action, body, path, 0, at, values, group=bone_name)


def _limit_bend(body: bpy.types.Object, limit: bpy.types.LimitRotationConstraint, dof: str) -> None:
    """Bend a knee that is straight or overextended: from there inverse kinematics would bend it further the wrong way, or not at all."""
    channel = dofs_of(body).get(dof)
    if channel is None:
        return
    axis, bone = "xyz"[channel["index"]], body.pose.bones[channel["bone"]]
    limit.owner_space, limit.euler_order = "LOCAL", bone.rotation_mode
    setattr(limit, f"use_limit_{axis}", True)
    setattr(limit, f"min_{axis}", LEAST_BEND)
    setattr(limit, f"max_{axis}", np.pi)


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


def _locks(body: bpy.types.Object) -> list[tuple[bpy.types.PoseBone, bpy.types.Constraint]]:
    """The constraints of the foot lock of a body, each with its bone."""
    return [(bone, constraint) for bone in body.pose.bones for constraint in bone.constraints if constraint.name.startswith(LOCK)]


def _empties(body: bpy.types.Object) -> set[bpy.types.Object]:
    """The objects that the foot lock of a body follows."""
    targets = (getattr(constraint, "target", None) for _, constraint in _locks(body))
    return {target for target in targets if target is not None}


def is_locked(body: bpy.types.Object) -> bool:
    """Whether the body has a foot lock, muted or not."""
    return bool(_locks(body))


def is_active(body: bpy.types.Object) -> bool:
    """Whether the foot lock of the body acts."""
    return any(not constraint.mute for _, constraint in _locks(body))


def activate(body: bpy.types.Object, active: bool) -> None:
    """Mute the foot lock of the body, or let it act again."""
    for _, constraint in _locks(body):
        constraint.mute = not active


def activate_all(scene: bpy.types.Scene, active: bool) -> None:
    """Let the foot lock of the scene's bodies act, or mute it.

    Raises:
        InputError: a control rig drives a body, and the foot lock would act on top of it.
    """
    for body in all_bodies(scene):
        rig = controls_of_body(body)
        if rig is not None and active and is_locked(body):
            raise InputError(f"“{rig.name}” drives “{body.name}” and plays the locked feet; delete it to let the foot lock act again.")
    for body in all_bodies(scene):
        activate(body, active)


def remove(body: bpy.types.Object) -> bool:
    """Remove the foot lock of the body with its keys; whether it had one."""
    locks, empties = _locks(body), _empties(body)
    for bone, constraint in locks:
        bone.constraints.remove(constraint)
    action = body.animation_data.action if body.animation_data is not None else None
    with built.no_edit([action] if action is not None else []):
        for bag in bags_of(action) if action is not None else ():
            for curve in [curve for curve in bag.fcurves if f'.constraints["{LOCK}' in curve.data_path]:
                bag.fcurves.remove(curve)
    actions = {empty.animation_data.action for empty in empties if empty.animation_data is not None} - {None}
    bpy.data.batch_remove(empties)
    bpy.data.batch_remove({action for action in actions if action.users == 0})
    return bool(locks)
