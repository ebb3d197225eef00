"""Arguments shared by several commands."""

import argparse
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..foundation import bounded
from ..foundation.errors import InputError

DICTIONARY = "DICT_4X4_50"  # default of --dictionary
MOST_DIGITS = 12  # of a frame number
OUTPUTS = ("printed", "preview", "blend", "file", "report", "pictures")  # arguments that name what is written
WITH_OUT = ("calibrate", "track2d", "fields")  # commands with a file, or some, for --out; those with a folder for a run check that
WITH_RESULTS = ("measure", "track", "fit", "run", "contour")  # commands that replace files of their folder --out


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
            value = bounded.toml_of(f"value = {text}")["value"]
        except ValueError:
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
    if not colon or not all(n.isdecimal() and len(n) <= MOST_DIGITS for n in (first, last)):
        raise InputError(f"--frames {text} cannot be read; write the first frame and the one after the last, such as 0:40.")
    return int(first), int(last)


def named_path(text: str) -> Path:
    """A file or folder; an empty argument would mean the working folder and is refused.

    Raises:
        argparse.ArgumentTypeError: it is empty.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError("is empty; name a file or a folder")
    return Path(text)


def with_joined_frames(argv: list[str]) -> list[str]:
    """The arguments with `--frames -5:3` joined by "=", because argparse takes a negative first frame for a flag."""
    frames = [i for i, flag in enumerate(argv[:-1]) if flag == "--frames" and re.match(r"-\d", argv[i + 1])]
    merged = [f"{word}={argv[i + 1]}" if i in frames else word for i, word in enumerate(argv)]
    return [word for i, word in enumerate(merged) if i - 1 not in frames]


def check_not_read(flag: str, out: Path, *read: Path | None) -> None:
    """Refuse to write over a file or folder that the command reads.

    Raises:
        InputError: the two are the same.
    """
    for path in read:
        if path is not None and path.exists() and out.exists() and os.path.samefile(path, out):
            raise InputError(f"{flag} {out} is also an input; choose another name, so that it is not overwritten.")


def refuse_unused(given: Mapping[str, bool], why: str) -> None:
    """Refuse an option that this call would ignore: the first of those that were given, by flag. `why` follows its name.

    Raises:
        InputError: there is one.
    """
    flag = next((flag for flag, is_given in given.items() if is_given), None)
    if flag is not None:
        raise InputError(f"{flag} {why}; leave it out.")


def check_outputs(args: argparse.Namespace) -> None:
    """Check that no file which the command is to write is one that it reads, or a part of a take.

    Raises:
        InputError: it is.
    """
    from ..results import outputs

    names = (*OUTPUTS, "out") if args.command in WITH_OUT else OUTPUTS
    values = {name: value for name, value in vars(args).items() if name not in args.words}
    results = args.out if args.command in WITH_RESULTS else None
    is_rig = args.command == "calibrate" and args.format is None  # another tool's file would make a take unreadable
    outputs.check_outputs(values, names, may_be_rig=is_rig, results=results)


def check_simplify(degrees: float) -> None:
    """Check the tolerance of --simplify.

    Raises:
        InputError: it is out of range.
    """
    if not 0 <= degrees <= 180:
        raise InputError(f"--simplify {degrees:g} is out of range; write 0 to 180 degrees, such as 0.5.")


@contextmanager
def standard_output_kept_clean(args: argparse.Namespace) -> Iterator[None]:
    """Redirect what Blender and its exporters print, also below Python, to standard error, so that scripts can read our standard
    output; with --quiet, discard it."""
    sys.stdout.flush()
    stdout = os.dup(1)
    away = os.open(os.devnull, os.O_WRONLY) if getattr(args, "quiet", False) else os.dup(2)
    os.dup2(away, 1)
    os.close(away)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(stdout, 1)
        os.close(stdout)
