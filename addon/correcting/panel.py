"""The panel *Corrections* in the Clip Editor's sidebar, and the list of degrees of freedom of step Body."""

import bpy

from .. import project
from ..clicking.panel import ClipPanel
from ..panels import sentence
from .properties import TricapCorrecting


class TRICAP_UL_corrections(bpy.types.UIList):
    """Removed trajectories and excluded regions."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
        """Kind, view and frames."""
        region = item.kind == "region"
        frames = f"{item.first} to {max(item.first, item.last)}" if region else str(item.first)
        layout.label(text=f"{item.view}  {item.kind}  {frames}", icon="MESH_PLANE" if region else "TRACKER")


class TRICAP_UL_dofs(bpy.types.UIList):
    """Degrees of freedom with lock and limits; the list can be searched by name."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
        """Lock, name, lower and upper limit."""
        row = layout.row(align=True)
        row.prop(item, "locked", text="", icon="LOCKED" if item.locked else "UNLOCKED", emboss=False)
        row.label(text=item.name)
        limits = row.row(align=True)
        limits.alignment = "RIGHT"
        limits.active = not item.locked
        limits.label(text=f"{item.low:g}…{item.high:g}°")


class TRICAP_PT_corrections(ClipPanel, bpy.types.Panel):
    """Excludes what is wrong; the steps that depend on it run again."""

    bl_label = "Corrections"
    bl_order = 3

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with footage."""
        return len(context.scene.tricap.views) > 0

    def draw(self, context: bpy.types.Context) -> None:
        """The two tools and the list."""
        layout, correcting = self.layout, context.scene.tricap_correcting
        layout.operator_context = "INVOKE_DEFAULT"
        column = layout.column(align=True)
        column.operator("tricap.pull_joint", icon="EMPTY_ARROWS")
        column.operator("tricap.fit_again", icon="FILE_REFRESH")
        column = layout.column(align=True)
        column.operator("tricap.remove_trajectory", icon="TRACKER")
        column.operator("tricap.remove_region", icon="MESH_PLANE")
        column.prop(correcting, "region_frames")
        layout.operator("tricap.set_floor", icon="GRID")
        if correcting.corrections:
            row = layout.row()
            row.template_list("TRICAP_UL_corrections", "", correcting, "corrections", correcting, "active", rows=3)
            row.operator("tricap.remove_correction", text="", icon="REMOVE").index = -1
            self._draw_active(layout, correcting)
            sentence(layout, context, "They take effect when the stale steps run again:", "INFO")
            layout.operator("tricap.run", icon="FF", text="Run Remaining Steps")

    def _draw_active(self, layout: bpy.types.UILayout, correcting: TricapCorrecting) -> None:
        if 0 <= correcting.active < len(correcting.corrections) and correcting.corrections[correcting.active].kind == "region":
            row = layout.row(align=True)
            row.prop(correcting.corrections[correcting.active], "first")
            row.prop(correcting.corrections[correcting.active], "last")


def draw_dofs(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Locks and limits: a button that fills the list, then the list."""
    correcting = scene.tricap_correcting
    if not correcting.dofs or correcting.dofs_model != project.model_of(scene):
        layout.operator("tricap.list_dofs", icon="LOCKED")
        return
    layout.template_list("TRICAP_UL_dofs", "", correcting, "dofs", correcting, "active_dof", rows=5)
    if 0 <= correcting.active_dof < len(correcting.dofs):
        row = layout.row(align=True)
        row.use_property_split = False
        row.active = not correcting.dofs[correcting.active_dof].locked
        row.prop(correcting.dofs[correcting.active_dof], "low")
        row.prop(correcting.dofs[correcting.active_dof], "high")


CLASSES = (TRICAP_UL_corrections, TRICAP_UL_dofs, TRICAP_PT_corrections)
