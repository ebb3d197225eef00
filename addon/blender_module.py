"""Blender as a Python module, for commands."""

import importlib.util
import os
import sys
from contextlib import suppress
from pathlib import Path


def load_blender() -> bool:
    """Whether there is `bpy`; it is imported from a folder of our own, for it loads all libraries in `plugins` of the working folder."""
    if "bpy" in sys.modules:
        return True
    if importlib.util.find_spec("bpy") is None:
        return False
    before = None
    with suppress(OSError):  # it was deleted
        before = os.getcwd()
    os.chdir(Path(__file__).parent)
    try:
        import bpy  # noqa: F401
    finally:
        if before is not None:
            with suppress(OSError):
                os.chdir(before)
    return True
