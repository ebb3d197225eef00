"""The user's corrections: trajectories to remove, regions to exclude, degrees of freedom to lock or to limit."""

import bpy


def _classes() -> tuple[type, ...]:
    from . import fit_again, operators, panel, properties, pull_joint, review, set_floor

    return (
        *properties.CLASSES,
        *operators.CLASSES,
        *pull_joint.CLASSES,
        *fit_again.CLASSES,
        *review.CLASSES,
        *set_floor.CLASSES,
        *panel.CLASSES,
    )


def register() -> None:
    """Register everything, in order."""
    from ..session import get_session
    from . import properties, tables

    for cls in _classes():
        bpy.utils.register_class(cls)
    bpy.types.Scene.tricap_correcting = bpy.props.PointerProperty(type=properties.TricapCorrecting)
    session = get_session()
    session.take_writers.append(tables.write)
    session.take_readers.append(tables.read)


def unregister() -> None:
    """Remove everything, in reverse order."""
    from ..session import get_session
    from . import tables

    session = get_session()
    session.take_readers.remove(tables.read)
    session.take_writers.remove(tables.write)
    del bpy.types.Scene.tricap_correcting
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
