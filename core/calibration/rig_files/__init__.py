"""Other tools' calibration files."""

from pathlib import Path

from ...errors import InputError
from ...geometry.rig import Rig, read_rig, write_rig

FORMATS = {"anipose": (read_rig, write_rig)}


def read_any(path: Path) -> Rig:
    """Read a rig."""
    return read_rig(path)


def write_as(path: Path, rig: Rig, name: str) -> list[Path]:
    """Write a rig."""
    if name not in FORMATS:
        raise InputError(f"unknown format {name}")
    write_rig(path, rig)
    return [path]
