"""What Blender is told of clicking: operators and a section in the Clip Editor."""

import atexit

import bpy

from . import finder, open_views, operators, panel

CLASSES = (*operators.CLASSES, *open_views.CLASSES, *panel.CLASSES)


@bpy.app.handlers.persistent
def _close_before_load(*_: object) -> None:
    finder.close_all()


def register() -> None:
    """Register everything, in order."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.CLIP_HT_header.prepend(open_views.draw_back)
    bpy.app.handlers.load_pre.append(_close_before_load)
    atexit.register(finder.close_all)


def unregister() -> None:
    """End what runs and take everything away again, in reverse order."""
    operators.stop_clicking()
    finder.close_all()
    atexit.unregister(finder.close_all)
    bpy.app.handlers.load_pre.remove(_close_before_load)
    bpy.types.CLIP_HT_header.remove(open_views.draw_back)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
