"""What all panels share: where they live, and sentences that are wrapped to the sidebar's width. draw() only draws."""

import textwrap

import bpy

CHARACTER_PX, MARGIN_PX, NARROW = 6.6, 40, 20


class TricapPanel:
    """Where all panels live."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Tricap"


def sentence(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE") -> None:
    """A sentence in as many lines as the sidebar's width needs, the icon before the first."""
    region = context.region
    width = region.width / context.preferences.system.ui_scale if region is not None else 0
    column = layout.column(align=True)
    column.scale_y = 0.85
    for n, line in enumerate(wrapped(text, max(NARROW, int((width - MARGIN_PX) / CHARACTER_PX)))):
        column.label(text=line, icon=icon if n == 0 else "NONE" if icon == "NONE" else "BLANK1")


def wrapped(text: str, width: int) -> list[str]:
    """The lines of a text."""
    return [line for part in text.splitlines() for line in textwrap.wrap(part, width)]
