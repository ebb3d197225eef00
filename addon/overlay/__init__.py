"""Results and corrections drawn over the footage in the Clip Editor, and the list of doubtful frames."""

import bpy


def _classes() -> tuple[type, ...]:
    from . import operators, panel, properties

    return (*properties.CLASSES, *operators.CLASSES, *panel.CLASSES)


def register() -> None:
    """Register everything, in order."""
    from . import draw, properties

    for cls in _classes():
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_overlay = bpy.props.PointerProperty(type=properties.TricapOverlay)
    draw.begin()


def unregister() -> None:
    """Remove everything, in reverse order."""
    from . import draw

    draw.end()
    del bpy.types.Scene.tricap_overlay
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
