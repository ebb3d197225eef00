"""What Blender is told of the overlays: switches, operators, sections in the Clip Editor, and what draws."""

import bpy

from . import contours, draw, operators, panel, properties, recording

CLASSES = (*properties.CLASSES, *operators.CLASSES, *contours.CLASSES, *panel.CLASSES)


@bpy.app.handlers.persistent
def _forget(*_: object) -> None:
    recording.forget()
    draw.show_looked(-1, None)


def register() -> None:
    """Register everything, in order; the drawing itself only where there is a window."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_overlay = bpy.props.PointerProperty(type=properties.TricapOverlay)
    bpy.app.handlers.load_pre.append(_forget)
    draw.begin()


def unregister() -> None:
    """Take everything away again, in reverse order."""
    draw.end()
    _forget()
    bpy.app.handlers.load_pre.remove(_forget)
    del bpy.types.Scene.tricap_overlay
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
