"""The take's and the output's folder, from the panel or from an operator's arguments."""

import os
from pathlib import Path

import bpy

from ..core.foundation.bounded import real_path, real_place
from ..core.foundation.errors import InputError


def take_folder(given: str, scene: bpy.types.Scene) -> Path:
    """The folder of the take: `given`, or the panel's.

    Raises:
        InputError: none was chosen, or it is not a folder.
    """
    chosen = given or scene.tricap.take
    if not chosen:
        raise InputError("Choose the take first: the folder of a recording that contains take.toml.")
    folder = absolute(chosen)
    if not folder.is_dir():
        raise InputError(f"The take {folder} is not a folder; choose the folder that contains take.toml.")
    return folder


def output_folder(given: str, scene: bpy.types.Scene, take: str = "") -> Path:
    """The output folder: `given`, or the panel's, or one named after the take next to the .blend (if it is saved) or the take.

    Raises:
        InputError: it is relative to a .blend that was never saved.
    """
    chosen = given or scene.tricap.out
    if chosen:
        return absolute(chosen)
    folder = take_folder(take, scene)
    parent = Path(bpy.data.filepath).parent if bpy.data.filepath else folder.parent
    return parent / f"{folder.name}_tricap"


def check_writable(folder: Path) -> None:
    """Check that `folder` can be written to, or created.

    Raises:
        InputError: it cannot.
    """
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise InputError(f"Cannot write into {existing}; choose another output folder.")


def absolute(path: str) -> Path:
    """The full path of what a user chose, to read it; links are followed.

    Raises:
        InputError: it is relative to a .blend that was never saved.
    """
    return real_path(_from_blend(path))


def to_write(path: str) -> Path:
    """The full path of a file that a user chose, to write it; a link of this name will be replaced, not followed.

    Raises:
        InputError: none was chosen, or it is relative to a .blend that was never saved.
    """
    if not path:
        raise InputError("Choose the file to write.")
    return real_place(_from_blend(path))


def _from_blend(path: str) -> str:
    if path.startswith("//") and not bpy.data.filepath:
        raise InputError(f"{path} is relative to the Blender file, which was never saved. Save it, or choose a full path.")
    return str(bpy.path.abspath(path))


def for_user(path: Path) -> str:
    """A path for the panel: relative to the .blend if that is saved on the same disk, so that both can be moved together."""
    try:
        return bpy.path.relpath(str(path)) if bpy.data.filepath else str(path)
    except ValueError:  # another drive
        return str(path)
