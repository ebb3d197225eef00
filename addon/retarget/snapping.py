"""Limbs of a control rig change between IK and FK without moving the body, by the operators of Rigify's own script."""

import re
from collections.abc import Sequence
from math import atan2

import bpy
from mathutils import Matrix, Vector

from ...core.foundation.errors import InputError
from ..scene import stored
from ..scene.armature import SNAPS_KEY
from ..scene.standing import controls_of_body
from . import metarig
from .metarig import DRIVE, control_of

MOST_TURNS, SMALLEST_TURN_RAD = 6, 1e-5  # of the base of an IK limb, until its middle joint is where it was
NEEDED = {"ctrl_bones", "tail_bones"}  # of the arguments of Rigify's snapping


def snaps_of(rig: bpy.types.Object) -> dict[str, dict[str, dict[str, str]]]:
    """By limb and target ("IK", "FK"), the arguments of Rigify's snapping, from the script of the rig's panel."""
    text = next(t.as_string() for t in bpy.data.texts if str(rig.data["rig_id"]) in t.as_string())
    found: dict[str, dict[str, dict[str, str]]] = {}
    kinds = {f"pose.rigify_generic_snap_{rig.data['rig_id']}": "FK", f"pose.rigify_limb_ik2fk_{rig.data['rig_id']}": "IK"}
    for operator, lines in re.findall(r"operator\('(pose\.rigify_\w+)'[^\n]*\n((?:\s+props\.\w+ = '[^\n]*'\n)+)", text):
        given = dict(re.findall(r"props\.(\w+) = '([^\n]*)'", lines))
        chain = given.get("fk_bones") or given.get("output_bones", "")
        if operator in kinds and "_fk." in chain:
            found.setdefault(_names(chain)[0].replace("_fk", ""), {})[kinds[operator]] = given
    return found


def _names(listed: str) -> list[str]:
    """The names in a list of Rigify: '["hand_ik.L", "foot_ik.L"]'."""
    return re.findall(r'"([^"]+)"', listed)


def snap(body: bpy.types.Object, to: str, limbs: Sequence[str] = ()) -> int:
    """Let the IK controls of limbs take up the pose of FK, or the reverse, in the current frame, and switch to them; the number of limbs.

    The body does not move: what a hinge of IK cannot do (the twist of a forearm) is stored in the bones that the body copies. With Auto
    Keying, the controls are keyed. `to`: "IK" or "FK"; `limbs`: names such as "upper_arm.L", "thigh.R"; empty for all four.

    Raises:
        InputError: the body has no control rig, the rig is hidden, there is no such limb, or the script of the rig does not run.
    """
    rig = controls_of_body(body)
    if rig is None:
        raise InputError(f"“{body.name}” has no control rig; press Make Control Rig first.")
    if not rig.visible_get():
        raise InputError(f"The control rig “{rig.name}” is hidden; show it first.")
    known = {name: row["IK"] for name, row in stored.rows(rig, SNAPS_KEY, IK=dict).items() if _is_limb(name) and NEEDED <= row["IK"].keys()}
    if not known:
        raise InputError(f"The limbs of the control rig “{rig.name}” are not stored in it; delete it, and make it again.")
    unknown = [limb for limb in limbs if limb not in known]
    if unknown:
        raise InputError(f"There is no limb “{unknown[0]}”; choose among {', '.join(known)}.")
    for limb in limbs or tuple(known):
        (_snap_to_ik if to == "IK" else _snap_to_fk)(rig, body, limb, known[limb])
        if bpy.context.scene.tool_settings.use_keyframe_insert_auto:
            _key_limb(rig, limb, known[limb])
    return len(limbs or known)


def _is_limb(name: str) -> bool:
    """Whether a name is that of the first bone of an arm or a leg."""
    return name in {f"{chain[0]}.{side}" for chain in metarig.LIMBS.values() for side in "LR"}


def _chain(limb: str) -> tuple[str, str, str]:
    """The bones of the body in a limb."""
    part, _, side = limb.partition(".")
    first, second, third = next(chain for chain in metarig.LIMBS.values() if chain[0] == part)
    return f"{first}.{side}", f"{second}.{side}", f"{third}.{side}"


def _snap_to_ik(rig: bpy.types.Object, body: bpy.types.Object, limb: str, arguments: dict[str, str]) -> None:
    chain, bones = _chain(limb), rig.pose.bones
    wanted = {name: rig.matrix_world.inverted() @ body.matrix_world @ body.pose.bones[name].matrix for name in chain}
    joint = bones[f"ORG-{chain[1]}"].head.copy()
    _call_rigify(rig, f"rigify_limb_ik2fk_{rig.data['rig_id']}", arguments)
    bones[_master(limb)]["IK_FK"] = 0.0
    _update(rig)
    base = bones[_names(arguments["ctrl_bones"])[0]]
    for _ in range(MOST_TURNS):  # about the line from the limb's first to its last joint, until elbow or knee is where it was
        first, now, last = (bones[f"ORG-{name}"].head for name in chain)
        angle = _angle_about((last - first).normalized(), now - first, joint - first)
        if abs(angle) < SMALLEST_TURN_RAD:
            break
        about = Matrix.Translation(first) @ Matrix.Rotation(angle, 4, last - first) @ Matrix.Translation(-first)
        base.matrix = about @ base.matrix
        _update(rig)
    for name in chain:
        bones[DRIVE + name].matrix = wanted[name]
    _update(rig)


def _snap_to_fk(rig: bpy.types.Object, body: bpy.types.Object, limb: str, _: dict[str, str]) -> None:
    wanted = {name: rig.matrix_world.inverted() @ body.matrix_world @ body.pose.bones[name].matrix for name in _chain(limb)}
    rig.pose.bones[_master(limb)]["IK_FK"] = 1.0
    for name in _chain(limb):
        drive, control = rig.pose.bones[DRIVE + name], rig.pose.bones[control_of(name)]
        drive.matrix_basis = Matrix()
        rest = drive.bone.matrix_local.to_3x3().inverted() @ control.bone.matrix_local.to_3x3()
        control.matrix = Matrix.LocRotScale(control.head, (wanted[name].to_3x3() @ rest).to_quaternion(), None)
        _update(rig)


def _angle_about(axis: Vector, a: Vector, b: Vector) -> float:
    """The angle about a unit axis from a to b, both seen along it."""
    a, b = a - a.dot(axis) * axis, b - b.dot(axis) * axis
    return atan2(axis.dot(a.cross(b)), a.dot(b))


def _update(rig: bpy.types.Object) -> None:
    rig.update_tag()
    bpy.context.view_layer.update()


def _call_rigify(rig: bpy.types.Object, name: str, arguments: dict[str, str]) -> None:
    """Call an operator of the rig's own script.

    Raises:
        InputError: the script did not run.
    """
    layer, mode = bpy.context.view_layer, bpy.context.mode
    active = layer.objects.active
    if active is not None and mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    layer.objects.active = rig
    bpy.ops.object.mode_set(mode="POSE")
    try:
        getattr(bpy.ops.pose, name)(**arguments)
    except (AttributeError, RuntimeError) as error:
        message = "The script of the control rig does not run; allow Python scripts (Preferences, Save & Load) and reload."
        raise InputError(message) from error
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
        layer.objects.active = active
        if mode == "POSE" and active is not None:
            bpy.ops.object.mode_set(mode="POSE")


def _key_limb(rig: bpy.types.Object, limb: str, arguments: dict[str, str]) -> None:
    """Key the limb's controls, and its switch, in the current frame."""
    controls = [*_names(arguments["ctrl_bones"]), *_names(arguments["tail_bones"]), *map(control_of, _chain(limb))]
    for name in (*controls, *(DRIVE + name for name in _chain(limb))):
        bone = rig.pose.bones[name]
        channel = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}.get(bone.rotation_mode, "rotation_euler")
        for path in ("location", channel):
            bone.keyframe_insert(path, group=name)
    rig.pose.bones[_master(limb)].keyframe_insert('["IK_FK"]', group=_master(limb))


def _master(limb: str) -> str:
    part, _, side = limb.partition(".")
    return f"{part}_parent.{side}"
