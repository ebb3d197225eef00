"""The section “Calibrate” of the panel. draw() only draws."""

import bpy

from ..panels import TricapPanel
from . import live

LIGHTS = {"green": "STRIP_COLOR_04", "yellow": "STRIP_COLOR_03", "red": "STRIP_COLOR_01"}
LINE = 60  # characters of a label


class TRICAP_PT_calibrate(TricapPanel, bpy.types.Panel):
    """From a waved bar to cameras."""

    bl_label = "Calibrate"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Footage, length, button, counts and verdict."""
        layout, props = self.layout, context.scene.tricap_calibrate
        running = context.window_manager.tricap.running
        column = layout.column()
        column.enabled = not running
        column.prop(props, "bar")
        column.prop(props, "length_m")
        column.prop(props, "interlaced")
        column.prop(props, "focal_px")
        column.prop(props, "floor", placeholder="frames: 0, 40, 80")
        column.prop(props, "level", placeholder="frames: 12, 57")
        row = column.row()
        row.scale_y = 1.3
        row.enabled = bool(props.bar)
        row.operator("tricap.calibrate", icon="OUTLINER_OB_CAMERA")
        for view, (frames, whole) in live.counts().items():
            layout.label(text=f"{view}: {whole} whole bars in {frames} images", icon=live.light(whole))
        if props.verdict and not running:
            box = layout.box()
            for n, line in enumerate(wrapped(props.verdict)):
                box.label(text=line, icon=LIGHTS.get(props.light, "NONE") if not n else "BLANK1")
            for n, line in enumerate(wrapped(f"To do better: {props.advice}.")):
                box.label(text=line, icon="INFO" if not n else "BLANK1")
        row = layout.row(align=True)
        row.enabled = not running
        row.operator("tricap.import_rig", icon="IMPORT")
        row.operator("tricap.export_rig", icon="EXPORT")


def wrapped(text: str) -> list[str]:
    """The text in lines that fit the panel."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) >= LINE:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


CLASSES = (TRICAP_PT_calibrate,)
