"""The section “Calibrate” of the panel. draw() only draws."""

import bpy

from ...core.images.interlace import BOTH
from ..panels import sentence
from ..session import get_session

LIGHTS = {"green": "STRIP_COLOR_04", "yellow": "STRIP_COLOR_03", "red": "STRIP_COLOR_01"}
COUNTS = {"WAND": (100, 30), "charuco": (20, 8), "chessboard": (20, 8)}  # images of a view that show the target: good, fair


def draw_calibrate(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Target, footage, button, counts and verdict."""
    props, running = context.scene.tricap_calibrate, context.window_manager.tricap.running
    layout.row().prop(props, "target", expand=True)
    layout.prop(props, "bar")
    (_wand if props.target == "WAND" else _board)(layout, props)
    layout.prop(props, "started_fps")
    layout.prop(props, "rates", placeholder="only if they differ: L=24, C=30")
    layout.prop(props, "focal_px")
    layout.prop(props, "floor", placeholder="frames: 0, 40, 80")
    layout.prop(props, "level", placeholder="frames: 12, 57")
    layout.prop(props, "like_scene")
    row = layout.row()
    row.scale_y = 1.3
    row.enabled = bool(props.bar)
    row.operator("tricap.calibrate", icon="OUTLINER_OB_CAMERA")
    for (view, target), (frames, whole) in list(get_session().file.bar_counts.items()):
        noun = "wand" if target == "WAND" else "board"
        layout.label(text=f"{view}: {whole} of {frames} images show the {noun}", icon=LIGHTS[light_of(whole, target)])
    if props.verdict and not running:
        box = layout.box()
        sentence(box, context, props.verdict, LIGHTS.get(props.light, "NONE"))
        sentence(box, context, f"To improve it: {props.advice}.", "INFO")
    layout.operator("tricap.set_world", icon="EMPTY_AXIS")
    row = layout.row(align=True)
    row.operator("tricap.import_rig", icon="IMPORT")
    row.operator("tricap.export_rig", icon="EXPORT")


def _wand(layout: bpy.types.UILayout, props: bpy.types.PropertyGroup) -> None:
    layout.prop(props, "length_m")
    layout.prop(props, "interlaced")
    if props.interlaced == BOTH:
        layout.prop(props, "first_field")
    layout.prop(props, "diameter_m")
    layout.prop(props, "mask")
    layout.prop(props, "board_footage")
    if props.board_footage:
        layout.row().prop(props, "board_kind", expand=True)
        _squares(layout, props, props.board_kind)
        layout.prop(props, "lenses_only")
    layout.prop(props, "lens")


def _squares(layout: bpy.types.UILayout, props: bpy.types.PropertyGroup, kind: str) -> None:
    layout.row().prop(props, "squares", text="Squares" if kind == "charuco" else "Inner Corners")
    layout.prop(props, "square_m")
    if kind == "charuco":
        layout.prop(props, "marker_m")
        layout.prop(props, "dictionary")


def _board(layout: bpy.types.UILayout, props: bpy.types.PropertyGroup) -> None:
    _squares(layout, props, props.target)
    layout.prop(props, "lens")
    layout.operator("tricap.print_board", icon="EXPORT")


def light_of(whole: int, target: str) -> str:
    """The traffic light of such a count."""
    good, fair = COUNTS[target]
    return "green" if whole >= good else "yellow" if whole >= fair else "red"
