"""The eight numbered steps from footage to a rig that moves: the state of each, what it offers, and how it is drawn."""

import bpy


def _classes() -> tuple[type, ...]:
    from . import cameras, check, export, footage, network, panel, person, report, synchronise

    modules = (footage, person, cameras, check, synchronise, network, export, report, panel)
    return tuple(cls for module in modules for cls in module.CLASSES)


def register() -> None:
    """Register the operators and the panel, and keep the states up to date."""
    from . import check, watch

    for cls in _classes():
        bpy.utils.register_class(cls)
    watch.register()
    check.begin()


def unregister() -> None:
    """Take everything away again, in reverse order."""
    from .. import jobs
    from . import check, watch

    jobs.stop_current()
    jobs.stop_watching()
    check.end()
    watch.unregister()
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
