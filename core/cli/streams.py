"""Standard output and standard error, whatever they are: closed, full, a pipe that nobody reads, or without some of our characters.

None of that ends a computation, or changes the exit code of what was found; only output that was asked for and could not be written, such
as on a full disk, is a fault of its own.
"""

import codecs
import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from ..foundation.errors import InputError

JOINERS = "\u200c\u200d"  # invisible, and harmless parts of words and pictures
ESCAPED = "tricap-escaped"  # the name of our error handler
NOBODY_READS = {errno.EPIPE, errno.ESHUTDOWN, *({errno.EINVAL} if os.name == "nt" else set())}


def _escaped(error: UnicodeError) -> tuple[str, int]:
    """Characters that an encoding lacks, as in JSON: \\u201c, in two parts beyond 16 bits."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return _as_in_json(error.object[error.start : error.end]), error.end


def _as_in_json(text: str) -> str:
    units = text.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[i : i + 4]}" for i in range(0, len(units), 4))


def visible(text: str) -> str:
    """A text in which names from files cannot steer a terminal or turn the direction of writing; what would becomes \\u001b and the like,
    which leaves JSON what it was."""
    return text if text.isprintable() else "".join(c if c.isprintable() or c in "\n\t" + JOINERS else _as_in_json(c) for c in text)


codecs.register_error(ESCAPED, _escaped)


@contextmanager
def robust() -> Iterator[None]:
    """While it lasts, both streams exist and take every character; at the end they are flushed, and given up where that fails."""
    _open_missing()
    before = [(stream, stream.errors) for stream in (sys.stdout, sys.stderr) if hasattr(stream, "reconfigure")]
    for stream, _ in before:
        stream.reconfigure(errors=ESCAPED)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:
                _give_up(stream)
        for stream, errors in before:
            stream.reconfigure(errors=errors)


@contextmanager
def unheard() -> Iterator[None]:
    """What libraries print goes nowhere: what matters is said afterwards, and a stream that is full or closed would end them."""
    numbers = [number for number in (1, 2) if _is_open(number)]
    _flush()
    kept, nowhere = [os.dup(number) for number in numbers], os.open(os.devnull, os.O_WRONLY)
    try:
        for number in numbers:
            os.dup2(nowhere, number)
        yield
    finally:
        _flush()
        for number, before in zip(numbers, kept):
            os.dup2(before, number)
            os.close(before)
        os.close(nowhere)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()


def _is_open(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


def write_line(text: str, stream: Any) -> None:
    """Write a line, as `visible`, and flush it; where nobody reads it, it and all further ones are dropped.

    Raises:
        InputError: it cannot be written to standard output, such as to a file on a full disk.
    """
    write(f"{visible(text)}\n", stream)


def write(text: str, stream: Any) -> None:
    """Write a text without a line end, such as a progress bar, as `write_line` does.

    Raises:
        InputError: see there.
    """
    try:
        stream.write(text)
        stream.flush()
    except OSError as error:
        _give_up(stream)
        if stream is sys.stdout and error.errno not in NOBODY_READS:
            where = "Cannot write the output of this command"
            raise InputError(f"{where}: {error.strerror or error}. Free some space, or send it elsewhere.") from error


def _give_up(stream: Any) -> None:
    """Whatever is written to a stream, and what waits in its buffer, is dropped from here."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def _open_missing() -> None:
    """Give the program the streams that it was started without; otherwise the next file that is opened would take their number."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number: this one
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
