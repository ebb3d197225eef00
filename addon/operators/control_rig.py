"""bpy.ops.tricap.make_control_rig(), bpy.ops.tricap.snap_limbs(to="IK", limbs="upper_arm.L, thigh.R", frames="PLAYED")"""

import bpy

from ...core.foundation.errors import InputError
from ..panels import TellingOperator
from ..retarget import control_rig, snapping
from ..retarget.playing import played_frames
from ..scene import standing


def body_of(context: bpy.types.Context, *, standing_only: bool = True) -> bpy.types.Object:
    """Tricap's body that is selected, else the first one of the scene; with `standing_only` a whole one that stands on a floor.

    Raises:
        InputError: there is none.
    """
    bodies = list(standing.bodies(context.scene) if standing_only else standing.all_bodies(context.scene))
    if not bodies and not standing_only:
        raise InputError("The scene has no fitted body; build the rig first (step 7).")
    if not bodies:
        raise InputError("A control rig needs a whole body; build the rig of a fitted person first (step 7).")
    return next((body for body in bodies if body.select_get()), bodies[0])


class MakeControlRig(TellingOperator, bpy.types.Operator):
    """Make controls by Rigify: IK and FK, fingers and toes. The measured motion is their base layer, with an empty layer for corrections
    over it"""

    bl_idname = "tricap.make_control_rig"
    bl_label = "Make Control Rig"
    bl_options = {"REGISTER", "UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Make it."""
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        made = control_rig.make_control_rig(body_of(context))
        off = f"{made.angle_deg:.3f}° and {made.place_mm:.2f} mm"
        return f"“{made.rig.name}” plays the motion within {off}. The bones of the body are hidden (Alt H)."


class SnapLimbs(TellingOperator, bpy.types.Operator):
    """Switch arms and legs between IK and FK without moving the body: in this frame, which Auto Keying keys while others stay as they are,
    or with keys in all frames that are played"""

    bl_idname = "tricap.snap_limbs"
    bl_label = "Snap Limbs"
    bl_options = {"REGISTER", "UNDO"}

    to: bpy.props.EnumProperty(name="To", items=[("IK", "IK", "Pose limbs by hand and foot"), ("FK", "FK", "Pose limbs by rotations")])  # type: ignore[valid-type]
    limbs: bpy.props.StringProperty(name="Limbs", description="Such as upper_arm.L, thigh.R; empty: all four")  # type: ignore[valid-type]

    frames: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Frames",
        items=[
            ("CURRENT", "This Frame", "In the current frame; with Auto Keying, with keys, so that other frames do not change"),
            ("PLAYED", "Played Frames", "With keys in every frame of the preview range, or else of the scene"),
        ],
    )

    def do(self, context: bpy.types.Context) -> str:
        """Snap them."""
        limbs, body = [limb.strip() for limb in self.limbs.split(",") if limb.strip()], body_of(context)
        if self.frames == "PLAYED":
            frames = played_frames(context.scene)
            count, where = snapping.snap_frames(body, self.to, limbs, frames), f"in frames {frames.start}–{frames.stop - 1}"
        else:
            count, where = snapping.snap(body, self.to, limbs), "in this frame"
            keyed = context.scene.tool_settings.use_keyframe_insert_auto
            where += "; other frames are as before" if keyed else ", without keys: another frame shows what is keyed"
        return f"{count} limb{'s are' if count > 1 else ' is'} in {self.to} {where}."


def draw(layout: bpy.types.UILayout, body: bpy.types.Object) -> None:
    """The buttons of a body's control rig in step 7."""
    if standing.controls_of_body(body) is None:
        layout.operator("tricap.make_control_rig", icon="OUTLINER_OB_ARMATURE")
        return
    row = layout.row(align=True)
    for to in ("IK", "FK"):
        row.operator("tricap.snap_limbs", text=f"Snap to {to}", icon="SNAP_ON").to = to
    row = layout.row(align=True)
    for to in ("IK", "FK"):
        button = row.operator("tricap.snap_limbs", text=f"Bake to {to}", icon="KEYINGSET")
        button.to, button.frames = to, "PLAYED"


CLASSES = (MakeControlRig, SnapLimbs)
