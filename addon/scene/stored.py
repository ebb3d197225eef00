"""Custom properties in which Tricap stores what it knows of objects, armatures, collections and actions.

A file may come from a stranger, and anybody may edit custom properties: a value of another kind than Tricap writes counts as missing.
"""

import math
from typing import Any

import bpy


def number(thing: bpy.types.ID, key: str) -> float | None:
    """A finite number."""
    value = thing.get(key)
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None


def numbers(thing: bpy.types.ID, key: str, *counts: int) -> list[float] | None:
    """A list of finite numbers, as many as one of `counts`."""
    value = thing.get(key)
    given = value.to_list() if hasattr(value, "to_list") else []
    good = len(given) in counts and all(isinstance(each, (int, float)) and math.isfinite(each) for each in given)
    return [float(each) for each in given] if good else None


def text(thing: bpy.types.ID, key: str) -> str:
    """A text, "" without one."""
    value = thing.get(key)
    return value if isinstance(value, str) else ""


def table(thing: bpy.types.ID, key: str) -> dict[str, Any]:
    """A table as plain values, empty without one."""
    value = thing.get(key)
    return value.to_dict() if hasattr(value, "to_dict") else {}


def rows(thing: bpy.types.ID, key: str, **kinds: type) -> dict[str, dict[str, Any]]:
    """The tables in a table that have values of these names and kinds."""
    tables = {name: row for name, row in table(thing, key).items() if isinstance(row, dict)}
    return {name: row for name, row in tables.items() if all(isinstance(row.get(field), kind) for field, kind in kinds.items())}


def data_block(thing: bpy.types.ID, key: str, kind: type) -> Any | None:
    """An object, action or clip, as `kind` says; None without one."""
    value = thing.get(key)
    return value if isinstance(value, kind) else None
