"""bpy.ops.tricap.smooth_uncertain(acceleration=…), .reduce_keys(tolerance=…), .lock_feet(), .remove_foot_lock()"""

import math

import bpy

from ...core.foundation.errors import InputError
from ..operators.control_rig import body_of
from ..panels import TellingOperator
from ..scene.standing import controls_of_body
from . import foot_lock, keys

DEFAULT_ACCELERATION = math.radians(600)  # rad/s²: below that of quick limbs, so that only what is uncertain moves


class EditOperator(TellingOperator):
    """Mix-in: `edit` is the work on the body."""

    bl_options = {"REGISTER", "UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Edit the body."""
        return self.edit(body_of(context, standing_only=False))

    def edit(self, body: bpy.types.Object) -> str:
        """The work; returns a sentence to report.

        Raises:
            InputError: it cannot be done; nothing was changed.
        """
        raise NotImplementedError


class SmoothUncertain(EditOperator, bpy.types.Operator):
    """Smooth the motion where its sigmas are large; where it was measured well it stays. In Pose Mode: of the selected bones.
    The measured action is not changed"""

    bl_idname = "tricap.smooth_uncertain"
    bl_label = "Smooth where Uncertain"

    acceleration: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Acceleration [°/s²]",
        default=DEFAULT_ACCELERATION,
        min=math.radians(1),
        max=math.radians(100_000),
        subtype="ANGLE",
        description="Angular acceleration that is expected of the motion; lower values smooth more",
    )

    def edit(self, body: bpy.types.Object) -> str:
        """Smooth it."""
        return keys.smooth_uncertain(body, self.acceleration)


class ReduceKeys(EditOperator, bpy.types.Operator):
    """Remove keys as long as no channel changes by more than the tolerance. In Pose Mode: of the selected bones. The measured action is
    not changed"""

    bl_idname = "tricap.reduce_keys"
    bl_label = "Reduce Keys"

    tolerance: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Tolerance",
        default=math.radians(0.5),
        min=math.radians(0.001),
        max=math.radians(10),
        subtype="ANGLE",
        description="Largest change of an angle. Of locations: 3.5 mm for each degree",
    )

    def edit(self, body: bpy.types.Object) -> str:
        """Remove them."""
        return keys.reduce_keys(body, self.tolerance)


class LockFeet(EditOperator, bpy.types.Operator):
    """Find where the feet stand, and hold them there by inverse kinematics. The places (Foot Lock.L and .R) and the influences are keys
    that you can edit"""

    bl_idname = "tricap.lock_feet"
    bl_label = "Lock Feet"

    def edit(self, body: bpy.types.Object) -> str:
        """Lock them."""
        return foot_lock.lock_feet(body)


class RemoveFootLock(EditOperator, bpy.types.Operator):
    """Remove the foot lock of the body, with its keys"""

    bl_idname = "tricap.remove_foot_lock"
    bl_label = "Remove Foot Lock"

    def edit(self, body: bpy.types.Object) -> str:
        """Remove it."""
        if not foot_lock.remove(body):
            raise InputError(f"The feet of “{body.name}” are not locked.")
        return "The foot lock was removed."


def draw(layout: bpy.types.UILayout, body: bpy.types.Object) -> None:
    """The edits of a body's motion, in step 7."""
    header, inside = layout.panel("tricap_editing", default_closed=True)
    header.label(text="Edit Motion")
    if inside is None:
        return
    inside.prop(bpy.context.scene.tricap, "show_uncertainty")
    inside.operator("tricap.smooth_uncertain", icon="MOD_SMOOTH")
    inside.operator("tricap.reduce_keys", icon="KEYFRAME")
    row = inside.row(align=True)
    row.enabled = controls_of_body(body) is None  # the motion of a control rig has the lock already
    row.operator("tricap.lock_feet", icon="CON_FLOOR")
    if foot_lock.is_locked(body):
        row.prop(bpy.context.scene.tricap, "foot_lock", text="", icon="HIDE_OFF")
        row.operator("tricap.remove_foot_lock", text="", icon="X")


CLASSES = (SmoothUncertain, ReduceKeys, LockFeet, RemoveFootLock)
