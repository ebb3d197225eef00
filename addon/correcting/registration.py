"""Registers corrections: properties, operators, a panel in the Clip Editor, and their part of take.toml."""

import bpy

from ..session import get_session
from . import operators, panel, properties, tables

CLASSES = (*properties.CLASSES, *operators.CLASSES, *panel.CLASSES)


def register() -> None:
    """Register everything, in order."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_correcting = bpy.props.PointerProperty(type=properties.TricapCorrecting)
    session = get_session()
    session.take_writers.append(tables.write)
    session.take_readers.append(tables.read)


def unregister() -> None:
    """Take everything away again, in reverse order."""
    operators.stop_correcting()
    session = get_session()
    session.take_readers.remove(tables.read)
    session.take_writers.remove(tables.write)
    del bpy.types.Scene.tricap_correcting
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
