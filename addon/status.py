"""The words at the lower edge of the window: told in the workspace that is shown, and taken back wherever they were told."""

import bpy

from .session import get_session


def tell(context: bpy.types.Context, words: str | None) -> None:
    """Show these words in the workspace that is shown and nowhere else; None: none of ours any more."""
    here = context.window.workspace if context.window is not None else context.workspace  # the context's may be the one before
    shown = get_session().status_workspaces  # Blender keeps a text with each workspace
    for name in shown:
        there = bpy.data.workspaces.get(name)
        if there is not None and there != here:
            _set(context, there, None)
    shown.clear()
    if here is not None:
        _set(context, here, words)
        if words:
            shown.add(here.name)


def _set(context: bpy.types.Context, workspace: bpy.types.WorkSpace, words: str | None) -> None:
    with context.temp_override(workspace=workspace):  # Blender asks the context which workspace is meant
        workspace.status_text_set(words)
