"""Joint clicks and surface seeds: clicked in the Clip Editor, drawn over the footage."""

import atexit
from typing import Any

import bpy


@bpy.app.handlers.persistent
def _close_before_load(*_: Any) -> None:
    from . import finder

    finder.close_all()


def _classes() -> tuple[type, ...]:
    from . import open_views, operators, panel

    return (*operators.CLASSES, *open_views.CLASSES, *panel.CLASSES)


def register() -> None:
    """Register everything, in order."""
    from . import finder, open_views

    for cls in _classes():
        bpy.utils.register_class(cls)
    bpy.types.CLIP_HT_header.prepend(open_views.draw_back)
    bpy.app.handlers.load_pre.append(_close_before_load)
    atexit.register(finder.close_all)


def unregister() -> None:
    """End what runs and take everything away again, in reverse order."""
    from . import finder, open_views, operators

    operators.stop_clicking()
    finder.close_all()
    atexit.unregister(finder.close_all)
    bpy.app.handlers.load_pre.remove(_close_before_load)
    bpy.types.CLIP_HT_header.remove(open_views.draw_back)
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
