"""Retargeting: a motion onto any rig, and its export to other programs. `command` and `programs` need no bpy."""


def _classes() -> tuple[type, ...]:
    from . import map_operators, operators, panel, robot

    return (*operators.CLASSES, *map_operators.CLASSES, *robot.CLASSES, *panel.CLASSES)


def register() -> None:
    """Register everything, in order."""
    import bpy

    from . import properties

    properties.register()
    for cls in _classes():
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Stop a running job and remove everything, in reverse order."""
    import bpy

    from .. import jobs
    from . import properties

    jobs.stop_current()
    jobs.stop_watching()
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
    properties.unregister()
