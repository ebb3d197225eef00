"""The section “Corrections” in the Clip Editor's sidebar, and the list of degrees of freedom for the step Body."""

import bpy

from .. import project
from ..clicking.panel import ClipPanel


class TRICAP_UL_corrections(bpy.types.UIList):
    """Trajectories and regions that are left out."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
        """Kind, view and frames."""
        row = layout.row(align=True)
        region = item.kind == "region"
        row.label(text=f"{item.kind} {item.view}", icon="MESH_PLANE" if region else "TRACKER")
        row.prop(item, "first", text="", emboss=False)
        if region:
            row.prop(item, "last", text="", emboss=False)


class TRICAP_UL_dofs(bpy.types.UIList):
    """Degrees of freedom with lock and limits; the list's own search finds one by name."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
        """Name, lock, lowest and highest."""
        row = layout.row(align=True)
        row.prop(item, "locked", text="", icon="LOCKED" if item.locked else "UNLOCKED", emboss=False)
        row.label(text=item.name)
        limits = row.row(align=True)
        limits.enabled = not item.locked
        limits.prop(item, "low", text="")
        limits.prop(item, "high", text="")


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
        row = column.row(align=True)
        row.operator("tricap.remove_region", icon="MESH_PLANE")
        row.prop(said, "region_frames", text="")
        if said.corrections:
            row = layout.row()
            row.template_list("TRICAP_UL_corrections", "", said, "corrections", said, "active", rows=3)
            row.operator("tricap.remove_correction", text="", icon="REMOVE").index = -1
            layout.label(text="They count when the step is run again.", icon="INFO")


def draw_dofs(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Locks and limits: a button that lists them, then the list."""
    said = scene.tricap_correcting
    if not said.dofs or said.dofs_model != project.model_of(scene):
        layout.operator("tricap.list_dofs", icon="LOCKED")
        return
    layout.label(text="Lock, lowest and highest angle [°]")
    layout.template_list("TRICAP_UL_dofs", "", said, "dofs", said, "active_dof", rows=5)


CLASSES = (TRICAP_UL_corrections, TRICAP_UL_dofs, TRICAP_PT_corrections)
