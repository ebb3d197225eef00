"""The base layer of a control rig: the motion of the body as keys of root and FK controls, in a locked NLA strip.

With the rest rotations R_rest of body and control, and A from the control's rest direction to the body's,

    R_control = R_body · R_body,restᵀ · A · R_control,rest                                                              (1)

The keys are relative to the object of the control rig, as it was placed when they were made: where that of the body was, in the frame
BAKED_KEY. So frames can be baked anew after the control rig was moved.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.geometry.rotation import angle_of, transposed
from ...core.motion.retarget.rig import ControlRig, Motion, Rig, channels, controls_of
from ..editing import foot_lock
from ..scene import built, stored
from ..scene.standing import ROOT
from . import metarig
from .read import check_plays, orthonormal, read_motion, read_rig, world_matrix
from .write import push_to_strip, replace_frames, write_action

if TYPE_CHECKING:
    from ...core.motion.retarget.retarget import Retargeted

CONSTRAINT = "Control rig"  # of each bone of the body
CORRECTIONS = "Corrections"
BASE_KEY = "tricap_base_layer"  # custom property of a control rig: the action of its base layer
BAKED_KEY = "tricap_baked_in"  # custom property of a control rig: the frame that was shown when the base layer was made
LOCKED_KEY = "tricap_was_locked"  # custom property of a body with a control rig: the base layer has the foot lock, which is muted
TOE = "toe"
RESTING_RAD = 1e-4  # rotation of a finger or toe that does not leave its rest
LIMB_PROPERTIES = {"IK_FK": 1.0, "FK_limb_follow": 0.0}


def bake(rig: bpy.types.Object, body: bpy.types.Object, motion: Motion) -> None:
    """Write the motion as keys of root and FK controls, push them to an NLA strip, and begin an empty action over it."""
    written = write_action(rig, _of_controls(rig, body, motion), "Measured motion", properties=_properties())
    push_to_strip(rig, written.action)
    rig.animation_data.nla_tracks[-1].lock = True
    rig.animation_data.action = bpy.data.actions.new(CORRECTIONS)
    rig.animation_data.action_blend_type, rig.animation_data.action_extrapolation = "COMBINE", "HOLD"
    rig[BASE_KEY], rig[BAKED_KEY] = written.action, bpy.context.scene.frame_current
    built.mark_actions([written.action])


def check_bakes(rig: bpy.types.Object, body: bpy.types.Object) -> None:
    """Check that frames of the base layer can be baked anew.

    Raises:
        InputError: the control rig no longer plays it, it cannot be edited, or Blender does not play the body.
    """
    action = _base_of(rig)
    if action is None or not action.is_editable:
        why = "no longer plays its base layer" if action is None else "plays a base layer from another file"
        raise InputError(f"“{rig.name}” {why}, in which the motion would change; delete it, and make it again when the body is fitted.")
    check_plays(body)


def bake_again(rig: bpy.types.Object, body: bpy.types.Object, frames: Sequence[int]) -> None:
    """Bake some frames of the base layer anew from the body's own motion, in which they have changed; the corrections stay as they are.

    Raises:
        InputError: see `check_bakes`.
    """
    check_bakes(rig, body)
    action, scene, now = _base_of(rig), bpy.context.scene, bpy.context.scene.frame_current
    assert action is not None
    first, last = action.frame_range
    inside = [int(frame) for frame in frames if first <= frame <= last]
    if not inside:
        return
    place = rig.matrix_basis.copy()
    try:
        with _released(body):
            scene.frame_set(int(stored.number(rig, BAKED_KEY) or 0))
            motion = read_motion(body, read_rig(body), inside)
            rig.matrix_world = body.matrix_world
            with built.no_edit([action]):
                replace_frames(rig, action, _of_controls(rig, body, motion))
    finally:
        rig.matrix_basis = place
        scene.frame_set(now)


def _base_of(rig: bpy.types.Object) -> bpy.types.Action | None:
    """The action of the base layer, if the control rig still plays it."""
    base, data = stored.data_block(rig, BASE_KEY, bpy.types.Action), rig.animation_data
    played = [strip.action for track in data.nla_tracks for strip in track.strips] if data is not None else []
    return base if base in played else None


@contextmanager
def _released(body: bpy.types.Object) -> Iterator[None]:
    """Meanwhile the body plays its own motion, with its foot lock, and not that of its control rig."""
    constraints = [c for bone in body.pose.bones for c in bone.constraints if c.name == CONSTRAINT]
    muted, locked = [c.mute for c in constraints], bool(body.get(LOCKED_KEY))
    try:
        for constraint in constraints:
            constraint.mute = True
        if locked:
            foot_lock.activate(body, True)
        yield
    finally:
        for constraint, mute in zip(constraints, muted, strict=True):
            constraint.mute = mute
        if locked:
            foot_lock.activate(body, False)


def _properties() -> dict[str, dict[str, float]]:
    """By bone, the custom properties with which the FK controls move the limbs."""
    return {metarig.master_of(f"{chain[0]}.{side}"): LIMB_PROPERTIES for chain in metarig.LIMBS.values() for side in "LR"}


def _of_controls(rig: bpy.types.Object, body: bpy.types.Object, motion: Motion) -> "Retargeted":
    """The motion of a body as that of root and FK controls."""
    names, of = metarig.driven_bones(body), metarig.control_of
    follows = {of(name): of(_parent(name)) for name in names if name != "pelvis"} | {"pelvis": ROOT}
    chains = {name: (of(name),) for name in names} | {ROOT: (ROOT,)}
    controls = controls_of(read_rig(rig), ControlRig(follows=follows, properties=_properties()), chains)
    R, place = _targets(controls, body, rig, motion)
    return _result(controls, motion, R, place, {of(name) for name in metarig.digits_of(body)})


def _parent(name: str) -> str:
    """The parent of a bone of the body."""
    part, _, side = name.partition(".")
    if part == TOE:
        return f"foot.{side}"
    if part in metarig.FINGERS:  # side: "02.R"
        number, _, side = side.partition(".")
        return f"hand.{side}" if number == "01" else f"{part}.0{int(number) - 1}.{side}"
    for limb, chain in metarig.LIMBS.items():
        if part in chain[1:]:
            return f"{chain[chain.index(part) - 1]}.{side}"
        if part == chain[0]:
            return "pelvis" if limb == "leg" else f"shoulder.{side}"
    return metarig.PARENTS[part]


def _targets(controls: Rig, body: bpy.types.Object, rig: bpy.types.Object, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (T, B, 3, 3) and heads (T, B, 3) of the controls that place the body as in `motion`.  (1)"""
    bone_of = {metarig.control_of(name): name for name in metarig.driven_bones(body)} | {ROOT: ROOT}
    rows = [motion.rig.index[bone_of[control]] for control in controls.names]
    since_rest = motion.R[:, rows] @ transposed(motion.rig.R_rest[rows])
    A = np.array([np.eye(3) if control == ROOT else metarig.bent(rig, body, bone_of[control]) for control in controls.names])
    object_R = orthonormal(world_matrix(rig)[:3, :3])
    return since_rest @ object_R @ A @ object_R.T @ controls.R_rest, motion.head_m[:, rows]


def _result(controls: Rig, motion: Motion, R: np.ndarray, place: np.ndarray, digits: set[str]) -> "Retargeted":
    """The root keeps to the floor under the person; the pelvis carries the rest. Fingers and toes (`digits`) that do not leave their rest
    get no keys, so that a pose of the animator's stays in all frames."""
    root, pelvis = controls.index[ROOT], controls.index["pelvis"]
    path = place[:, root] - controls.head_m[root]
    shift = place[:, pelvis] - (controls.head_m[pelvis] + path)
    played = Motion(rig=controls, fps=motion.fps, frames=motion.frames, R=R, head_m=place)
    from ...core.motion.retarget.retarget import Retargeted

    basis = channels(controls, R)
    resting = angle_of(basis).max(axis=0) < RESTING_RAD
    return Retargeted(
        motion=played,
        basis=basis,
        shift_m=shift,
        carrier=pelvis,
        loose_m={root: path},
        driven=np.array([name not in digits or not rests for name, rests in zip(controls.names, resting)]),
        scale=1.0,
        roles=(),
        contacts=None,
        notes=(),
        removed_travel_m=0.0 * path,
    )
