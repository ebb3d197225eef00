"""The section “Corrections” in the Clip Editor's sidebar, and the list of degrees of freedom for the step Body."""

import bpy

from .. import project
from ..clicking.panel import ClipPanel
from ..panels import sentence
from .properties import TricapCorrecting


class TRICAP_UL_corrections(bpy.types.UIList):
    """Trajectories and regions that are left out."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
        """Kind, view and frames."""
        region = item.kind == "region"
        frames = f"{item.first} to {max(item.first, item.last)}" if region else str(item.first)
        layout.label(text=f"{item.view}  {item.kind}  {frames}", icon="MESH_PLANE" if region else "TRACKER")


class TRICAP_UL_dofs(bpy.types.UIList):
    """Degrees of freedom with lock and limits; the list's own search finds one by name."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
        """Name, lock, lowest and highest."""
        row = layout.row(align=True)
        row.prop(item, "locked", text="", icon="LOCKED" if item.locked else "UNLOCKED", emboss=False)
        row.label(text=item.name)
        limits = row.row(align=True)
        limits.alignment = "RIGHT"
        limits.active = not item.locked
        limits.label(text=f"{item.low:g}…{item.high:g}°")


class TRICAP_PT_corrections(ClipPanel, bpy.types.Panel):
    """What is wrong is left out, and the later steps are made again."""

    bl_label = "Corrections"
    bl_order = 3

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with footage."""
        return len(context.scene.tricap.views) > 0

    def draw(self, context: bpy.types.Context) -> None:
        """The two tools and the list."""
        layout, said = self.layout, context.scene.tricap_correcting
        layout.operator_context = "INVOKE_DEFAULT"
        column = layout.column(align=True)
        column.operator("tricap.remove_trajectory", icon="TRACKER")
        column.operator("tricap.remove_region", icon="MESH_PLANE")
        column.prop(said, "region_frames")
        if said.corrections:
            row = layout.row()
            row.template_list("TRICAP_UL_corrections", "", said, "corrections", said, "active", rows=3)
            row.operator("tricap.remove_correction", text="", icon="REMOVE").index = -1
            self._draw_chosen(layout, said)
            sentence(layout, context, "They take effect when what is now stale is done again:", "INFO")
            layout.operator("tricap.run", icon="FF", text="Do Everything That Is Missing")

    def _draw_chosen(self, layout: bpy.types.UILayout, said: TricapCorrecting) -> None:
        if 0 <= said.active < len(said.corrections) and said.corrections[said.active].kind == "region":
            row = layout.row(align=True)
            row.prop(said.corrections[said.active], "first")
            row.prop(said.corrections[said.active], "last")


def draw_dofs(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Locks and limits: a button that lists them, then the list."""
    said = scene.tricap_correcting
    if not said.dofs or said.dofs_model != project.model_of(scene):
        layout.operator("tricap.list_dofs", icon="LOCKED")
        return
    layout.template_list("TRICAP_UL_dofs", "", said, "dofs", said, "active_dof", rows=5)
    if 0 <= said.active_dof < len(said.dofs):
        row = layout.row(align=True)
        row.use_property_split = False
        row.active = not said.dofs[said.active_dof].locked
        row.prop(said.dofs[said.active_dof], "low")
        row.prop(said.dofs[said.active_dof], "high")


CLASSES = (TRICAP_UL_corrections, TRICAP_UL_dofs, TRICAP_PT_corrections)
