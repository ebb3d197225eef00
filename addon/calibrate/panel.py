"""The section “Wand Calibration” of the panel. draw() only draws."""

import bpy

from ...core.images.interlace import BOTH
from ..panels import sentence
from ..session import get_session

LIGHTS = {"green": "STRIP_COLOR_04", "yellow": "STRIP_COLOR_03", "red": "STRIP_COLOR_01"}
GOOD_COUNT, FAIR_COUNT = 100, 30  # images of a view that show both targets


def draw_calibrate(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Footage, length, button, counts and verdict."""
    props, running = context.scene.tricap_calibrate, context.window_manager.tricap.running
    layout.prop(props, "bar")
    layout.prop(props, "length_m")
    layout.prop(props, "interlaced")
    if props.interlaced == BOTH:
        layout.prop(props, "first_field")
    layout.prop(props, "focal_px")
    layout.prop(props, "diameter_m")
    layout.prop(props, "mask")
    layout.prop(props, "floor", placeholder="frames: 0, 40, 80")
    layout.prop(props, "level", placeholder="frames: 12, 57")
    layout.prop(props, "like_scene")
    row = layout.row()
    row.scale_y = 1.3
    row.enabled = bool(props.bar)
    row.operator("tricap.calibrate", icon="OUTLINER_OB_CAMERA")
    for view, (frames, whole) in list(get_session().file.bar_counts.items()):
        layout.label(text=f"{view}: {whole} of {frames} images show the wand", icon=LIGHTS[light_of(whole)])
    if props.verdict and not running:
        box = layout.box()
        sentence(box, context, props.verdict, LIGHTS.get(props.light, "NONE"))
        sentence(box, context, f"To improve it: {props.advice}.", "INFO")
    layout.operator("tricap.set_world", icon="EMPTY_AXIS")
    row = layout.row(align=True)
    row.operator("tricap.import_rig", icon="IMPORT")
    row.operator("tricap.export_rig", icon="EXPORT")


def light_of(whole: int) -> str:
    """The traffic light of such a count."""
    return "green" if whole >= GOOD_COUNT else "yellow" if whole >= FAIR_COUNT else "red"
