"""Registers the overlays: switches, operators, panels in the Clip Editor, and the draw handler."""

import bpy

from . import draw, operators, panel, properties

CLASSES = (*properties.CLASSES, *operators.CLASSES, *panel.CLASSES)


def register() -> None:
    """Register everything, in order."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_overlay = bpy.props.PointerProperty(type=properties.TricapOverlay)
    draw.begin()


def unregister() -> None:
    """Take everything away again, in reverse order."""
    draw.end()
    del bpy.types.Scene.tricap_overlay
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
