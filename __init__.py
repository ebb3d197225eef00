"""Tricap: markerless motion capture with calibrated cameras, as a Blender extension and as a Python package.

Importing this package never imports bpy: Blender calls `register`, and only then is the add-on loaded.
"""


def register() -> None:
    """Add Tricap's operators, panels and properties to Blender (called by Blender when the extension is enabled)."""
    from . import addon

    addon.register()


def unregister() -> None:
    """Take out again everything that `register` added."""
    from . import addon

    addon.unregister()
