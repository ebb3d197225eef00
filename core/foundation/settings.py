"""Settings: one definition per knob, in a frozen dataclass at the head of the stage that uses it.

A knob is a dataclass field made by `knob`: default, range, unit and one sentence. take.toml's tables, the command's `--set`
and the add-on's properties are all made from these definitions, so a knob has the same name and limits everywhere.
"""

import dataclasses
import difflib
from collections.abc import Mapping
from typing import Any, TypeVar

from .errors import InputError, shown

T = TypeVar("T")
LARGEST_NUMBER = 1e300  # beyond: infinity, or a whole number that no float can hold


def knob(
    default: Any,
    about: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    was: tuple[str, ...] = (),
) -> Any:
    """A dataclass field that describes itself: `about` is one sentence, `low`/`high` are inclusive limits in `unit`.

    `was` are earlier names of the knob, under which files and commands of earlier versions may still set it; one in another group has the
    form "group.name".
    """
    return dataclasses.field(default=default, metadata=dict(about=about, unit=unit, low=low, high=high, choices=choices, was=was))


def nearest_name(name: str, known: "list[str] | tuple[str, ...]") -> str:
    """A hint " (did you mean “x”?)" for a misspelt name, or the list of what is known."""
    lower = {k.lower(): k for k in known}
    close = difflib.get_close_matches(name.lower(), list(lower), n=1, cutoff=0.5)
    return f" Did you mean “{lower[close[0]]}”?" if close else f" Known are: {', '.join(known)}."


def from_table(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """Settings of class `cls` from a table of a file or of the command line.

    Raises:
        InputError: an unknown name (the nearest known one is named), a value of the wrong kind or outside its limits, a knob set
            under two of its names.
    """
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for name, value in current_names(cls, table, where).items():
        if name not in fields:
            raise InputError(f"{where} has no setting “{name}”.{nearest_name(name, list(fields))}")
        values[name] = _checked(value, fields[name], where)
    return cls(**values)


def current_names(cls: type, table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The table with each knob of `cls` under the name that it has today. Unknown names stay as they are.

    Raises:
        InputError: a knob is set under two of its names.
    """
    today = {earlier: f.name for f in dataclasses.fields(cls) for earlier in f.metadata.get("was", ())}
    renamed: dict[str, Any] = {}
    for given, value in table.items():
        name = today.get(given, given)
        if name in renamed:
            raise InputError(f"{where} sets “{name}” twice, also under its earlier name; remove one of them.")
        renamed[name] = value
    return renamed


def current_tables(tables: Mapping[str, Mapping[str, Any]], groups: Mapping[str, type], place: str) -> dict[str, dict[str, Any]]:
    """Tables of settings by group, with each knob in the group and under the name that it has today. `place` ends the names of tables.

    Raises:
        InputError: an unknown group, or a knob that is set under two of its names.
    """
    knobs = [(name, f) for name, cls in groups.items() for f in dataclasses.fields(cls)]
    moved = {earlier: (name, f.name) for name, f in knobs for earlier in f.metadata.get("was", ())}
    current: dict[str, dict[str, Any]] = {name: {} for name in groups}
    for name, table in tables.items():
        if name not in groups:
            raise InputError(f"There is no group of settings “{name}”{place}.{nearest_name(name, list(groups))}")
        for given, value in current_names(groups[name], table, f"[{name}]{place}").items():
            group, today = moved.get(f"{name}.{given}", (name, given))
            if today in current[group]:
                raise InputError(f"[{group}]{place} sets “{today}” twice, also under its earlier name; remove one of them.")
            current[group][today] = value
    return current


def _checked(value: Any, field: "dataclasses.Field[Any]", where: str) -> Any:
    default, meta = field.default, field.metadata
    label = f"Setting “{field.name}” of {where}"
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise InputError(f"{label} is {shown(value)}; write true or false.")
        return value
    if isinstance(default, str):
        if not isinstance(value, str) or (meta.get("choices") and value not in meta["choices"]):
            raise InputError(f"{label} is {shown(value)}; choose one of: {', '.join(meta.get('choices') or ('a text',))}.")
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < LARGEST_NUMBER:
        raise InputError(f"{label} is {repr(value)[:40]}; a number{' in ' + meta['unit'] if meta.get('unit') else ''} is needed.")
    if isinstance(default, int) and value != int(value):
        raise InputError(f"{label} is {shown(value)}; a whole number is needed.")
    low, high = meta.get("low"), meta.get("high")
    if (low is not None and value < low) or (high is not None and value > high):
        raise InputError(f"{label} is {value:g} {meta.get('unit', '')}; it must lie between {low} and {high}.".replace(" ;", ";"))
    return int(value) if isinstance(default, int) else float(value)


def to_table(settings: Any) -> dict[str, Any]:
    """The settings as a plain table of names and values, for a file."""
    return dataclasses.asdict(settings)
