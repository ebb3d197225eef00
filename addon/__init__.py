"""The Blender side of Tricap: the only package that imports bpy or mathutils, and only once it is registered."""

from types import ModuleType


def _modules() -> tuple[ModuleType, ...]:
    from . import (
        calibrate,
        clicking,
        command,
        correcting,
        editing,
        jobs,
        operators,
        overlay,
        points,
        properties,
        reopened,
        retarget,
        session,
        steps,
    )

    first = session, jobs, properties, operators, calibrate, retarget, clicking, overlay
    return *first, points, correcting, editing, steps, reopened, command


def register() -> None:
    """Add everything to Blender, in order."""
    for module in _modules():
        module.register()


def unregister() -> None:
    """Take everything away again, in reverse order."""
    for module in reversed(_modules()):
        module.unregister()
