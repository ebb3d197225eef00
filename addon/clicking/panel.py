"""The panel “Clicks” in the Clip Editor's sidebar."""

import bpy

from ...core.foundation.errors import InputError
from .. import clicks, project
from ..panels import sentence
from .click_session import joints_of
from .operators import model_joints

MOST_UNFOLDED = 8  # joints: a longer list is folded until it is opened


class ClipPanel:
    """The place of Tricap's panels in the Clip Editor."""

    bl_space_type = "CLIP_EDITOR"
    bl_region_type = "UI"
    bl_category = "Tricap"


class TRICAP_PT_clicks(ClipPanel, bpy.types.Panel):
    """Joints and surface seeds."""

    bl_label = "Clicks"
    bl_order = 0

    def draw(self, context: bpy.types.Context) -> None:
        """Buttons, and the joints with the views in which they are clicked."""
        layout, scene = self.layout, context.scene
        if not scene.tricap.views:
            sentence(layout, context, "Add footage first: tab Tricap in the sidebar of the 3-D view.", "INFO")
            return
        view = project.view_of(scene, context.space_data.clip)
        if view is not None:
            layout.label(text=f"View {view.name}", icon="CAMERA_DATA")
        layout.operator("tricap.open_views", icon="WINDOW")
        row = layout.row()
        row.scale_y = 1.4
        row.operator("tricap.click_joints", icon="RESTRICT_SELECT_OFF")
        layout.operator("tricap.click_seeds", icon="STICKY_UVS_DISABLE", text="Surface Seeds")
        self._draw_frame(layout, scene)
        self._draw_joints(layout, scene)

    def _draw_frame(self, layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
        first = scene.tricap.seed_frame
        if scene.frame_current == first:
            layout.label(text=f"Frame {first}: click frame", icon="KEYTYPE_KEYFRAME_VEC")
        else:
            layout.label(text=f"Frame {scene.frame_current}: keyframe", icon="KEYTYPE_EXTREME_VEC")
            layout.operator("tricap.go_to_frame", text=f"Go to Frame {first}").frame = first

    def _draw_joints(self, layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
        try:
            clips, names = project.clips_of(scene), joints_of(model_joints(scene))
        except InputError as error:
            sentence(layout, bpy.context, str(error), "ERROR")
            return
        found = {n: [v for v, clip in clips.items() if clicks.get_click(clip, n, scene.frame_current) is not None] for n in names}
        many = len(names) > MOST_UNFOLDED
        header, inside = layout.panel(f"tricap_clip_joints_{'many' if many else 'few'}", default_closed=many)
        header.label(text=f"Joints ({sum(len(at) > 1 for at in found.values())} of {len(names)})")
        if inside is None:
            return
        grid = inside.column(align=True)
        for name, at in found.items():
            row = grid.row(align=True)
            row.label(text=f"{name}   {' '.join(at)}", icon="CHECKMARK" if len(at) > 1 else "LAYER_USED" if at else "BLANK1")
            row.operator("tricap.click_joints", text="", icon="EYEDROPPER").only = name


CLASSES = (TRICAP_PT_clicks,)
