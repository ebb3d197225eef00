"""What Blender is told of retargeting: properties, operators, and a section of the panel."""

import bpy

from .. import jobs
from . import map_operators, operators, panel, properties


def register() -> None:
    """Register everything, in order."""
    properties.register()
    for cls in (*operators.CLASSES, *map_operators.CLASSES, *panel.CLASSES):
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Stop a running job and take everything away again, in reverse order."""
    jobs.stop_current()
    jobs.stop_watching()
    for cls in reversed((*operators.CLASSES, *map_operators.CLASSES, *panel.CLASSES)):
        bpy.utils.unregister_class(cls)
    properties.unregister()
