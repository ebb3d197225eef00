"""bpy.ops.tricap.make_control_rig(), bpy.ops.tricap.snap_limbs(to="IK", limbs="upper_arm.L, thigh.R"), bake_limbs(to="IK", …)"""

from collections.abc import Callable, Generator
from typing import Any

import bpy

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ..jobs import JobOperator
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


TO = bpy.props.EnumProperty(name="To", items=[("IK", "IK", "Pose limbs by hand and foot"), ("FK", "FK", "Pose limbs by rotations")])
LIMBS = bpy.props.StringProperty(name="Limbs", description="Such as upper_arm.L, thigh.R; empty: all four")


def _named(limbs: str) -> list[str]:
    return [limb.strip() for limb in limbs.split(",") if limb.strip()]


def _said(count: int, to: str, where: str) -> str:
    return f"{count} limb{'s are' if count > 1 else ' is'} in {to} {where}."


class SnapLimbs(TellingOperator, bpy.types.Operator):
    """Switch arms and legs between IK and FK in this frame without moving the body. Auto Keying keys it; other frames stay as they are"""

    bl_idname = "tricap.snap_limbs"
    bl_label = "Snap Limbs"
    bl_options = {"REGISTER", "UNDO"}

    to: TO  # type: ignore[valid-type]
    limbs: LIMBS  # type: ignore[valid-type]

    def do(self, context: bpy.types.Context) -> str:
        """Snap them."""
        count, keyed = snapping.snap(body_of(context), self.to, _named(self.limbs)), context.scene.tool_settings.use_keyframe_insert_auto
        kept = "; other frames are as before" if keyed else ", without keys: another frame shows what is keyed"
        return _said(count, self.to, f"in this frame{kept}")


class BakeLimbs(JobOperator, bpy.types.Operator):
    """Switch arms and legs between IK and FK, with keys in every frame that is played (preview range or scene), without moving the body"""

    bl_idname = "tricap.bake_limbs"
    bl_label = "Bake Limbs"
    bl_options = {"REGISTER", "UNDO"}

    if_stopped = "The control rig is as before."

    to: TO  # type: ignore[valid-type]
    limbs: LIMBS  # type: ignore[valid-type]

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], Any]:
        """Body and frames; what there is to compute needs Blender."""
        self._body, self._frames = body_of(context), played_frames(context.scene)
        return lambda monitor: None

    def in_steps(self, context: bpy.types.Context, result: Any, monitor: Monitor) -> Generator[None, None, Any]:
        """Snap them, frame by frame."""
        return (yield from snapping.snapping_frames(self._body, self.to, _named(self.limbs), self._frames, monitor))

    def finish(self, context: bpy.types.Context, result: Any) -> set[str]:
        """Report it."""
        self.report({"INFO"}, _said(result, self.to, f"in frames {self._frames.start}–{self._frames.stop - 1}"))
        return {"FINISHED"}


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
        row.operator("tricap.bake_limbs", text=f"Bake to {to}", icon="KEYINGSET").to = to


CLASSES = (MakeControlRig, SnapLimbs, BakeLimbs)
