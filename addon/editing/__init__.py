"""Edits of the body's own action: smoothing where it is uncertain, fewer keys, foot lock; and its uncertainty, shown."""

import bpy


def _classes() -> tuple[type, ...]:
    from . import operators

    return operators.CLASSES


def register() -> None:
    """Register the operators and the drawing."""
    from . import uncertainty

    for cls in _classes():
        bpy.utils.register_class(cls)
    uncertainty.begin()


def unregister() -> None:
    """Remove them."""
    from . import uncertainty

    uncertainty.end()
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
