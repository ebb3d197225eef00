"""Shared by panels and buttons: their place, what an operator says, wrapped sentences, and the status bar. draw() only draws."""

from collections.abc import Callable

import blf
import bpy

from ..core.foundation.errors import InputError, sentence_of
from .session import get_session

# of a sidebar, at the interface's usual scale: what is left and right of its texts, the icon before them, and texts at least
MARGIN_PX, ICON_PX, NARROW_PX = 62, 22, 130
FONT = 0  # Blender's own, in which labels are drawn


class TricapPanel:
    """The place of all panels of the 3-D view."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Tricap"


class TellingOperator:
    """Mix-in: `do` is the work; what it says is reported, and so is the sentence of an error."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do it."""
        try:
            check_own(context.scene)
            message = self.do(context)
        except Exception as error:  # the edge of the operator: faults of the input and of the system are told, bugs are raised
            reason = sentence_of(error)
            if reason is None:
                raise
            self.report({"ERROR"}, reason)  # type: ignore[attr-defined]
            return {"CANCELLED"}
        if message:
            self.report({"INFO"}, message)  # type: ignore[attr-defined]
        return {"FINISHED"}

    def do(self, context: bpy.types.Context) -> str:
        """The work; returns a sentence to report, or "".

        Raises:
            InputError: it cannot be done; nothing was changed.
        """
        raise NotImplementedError


def check_own(scene: bpy.types.Scene) -> None:
    """Check that a scene can be changed.

    Raises:
        InputError: it is linked from another file.
    """
    if scene.library is not None:
        raise InputError(
            f"The scene “{scene.name}” is linked from another file. Open that file, or link its collections into your own scene."
        )


def sentence(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE") -> None:
    """A sentence, wrapped to the sidebar's width, with the icon before its first line."""
    region, scale = context.region, context.preferences.system.ui_scale or 1.0  # 0 in the background
    width = region.width / scale - MARGIN_PX - (ICON_PX if icon != "NONE" else 0) if region is not None else 0
    blf.size(FONT, context.preferences.ui_styles[0].widget.points)
    column = layout.column(align=True)
    column.scale_y = 0.85
    for n, line in enumerate(wrapped(text, max(NARROW_PX, width), lambda part: blf.dimensions(FONT, part)[0])):
        column.label(text=line, icon=icon if n == 0 else "NONE" if icon == "NONE" else "BLANK1")


def expanded(layout: bpy.types.UILayout, data: bpy.types.bpy_struct, name: str) -> None:
    """The choices of a property side by side over the full width, so that their names are legible in a narrow sidebar."""
    row = layout.row()
    row.use_property_split = False
    row.prop(data, name, expand=True)


def wrapped(text: str, width: float, measure: Callable[[str], float]) -> list[str]:
    """The lines of a text that are at most so wide, by `measure`; a word that is wider has a line of its own."""
    lines: list[str] = []
    for part in text.splitlines():
        line = ""
        for word in part.split():
            longer = f"{line} {word}" if line else word
            if line and measure(longer) > width:
                lines.append(line)
                longer = word
            line = longer
        lines += [line] if line else []
    return lines


def show_status(context: bpy.types.Context, words: str | None) -> None:
    """Show a text in the status bar of the workspace that is shown, and in no other; None takes ours away."""
    here = context.window.workspace if context.window is not None else context.workspace  # the context's may be the one before
    shown = get_session().status_workspaces  # Blender stores a text with each workspace
    for name in shown:
        there = bpy.data.workspaces.get(name)
        if there is not None and there != here:
            _set_status(context, there, None)
    shown.clear()
    if here is not None:
        _set_status(context, here, words)
        if words:
            shown.add(here.name)


def _set_status(context: bpy.types.Context, workspace: bpy.types.WorkSpace, words: str | None) -> None:
    with context.temp_override(workspace=workspace):  # Blender asks the context which workspace is meant
        workspace.status_text_set(words)
