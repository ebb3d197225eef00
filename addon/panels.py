"""The panel “Tricap” in the sidebar of the 3-D view. draw() only draws."""

import dataclasses

import bpy

from . import properties


class TricapPanel:
    """Where all panels live."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Tricap"


class TRICAP_PT_main(TricapPanel, bpy.types.Panel):
    """From a take to a moving armature."""

    bl_label = "Tricap"

    def draw(self, context: bpy.types.Context) -> None:
        """Take, output, buttons or progress, and the last result."""
        layout, props, state = self.layout, context.scene.tricap, context.window_manager.tricap
        column = layout.column()
        column.enabled = not state.running
        column.prop(props, "take")
        column.prop(props, "out", placeholder="beside this file or the take")
        if state.running:
            layout.progress(factor=state.progress, text=f"{state.stage}  {state.progress:.0%}", type="BAR")
            layout.operator("tricap.cancel", icon="X", text="Cancel (Esc)")
        else:
            buttons = layout.column(align=True)
            run = buttons.row(align=True)
            run.scale_y = 1.4
            run.enabled = bool(props.take)
            run.operator("tricap.run", icon="PLAY")
            build = buttons.row(align=True)
            build.enabled = bool(props.take or props.out)
            build.operator("tricap.build_scene", icon="ARMATURE_DATA")
        if not props.take and not props.out:
            layout.label(text="Choose the folder of a recording, or see how it works:", icon="INFO")
            layout.operator("tricap.load_sample", icon="PLAY")
        found = layout.column(align=True)
        for part in props.last.split(", ") if props.last else ():
            found.label(text=part)


class TRICAP_PT_advanced(TricapPanel, bpy.types.Panel):
    """The knobs of every stage."""

    bl_label = "Advanced"
    bl_parent_id = "TRICAP_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """One box per stage."""
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.enabled = not context.window_manager.tricap.running
        for name, settings in properties.stages().items():
            header, body = layout.panel(f"tricap_{name}", default_closed=True)
            header.label(text=name.capitalize())
            if body is not None:
                group = getattr(context.scene.tricap, name)
                for field in dataclasses.fields(settings):
                    body.prop(group, field.name)


CLASSES = (TRICAP_PT_main, TRICAP_PT_advanced)


def register() -> None:
    """Register the panels."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Unregister the panels."""
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
