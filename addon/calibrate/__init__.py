"""Cameras in Blender: calibration from footage of a waved bar (wand), the scene's cameras as a rig, other tools' rigs in and out."""

import bpy


def _classes() -> tuple[type, ...]:
    from . import operators, properties, world

    return (properties.TricapCalibrate, *operators.CLASSES, *world.CLASSES)


def register() -> None:
    """Register everything, in order."""
    from . import properties

    for cls in _classes():
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_calibrate = bpy.props.PointerProperty(type=properties.TricapCalibrate)


def unregister() -> None:
    """Stop a running job and take everything away again, in reverse order."""
    from .. import jobs

    jobs.stop_current()
    jobs.stop_watching()
    del bpy.types.Scene.tricap_calibrate
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
