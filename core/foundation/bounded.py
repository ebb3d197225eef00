"""Files from outside, opened and parsed in one place: a regular file, not larger than its kind may be, before its first byte is read.

Pipes, devices and sockets never end or never begin; a sparse file of gigabytes takes no room on the disk. Texts are parsed within limits
of nesting, of digits and of the parts of a key, so that a megabyte takes neither minutes nor gigabytes, and no value breaks later
arithmetic. Faults are OSError and ValueError, which every reader turns into the sentence that says what the file is and what to do.
"""

import errno
import fnmatch
import io
import json
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree import ElementTree as Xml

from .errors import InputError

TOML_BYTES = 4 << 20  # take.toml, rig.toml, body.toml, a body model: thousands of clicks
CALIBRATION_BYTES = 50_000_000  # other tools' files, some of which contain all observations
JSON_BYTES = 1 << 28
TABLE_BYTES = 1 << 30  # CSV, TRC, C3D, BVH: hours of motion
IMAGE_BYTES = 1 << 29  # 36 megapixels of 4 × 16 bits, not compressed, are 0.3 GB
ARRAYS_BYTES = 8 << 30  # PLY and our own .npz
MOVIE_BYTES = 1 << 42  # decoded piece by piece

MOST_KEY_PARTS = 32  # of a dotted TOML key, for whose parts tomllib needs quadratic time
LONGEST_PATTERN = 1000  # characters of a pattern of files
WILDCARDS = frozenset("*?[")
MARKS_OF_A_RUN = {"run.json": b'{"format":"tricap-run"', ".tricap-lock": b'{"pid":'}  # how these files begin, without white space
LONGEST_MARK = 100  # bytes
LISTED_FILES = ".tricap-files"  # a list of the files that a command wrote into a folder, such as pictures
DEEPEST = 64  # tables and lists in each other
TOO_DEEP = f"more than {DEEPEST} tables and lists in each other"
WHOLE_BITS = 63  # of a whole number, as TOML has it
PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
DEVICES = r"^(con|prn|aux|nul|com[1-9¹²³]|lpt[1-9¹²³]) *(\.|$)"  # of Windows, whatever follows the dot
UNFIT_FOR_NAMES = re.compile(r'^$|[/\\:*?"<>|\x00-\x1f\x7f]|[. ]$|' + DEVICES, re.IGNORECASE)
LINE_BREAKS_AND_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
LONG_KEY = re.compile(rf"(?<![\w.-]){PART}(?:[ \t]*+\.[ \t]*+{PART}){{{MOST_KEY_PARTS}}}")


@contextmanager
def opened(path: Path, largest: int) -> Iterator[BinaryIO]:
    """A file to be read in pieces.

    Raises:
        OSError: it cannot be opened, is no regular file, or is larger than `largest` bytes.
    """
    path = Path(path)
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "no file has such a name", _shown(path))
    _check(path.stat(), path, largest)  # before it is opened: opening a pipe waits, opening a device may change it
    handle = os.open(path, os.O_RDONLY | _flag("O_BINARY") | _flag("O_CLOEXEC") | _flag("O_NONBLOCK"))
    with os.fdopen(handle, "rb") as file:
        _check(os.fstat(handle), path, largest)
        yield file


def _flag(name: str) -> int:
    return int(getattr(os, name, 0))  # not every system has each


def _check(state: os.stat_result, path: Path, largest: int) -> None:
    if stat.S_ISDIR(state.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder", str(path))
    if not stat.S_ISREG(state.st_mode):
        raise OSError(errno.EINVAL, "it is a device, a pipe or a socket, not a file", str(path))
    if state.st_size > largest:
        raise OSError(errno.EFBIG, f"it is larger than {_size(largest)}, the most that such a file may have", str(path))


def _size(count: int) -> str:
    return f"{count / (1 << 30):.0f} GB" if count >= 1 << 30 else f"{count / (1 << 20):.0f} MB"


def check_name(path: Path) -> None:
    """Check that a name can be written into files and reports, and given to other libraries: on some systems names are any bytes, and
    OpenCV and Blender crash, or raise, where they are no text.

    Raises:
        InputError: it is no Unicode text.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"The name of {_shown(path)} is not UTF-8; rename it, or a folder above it.") from error


def is_path(text: str) -> bool:
    """Whether a text from a file can be the name of a file or folder."""
    try:
        os.fsencode(text)
    except UnicodeEncodeError:  # lone surrogates
        return False
    return "\0" not in text


def is_plain(name: str) -> bool:
    """Whether a name from a file is one line of text, which can be written into a line of another file."""
    return bool(name.strip()) and LINE_BREAKS_AND_CONTROLS.search(name) is None


def fits_file_names(name: str) -> bool:
    """Whether a name from a file can be the name of a file, or begin it, on every system, and leads to no other folder."""
    return is_plain(name) and UNFIT_FOR_NAMES.search(name) is None


def _shown(path: Path) -> str:
    return str(path).encode(errors="backslashreplace").decode()


def real_path(path: str | Path) -> Path:
    """The absolute path, without links; where these lead in a circle, up to the circle (`Path.resolve` may fail there)."""
    return Path(os.path.realpath(path))


def real_place(path: str | Path) -> Path:
    """The absolute path; only a link of this very name stays one, so that a file which is written there replaces it and not its end."""
    return real_path(Path(path).parent) / Path(path).name


def check_file(path: Path, largest: int) -> None:
    """Check a file that another library opens by its name.

    Raises:
        OSError: it cannot be opened, is no regular file, or is larger than `largest` bytes.
    """
    with opened(path, largest):
        pass


def matching(folder: Path, pattern: str) -> list[Path]:
    """What a pattern of files names in a folder; nothing where it is no pattern.

    Every folder is searched once for each part of the pattern: two links to the folder itself give “*/*/*/*.png” sixteen names for it,
    and twenty-five parts more names than anybody can wait for. A wildcard does not enter the folder of a run, or of our pictures:
    these are no footage.
    """
    if len(pattern) > LONGEST_PATTERN:
        return []
    parts = Path(pattern).parts
    folders = [folder]
    try:
        for part in parts[:-1]:
            inside = sorted((path for outer in folders for path in _folders(outer, part)), reverse=True)
            folders = list({_identity(path): path for path in inside}.values())
        return [path for outer in folders for path in _named(outer, parts[-1])]
    except (ValueError, IndexError, NotImplementedError):  # raised by pathlib for an invalid pattern
        return []


def _named(outer: Path, part: str) -> list[Path]:
    """What a part of a pattern names in a folder. The time of pathlib's own matching grows exponentially with the wildcards."""
    if part == "**" or not WILDCARDS.intersection(part):
        return [*outer.glob(part)]
    try:
        return [outer / name for name in fnmatch.filter(os.listdir(outer), part)]
    except OSError:  # as pathlib: no folder, or none that may be read
        return []


def _folders(outer: Path, part: str) -> list[Path]:
    """The folders that a part of a pattern names; of a pattern with wildcards without those that we wrote, and what is inside these."""
    found = [path for path in _named(outer, part) if path.is_dir()]
    if not WILDCARDS.intersection(part):
        return found
    ours = {path for path in found if path != outer and (is_of_a_run(path) or _begins(path / LISTED_FILES, b"["))}
    return [path for path in found if not ours.intersection((path, *path.parents))]


def is_of_a_run(folder: Path) -> bool:
    """Whether a run wrote its results into a folder, or is writing them: it has our run.json or our lock."""
    return any(_begins(folder / name, start) for name, start in MARKS_OF_A_RUN.items())


def _begins(path: Path, start: bytes) -> bool:
    try:
        with opened(path, JSON_BYTES) as file:
            return b"".join(file.read(LONGEST_MARK).split()).startswith(start)
    except OSError:
        return False


def _identity(path: Path) -> tuple[int, int] | Path:
    """The same for all names of a folder."""
    state = path.stat()
    return (state.st_dev, state.st_ino) if state.st_ino else real_path(path)  # not every drive of Windows has numbers


def bytes_of(path: Path, largest: int) -> bytes:
    """The content of a file.

    Raises:
        OSError: it cannot be read, is no regular file, is larger than `largest` bytes, or has more bytes than its size, as those of /proc.
    """
    with opened(path, largest) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1)
    if data is None or len(data) > size:
        raise OSError(errno.EBUSY, "it grows while it is read", str(path))
    return data


def text_of(path: Path, largest: int, errors: str = "strict") -> str:
    """The text of a file in UTF-8, with or without a byte order mark; ends of lines become “\\n”.

    Raises:
        OSError: see `bytes_of`.
        UnicodeDecodeError: it is in another encoding.
    """
    return io.TextIOWrapper(io.BytesIO(bytes_of(path, largest)), encoding="utf-8-sig", errors=errors).read()


def toml_of(text: str) -> dict[str, Any]:
    """The table of a TOML text.

    Raises:
        ValueError: it is no TOML, or beyond the limits.
    """
    if len(text) > TOML_BYTES:
        raise ValueError(f"it is larger than {_size(TOML_BYTES)}")
    found = LONG_KEY.search(text)
    if found is not None:
        line = text.count("\n", 0, found.start()) + 1
        raise ValueError(f"a key with more than {MOST_KEY_PARTS} parts (at line {line})")
    table: dict[str, Any] = _within_limits(tomllib.loads, text)
    return table


def json_of(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises:
        ValueError: it is no JSON, or beyond the limits.
    """
    return _within_limits(json.loads, text)


def _within_limits(parse: Callable[[Any], Any], text: str | bytes) -> Any:
    try:
        value = parse(text)
    except RecursionError as error:
        raise ValueError(TOO_DEEP) from error
    check_value(value)
    return value


def xml_of(text: str) -> Xml.Element:
    """The root of an XML text without entities of its own, which could be of any size.

    Raises:
        ValueError: it is no XML, or defines entities.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it defines entities")
    try:
        return Xml.fromstring(text)
    except Xml.ParseError as error:
        raise ValueError(str(error)) from error


def check_value(value: Any) -> None:
    """Check tables, lists and numbers within each other.

    Raises:
        ValueError: they are nested too deeply, or a whole number is larger than any format has.
    """
    level = [value]
    for _ in range(DEEPEST):
        level = [inner for outer in level for inner in _inside(outer)]
        if not level:
            return
    raise ValueError(TOO_DEEP)


def _inside(outer: Any) -> list[Any]:
    """The tables and lists in a value, after its whole numbers were checked."""
    values = outer.values() if isinstance(outer, dict) else outer if isinstance(outer, list) else (outer,)
    for value in values:
        if type(value) is int and value.bit_length() > WHOLE_BITS:
            raise ValueError("a whole number beyond 9e18")
    return [value for value in values if isinstance(value, (dict, list))]
