"""The panels *Overlays* and *Worst Frames* in the Clip Editor's sidebar."""

import dataclasses

import bpy
import numpy as np

from ..clicking.panel import ClipPanel
from ..panels import sentence
from ..properties import stages
from . import results

LISTED_FRAMES = 12


class TRICAP_PT_overlays(ClipPanel, bpy.types.Panel):
    """Results drawn over the footage."""

    bl_label = "Overlays"
    bl_order = 1

    def draw(self, context: bpy.types.Context) -> None:
        """The switches."""
        layout, shown = self.layout, context.scene.tricap_overlay
        run = results.current(context.scene)
        if run is None:
            sentence(layout, context, results.problem() or "Nothing was measured yet.", "INFO")
            return
        column = layout.column()
        row = column.row()
        row.prop(shown, "points")
        if shown.points:
            column.row(align=True).prop(shown, "which_points", expand=True)
            if shown.which_points != "kept":
                column.prop(shown, "point_filter")
            column.prop(shown, "most_sigma_mm")
        column.prop(shown, "tracks")
        if shown.tracks:
            column.row(align=True).prop(shown, "which", expand=True)
            if shown.which != "kept":
                column.prop(shown, "track_filter")
            column.prop(shown, "tail")
        column.prop(shown, "body")
        column.prop(shown, "contour")
        if shown.contour:
            self._draw_contour(column, context, run)
        column.prop(shown, "chosen")
        column.prop(shown, "graph")
        layout.operator("tricap.look_closer", icon="VIEWZOOM")
        if shown.contour:
            _draw_contour_settings(layout, context)
        if results.problem():
            sentence(layout, context, results.problem(), "ERROR")

    def _draw_contour(self, layout: bpy.types.UILayout, context: bpy.types.Context, run: results.RunResults) -> None:
        clip = context.space_data.clip
        view = results.view_of(clip) if clip is not None else ""
        if view in run.cameras and not run.contours(view):
            row = layout.row()
            row.enabled = not context.window_manager.tricap.running
            row.operator("tricap.follow_contours", icon="MOD_OUTLINE").view = view


def _draw_contour_settings(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    header, inside = layout.panel("tricap_group_contour", default_closed=True)
    header.label(text="Outline Tracking")
    if inside is not None:
        inside.use_property_split, inside.use_property_decorate = True, False
        for field in dataclasses.fields(stages()["contour"]):
            inside.prop(context.scene.tricap.contour, field.name)


class TRICAP_PT_frames(ClipPanel, bpy.types.Panel):
    """The most doubtful frames: press one to go there."""

    bl_label = "Worst Frames"
    bl_order = 2
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only after a run."""
        run = results.current(context.scene)
        return run is not None and run.table() is not None

    def draw(self, context: bpy.types.Context) -> None:
        """A row per frame: its number, why it is doubtful, residual and sigma."""
        run = results.current(context.scene)
        table = run.table() if run is not None else None
        if run is None or table is None:
            return
        badness, reasons = run.doubt()
        layout = self.layout
        if not any(reasons):
            layout.label(text="No frame is doubtful.", icon="CHECKMARK")
        column = layout.column(align=True)
        for i in np.argsort(-badness, kind="stable")[:LISTED_FRAMES]:
            frame = int(table.frames[i])
            row = column.row(align=True)
            residual, sigma = (table.values[name][i] for name in ("residual_px", "sigma_mm"))
            text = f"{frame}: {reasons[i] or 'good'}"
            row.operator(
                "tricap.go_to_frame", text=text, depress=frame == context.scene.frame_current, icon="ERROR" if reasons[i] else "CHECKMARK"
            ).frame = frame
            row.label(text=f"{residual:.2f} px  {sigma:.2f} mm" if np.isfinite(residual) else "no points")


CLASSES = (TRICAP_PT_overlays, TRICAP_PT_frames)
