"""Mappings that were used, found again for the same rig: one file for each set of bone names, in the extension's folder for the user."""

from dataclasses import replace
from pathlib import Path

import bpy

from ...core.foundation import store
from ...core.foundation.errors import InputError
from ...core.motion.retarget.mapping import RigMap, apply_preset, read_preset, write_map
from ...core.motion.retarget.rig import Rig

PACKAGE = __package__.removesuffix(".addon.retarget")
FOLDER = "mappings"
NOTE = "the mapping is that of the last time for this rig; press Recognise twice to make it anew"


def file_of(rig: Rig) -> Path | None:
    """The file of a rig's mapping, whether it exists or not; None where Tricap is not an extension of Blender."""
    if not PACKAGE.startswith("bl_ext."):
        return None
    folder = bpy.utils.extension_path_user(PACKAGE, path=FOLDER)
    return Path(folder) / f"{store.digest(repr(sorted(rig.names)))}.json"


def keep(rig: Rig, rig_map: RigMap, name: str) -> None:
    """Keep a mapping for all rigs with these bones.

    Raises:
        InputError: the file cannot be written.
    """
    file = file_of(rig)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_map(file, rig_map, name)


def found_again(rig: Rig) -> RigMap | None:
    """The mapping that was kept for rigs with these bones; None if there is none, or it was damaged since."""
    file = file_of(rig)
    if file is None or not file.is_file():
        return None
    try:
        return replace(apply_preset(rig, read_preset(file)), notes=(NOTE,))
    except InputError:
        return None  # it was edited or damaged: recognising the rig again replaces it
