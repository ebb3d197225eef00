"""Values of take.toml, checked as they are read; every refusal is an InputError in one sentence."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeGuard

from .errors import InputError
from .settings import nearest_name


def frame_pair(value: Any, where: str) -> tuple[int, int] | None:
    """`frames`, half-open, or None where it is not there."""
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 2 or not all(isinstance(v, int) for v in value) or not 0 <= value[0] < value[1]:
        raise InputError(f"`frames` of {where} is {value!r}; write [first, one after the last].")
    return value[0], value[1]


def inside(folder: Path, name: Any, where: str, key: str = "rig") -> Path:
    """The path of a file that must lie in the take's folder."""
    if not isinstance(name, str) or Path(name).is_absolute() or ".." in Path(name).parts:
        raise InputError(f"`{key}` of {where} is {name!r}; it must be a file inside the take's folder. Copy it there.")
    return folder / name


def table_of(table: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    """A table of a table, empty where it is not there."""
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"[{key}] of {where} must be a table.")
    return value


def tables_of(table: Mapping[str, Any], key: str, where: str) -> list[Mapping[str, Any]]:
    """A list of tables, empty where it is not there."""
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise InputError(f"`{key}` of {where} must be written as [[{key}]] tables.")
    return value


def check_keys(table: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
    """Refuse a key that is not known."""
    for key in table:
        if key not in known:
            raise InputError(f"{where} has an unknown key “{key}”.{nearest_name(str(key), known)}")


def is_pixel(value: Any) -> bool:
    """Whether it is [x, y]."""
    return isinstance(value, list) and len(value) == 2 and all(is_number(v) for v in value)


def is_number(value: Any) -> TypeGuard[float]:
    """Whether it is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
