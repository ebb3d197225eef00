"""Registers the overlays: switches, operators, panels in the Clip Editor, and the draw handler."""

import bpy

from . import draw, operators, panel, properties, results

CLASSES = (*properties.CLASSES, *operators.CLASSES, *panel.CLASSES)


@bpy.app.handlers.persistent
def _clear(*_: object) -> None:
    results.clear()
    draw.show_inspection(-1, None)


def register() -> None:
    """Register everything, in order."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_overlay = bpy.props.PointerProperty(type=properties.TricapOverlay)
    bpy.app.handlers.load_pre.append(_clear)
    draw.begin()


def unregister() -> None:
    """Take everything away again, in reverse order."""
    draw.end()
    _clear()
    bpy.app.handlers.load_pre.remove(_clear)
    del bpy.types.Scene.tricap_overlay
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
