"""Registers corrections: properties, operators, a panel in the Clip Editor, and their part of take.toml."""

import bpy

from .. import project
from . import operators, panel, properties, tables

CLASSES = (*properties.CLASSES, *operators.CLASSES, *panel.CLASSES)


def register() -> None:
    """Register everything, in order."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_correcting = bpy.props.PointerProperty(type=properties.TricapCorrecting)
    project.WRITERS.append(tables.write)
    project.READERS.append(tables.read)


def unregister() -> None:
    """Take everything away again, in reverse order."""
    operators.stop_correcting()
    project.READERS.remove(tables.read)
    project.WRITERS.remove(tables.write)
    del bpy.types.Scene.tricap_correcting
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
