"""Single points: clicked in the Clip Editor, followed in space (two views or more) or in one image, joined by lines."""

import bpy


def _classes() -> tuple[type, ...]:
    from . import click, follow, join, panel

    return (*click.CLASSES, *follow.CLASSES, *join.CLASSES, *panel.CLASSES)


def register() -> None:
    """Register everything, in order."""
    for cls in _classes():
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Remove everything, in reverse order."""
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
