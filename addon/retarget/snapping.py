"""Limbs of a control rig change between IK and FK without moving the body, by the operators of Rigify's own script."""

import re
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import atan2

import bpy
from mathutils import Matrix, Vector

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ..scene import stored
from ..scene.armature import SNAPS_KEY
from ..scene.standing import controls_of_body
from . import frame_keys, metarig
from .metarig import DRIVE, control_of, master_of
from .write import CHANNEL

MOST_TURNS, SMALLEST_TURN_RAD = 6, 1e-5  # of the base of an IK limb, until its middle joint is where it was
SWITCH = '["IK_FK"]'
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
    Keying, the controls are keyed in this frame, and the frames before and after it keep what they play. `to`: "IK" or "FK"; `limbs`:
    names such as "upper_arm.L", "thigh.R"; empty for all four.

    Raises:
        InputError: the body has no control rig, the rig is hidden, there is no such limb, or the script of the rig does not run.
    """
    rig, chosen = _chosen(body, limbs)
    scene, before = bpy.context.scene, frame_keys.pose_of(rig)
    for limb, arguments in chosen.items():
        _snap(rig, body, to, limb, arguments)
    if scene.tool_settings.use_keyframe_insert_auto:
        after, keyed = frame_keys.pose_of(rig), _channels(rig, to, chosen)
        frame_keys.put(rig, before)
        frame_keys.key_frames(rig, [scene.frame_current], [frame_keys.values_of(keyed, after)])
        frame_keys.put(rig, after)
        _update(rig)
    return len(chosen)


def snapping_frames(
    body: bpy.types.Object, to: str, limbs: Sequence[str], frames: range, monitor: Monitor | None = None
) -> Generator[None, None, int]:
    """`snap` in each of these frames, a step each, with keys whether Auto Keying is on or not; frames before and after them keep what they
    play. The keys are set in the end. About 0.1 s for each limb and frame.

    Raises:
        InputError: see `snap`; there are no frames.
        Cancelled: the monitor was cancelled; nothing has changed.
    """
    rig, chosen = _chosen(body, limbs)
    if not frames:
        raise InputError("The scene plays no frames; correct its frame range.")
    monitor, scene, now, before = monitor or Monitor(), bpy.context.scene, bpy.context.scene.frame_current, frame_keys.pose_of(rig)
    keyed, values = _channels(rig, to, chosen), []
    try:
        with _without_meshes():
            for i, frame in enumerate(frames):
                monitor.step("snapping limbs", i, len(frames))
                frame_keys.put(rig, before)  # channels without keys; the others get theirs from the frame
                scene.frame_set(frame)
                for limb, arguments in chosen.items():
                    _snap(rig, body, to, limb, arguments)
                values.append(frame_keys.values_of(keyed, frame_keys.pose_of(rig)))
                yield
            frame_keys.put(rig, before)
            frame_keys.key_frames(rig, frames, values)
    finally:
        frame_keys.put(rig, before)
        scene.frame_set(now)
    return len(chosen)


def _chosen(body: bpy.types.Object, limbs: Sequence[str]) -> tuple[bpy.types.Object, dict[str, dict[str, str]]]:
    """The control rig, and the arguments of Rigify's snapping for each limb that is chosen.

    Raises:
        InputError: see `snap`.
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
    return rig, {limb: known[limb] for limb in limbs or known}


def _snap(rig: bpy.types.Object, body: bpy.types.Object, to: str, limb: str, arguments: dict[str, str]) -> None:
    (_snap_to_ik if to == "IK" else _snap_to_fk)(rig, body, limb, arguments)


def _channels(rig: bpy.types.Object, to: str, chosen: Mapping[str, Mapping[str, str]]) -> list[frame_keys.Channel]:
    """The channels that move limbs after they were snapped: bone and path, of the switch at last."""
    found = []
    for limb, arguments in chosen.items():
        listed = [name for key in ("ctrl_bones", "tail_bones", "extra_ctrls") for name in _names(arguments.get(key, ""))]
        controls = listed if to == "IK" else [control_of(name) for name in _chain(limb)]
        for name in (*controls, *(DRIVE + name for name in _chain(limb))):
            channel = CHANNEL.get(rig.pose.bones[name].rotation_mode, ("rotation_euler", 3))[0]
            found += [(name, "location"), (name, channel), (name, "scale")]
        found.append((master_of(limb), SWITCH))
    return found


@contextmanager
def _without_meshes() -> Iterator[None]:
    """Meanwhile Blender deforms no meshes, which would take most of the time."""
    shown = [thing for thing in bpy.context.scene.objects if thing.type == "MESH" and thing.library is None and not thing.hide_viewport]
    try:
        for mesh in shown:
            mesh.hide_viewport = True
        yield
    finally:
        for mesh in shown:
            mesh.hide_viewport = False


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
    bones[master_of(limb)]["IK_FK"] = 0.0
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
    rig.pose.bones[master_of(limb)]["IK_FK"] = 1.0
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
    layer, mode, tools = bpy.context.view_layer, bpy.context.mode, bpy.context.scene.tool_settings
    active, auto = layer.objects.active, tools.use_keyframe_insert_auto
    if active is not None and mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    layer.objects.active = rig
    bpy.ops.object.mode_set(mode="POSE")
    tools.use_keyframe_insert_auto = False  # it would key some of the channels without regard to other frames
    try:
        getattr(bpy.ops.pose, name)(**arguments)
    except (AttributeError, RuntimeError) as error:
        message = "The script of the control rig does not run; allow Python scripts (Preferences, Save & Load) and reload."
        raise InputError(message) from error
    finally:
        tools.use_keyframe_insert_auto = auto
        bpy.ops.object.mode_set(mode="OBJECT")
        layer.objects.active = active
        if mode == "POSE" and active is not None:
            bpy.ops.object.mode_set(mode="POSE")
