"""The error that a user can correct, and the sentence for faults of the computer. Any other exception is a bug."""

import csv
import json
import re
import struct
import zlib
from datetime import date, time

NO_MEMORY = -4  # OpenCV's code
NO_THREAD = "can't start new thread"  # what Python says where the limit of memory or of processes is reached
NO_ROOM = ("failed to map segment", "Cannot allocate memory")  # what the system's loader says of a library for which there is no memory
LONGEST = 1500  # characters of a message
LONGEST_VALUE = 80  # and of a value that it quotes
LONGEST_REASON = 200  # and of what Python says of such a value
QUOTED = re.compile(rf"“([^“”]{{{LONGEST_VALUE}}})[^“”]{{{LONGEST_VALUE // 4},}}”")


class InputError(Exception):
    """The input is faulty. The message is one sentence: what is wrong, which input it is, and what to do.

    Quotations from damaged files are made safe for a terminal: no control characters, no endless lines or quotations.
    """

    def __init__(self, message: str = "") -> None:
        text = "".join(c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in str(message))
        text = QUOTED.sub(r"“\1 …”", text)
        super().__init__(text if len(text) <= LONGEST else text[: LONGEST // 2] + " … " + text[-LONGEST // 2 :])


def shown(value: object) -> str:
    """A value of a TOML or JSON file in a message: as it is written there, shortened."""
    if value is None:
        return "missing"
    text = str(value) if isinstance(value, (date, time, float)) else json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]} …"


def damage_of(error: Exception) -> str:
    """What is wrong with a file that a reader could not read, in plain words where Python's own would not help."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, UnicodeDecodeError):
        return "it is not text in UTF-8"
    if isinstance(error, KeyError) and error.args:
        return f"“{error.args[0]}” is missing"
    if isinstance(error, (IndexError, struct.error)):
        return "it ends too early"
    if isinstance(error, zlib.error):
        return "what is packed in it cannot be unpacked"
    if isinstance(error, (ValueError, csv.Error)):
        reason = str(error)
        return reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]} …"
    return str(error) if isinstance(error, InputError) else "an entry is missing or of a wrong kind"


def with_notes(error: BaseException) -> str:
    """The message of an error, and what was added to it on its way (`add_note`): what the user must also know."""
    return " ".join([str(error), *getattr(error, "__notes__", ())])


def sentence_of(error: BaseException) -> str | None:
    """What to tell the user at the edge of a command or job: of an InputError its message, of a fault of the system, of a disk or of memory
    that no reader or writer expected a sentence with the file; with its notes. None for a bug."""
    reason = _sentence_of(error)
    return None if reason is None else " ".join([reason, *getattr(error, "__notes__", ())])


def _sentence_of(error: BaseException) -> str | None:
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        names = " and ".join(str(name) for name in (error.filename, error.filename2) if name is not None)
        return str(InputError(f"Cannot use {names or 'a file'}: {error.strerror}. Check its name, its rights and its drive."))
    if isinstance(error, RuntimeError) and NO_THREAD in str(error):
        return "No further thread can be started. Close other programs, or raise the limits of memory and processes if there are some."
    no_room = isinstance(error, ImportError) and any(words in str(error) for words in NO_ROOM)
    if isinstance(error, MemoryError) or no_room or getattr(error, "code", None) == NO_MEMORY:
        return "There is not enough memory. Close other programs, raise the limit if there is one, or reduce the images or the settings."
    return None
