"""The panel “Points” in the Clip Editor's sidebar."""

import bpy

from .. import project
from ..clicking.panel import ClipPanel
from . import tracks


class TRICAP_PT_points(ClipPanel, bpy.types.Panel):
    """Single points, in space or in one view."""

    bl_label = "Points"
    bl_order = 4
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Buttons, and the points of this frame with the views in which they are clicked."""
        layout, scene, clip = self.layout, context.scene, context.space_data.clip
        busy = context.window_manager.tricap.running
        clips = {view.name: view.clip for view in scene.tricap.views if view.clip is not None}
        if project.view_of(scene, clip) is not None:
            column = layout.column(align=True)
            column.operator("tricap.click_points", icon="RESTRICT_SELECT_OFF").flat = False
            row = column.row(align=True)
            row.enabled = not busy
            row.operator("tricap.follow_points", icon="TRACKING_FORWARDS")
            layout.prop(scene.tricap.key_points, "markers")
            layout.prop(scene.tricap_overlay, "chosen")
        else:
            clips = {}
        if clip is None:
            layout.label(text="Open footage in this editor.", icon="INFO")
            return
        column = layout.column(align=True)
        column.operator("tricap.click_points", icon="RESTRICT_SELECT_OFF", text="Click Points (2-D)").flat = True
        column.operator("tricap.join_points", icon="IPO_LINEAR", text="Join Selected Points")
        row = column.row(align=True)
        row.enabled = not busy
        row.operator("tricap.follow_points2d", icon="TRACKING_FORWARDS")
        _draw_points(layout, clip, clips, scene.frame_current)


def _draw_points(layout: bpy.types.UILayout, clip: bpy.types.MovieClip, clips: dict[str, bpy.types.MovieClip], frame: int) -> None:
    shown = {view: set(tracks.points_of(other, frame)) for view, other in clips.items()}
    column = layout.column(align=True)
    for name in sorted(set().union(tracks.points_of(clip, frame), *shown.values())):
        at = [view for view, names in shown.items() if name in names]
        other = [b if a == name else a for a, b in tracks.joined(clip) if name in (a, b)]
        words = f"{name}   {' '.join(at)}" + (f"   – {', '.join(other)}" if other else "")
        column.label(text=words, icon="CHECKMARK" if len(at) > 1 or not clips else "LAYER_USED")


CLASSES = (TRICAP_PT_points,)
