"""What Blender is told of the steps: their operators, the panel, and what keeps their states up to date."""

import bpy

from .. import jobs
from . import cameras, check, export, footage, panel, person, watch

CLASSES = (*footage.CLASSES, *person.CLASSES, *cameras.CLASSES, *check.CLASSES, *export.CLASSES, *panel.CLASSES)


def register() -> None:
    """Register everything, in order."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    watch.register()


def unregister() -> None:
    """Take everything away again, in reverse order."""
    jobs.stop_current()
    jobs.stop_watching()
    watch.unregister()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
