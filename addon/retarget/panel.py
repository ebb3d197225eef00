"""The controls of retargeting in step Retarget. draw() only draws."""

import dataclasses
from pathlib import Path
from typing import Any

import bpy

from ...core.motion.retarget.contacts import FeetSettings
from ...core.motion.retarget.retarget import RetargetSettings
from ...core.motion.sources import FILES
from ..panels import expanded, sentence
from . import preview, properties


class TRICAP_UL_map(bpy.types.UIList):
    """The lines of the mapping."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
        """Part, the source's bones, the target's bones."""
        row = layout.row(align=True)
        row.prop(item, "role", text="", emboss=False)
        row.label(text=item.source or "–")
        row.prop(item, "bones", text="", emboss=False)
        if any(item.offset):
            row.label(text="", icon="ORIENTATION_GIMBAL")
        if item.twist:  # edited below the list
            row.label(text="", icon="CON_ROTLIKE")


def _draw_map(layout: bpy.types.UILayout, props: Any) -> None:
    """The editor of the mapping, with the parts that were not found."""
    row = layout.row()
    row.template_list("TRICAP_UL_map", "", props, "rows", props, "row", rows=6)
    buttons = row.column(align=True)
    buttons.operator("tricap.retarget_add_line", icon="ADD", text="")
    buttons.operator("tricap.retarget_remove_line", icon="REMOVE", text="")
    if 0 <= props.row < len(props.rows):
        layout.prop(props.rows[props.row], "twist")
        layout.prop(props.rows[props.row], "offset")
    if props.source is not None:
        layout.operator("tricap.retarget_align_pose", icon="POSE_HLT")
    buttons = layout.row(align=True)
    buttons.operator("tricap.retarget_find_map", icon="VIEWZOOM")
    buttons.operator("tricap.retarget_load_map", icon="FILE_FOLDER", text="Load")
    buttons.operator("tricap.retarget_save_map", icon="FILE_TICK", text="Save")
    if props.target is not None and (note := properties.foreign_mapping_note(props, props.target)):
        sentence(layout, bpy.context, note, "ERROR")
    for line in props.missing.splitlines():
        sentence(layout, bpy.context, line, "INFO")


def draw_retarget(layout: bpy.types.UILayout, context: bpy.types.Context, *, is_next: bool = False) -> None:
    """Source, target, mapping, settings, buttons; *Retarget* is highlighted if it is next and there is a target."""
    props = context.scene.tricap_retarget
    column = layout.column()
    column.prop(props, "source")
    if props.source is None:
        column.prop(props, "file")
        if Path(props.file).suffix.lower() in FILES:
            row = column.row(align=True)
            row.prop(props, "up")
            row.prop(props, "unit")
    column.prop(props, "target")
    target = properties.target_of(context.scene)
    if target is not None and props.target is None:
        sentence(layout, context, f"“{target.name}” is the target, as the only other armature.", "INFO")
    if target is None:
        sentence(layout, context, "Add your character to this scene, and choose its armature as the target. To try it without one:", "INFO")
        layout.operator("tricap.add_robot", icon="OUTLINER_OB_ARMATURE")
    header, body = layout.panel("tricap_retarget_map", default_closed=not props.rows)
    header.label(text=f"Mapping ({len(props.rows)} parts)" if props.rows else "Mapping (automatic)")
    if body is not None:
        _draw_map(body, props)
    for title, group, settings in (("Motion", props.settings, RetargetSettings), ("Feet", props.feet, FeetSettings)):
        header, body = layout.panel(f"tricap_retarget_{title}", default_closed=True)
        header.label(text=title)
        if body is not None:
            body.use_property_split = True
            for field in dataclasses.fields(settings):
                body.prop(group, field.name)
    expanded(layout, props, "place")
    layout.prop(props, "tolerance_deg")
    layout.prop(props, "strip")
    buttons = layout.row(align=True)
    buttons.scale_y = 1.3
    buttons.enabled = target is not None and (props.source is not None or bool(props.file))
    buttons.operator("tricap.retarget", icon="ARMATURE_DATA", depress=is_next and target is not None)
    buttons.operator("tricap.retarget_preview", text="Preview", icon="HIDE_OFF")
    if bpy.data.collections.get(preview.NAME) is not None:
        buttons.operator("tricap.retarget_end_preview", text="", icon="X")
    for line in props.last.splitlines():
        sentence(layout, context, line, "DOT")


CLASSES = (TRICAP_UL_map,)
