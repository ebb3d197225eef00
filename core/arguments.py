"""Arguments that several commands share."""

import tomllib
from typing import Any

from .errors import InputError


def overrides(pairs: list[str]) -> dict[str, dict[str, Any]]:
    """--set GROUP.NAME=VALUE as tables; values are read as TOML, plain words as text.

    Raises:
        InputError: it cannot be read.
    """
    tables: dict[str, dict[str, Any]] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        group, dot, knob = name.partition(".")
        if not equals or not dot:
            raise InputError(f"--set {pair} cannot be read; write GROUP.NAME=VALUE, such as matching.patch_px=17.")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text
        tables.setdefault(group, {})[knob] = value
    return tables


def frame_range(text: str | None) -> tuple[int, int] | None:
    """--frames A:B as (A, B), None where it was not given.

    Raises:
        InputError: it cannot be read.
    """
    if text is None:
        return None
    first, colon, last = text.partition(":")
    if not colon or not first.isdecimal() or not last.isdecimal():
        raise InputError(f"--frames {text} cannot be read; write the first frame and one after the last, such as 0:40.")
    return int(first), int(last)


def pictured(frames: range, wanted: list[int]) -> list[int]:
    """--pictures FRAME …: frames that are there.

    Raises:
        InputError: a frame is not.
    """
    for frame in wanted:
        if frame not in frames:
            raise InputError(f"--pictures {frame} is not among the frames {frames.start} to {frames.stop - 1}; choose others.")
    return wanted
