"""Results on disk: numpy arrays and a JSON header in one .npz, written atomically, read without pickle.

A file appears under its name only when it is complete: it is written under a temporary name and then renamed.
"""

import errno
import hashlib
import io
import json
import math
import os
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from . import bounded
from .errors import InputError

NEW_FILE = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
HEADER = "header_json"
CONTENT = "content"  # of the header: a digest of the arrays, which files of earlier versions lack
STORE_VERSION = 1
LARGEST_UNPACKED = 400_000_000  # bytes to which any file may unpack
LARGEST_RATIO = 100  # times its size, for larger files
DAMAGED = (  # raised by numpy, zipfile and zlib for a damaged file, or for another kind of file
    OSError,
    ValueError,
    KeyError,
    TypeError,
    EOFError,
    MemoryError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file completely or not at all.

    Raises:
        InputError: the folder cannot be written to, or the disk is full.
    """
    with written(path) as file:
        file.write(data)


@contextmanager
def written(path: Path) -> Iterator[BinaryIO]:
    """A file to be written piece by piece; it gets its name when the block ends without an error, and does not exist otherwise.

    Raises:
        InputError: the path has no name of a file, the folder cannot be written to, or the disk is full.
    """
    path = Path(path)
    if not path.name:
        raise InputError(f"“{path}” is no name of a file; choose a name to write.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        name = path.with_name(f".{path.name}.{os.urandom(4).hex()}.part")
        handle = os.open(name, NEW_FILE, 0o666)  # less what the user's umask takes away
        try:
            with os.fdopen(handle, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(name, path)
        except BaseException:
            name.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"Cannot write {path}: {error.strerror or error}. Choose another folder or free some space.") from error


def part_of(path: Path) -> Path:
    """The temporary name, with the same ending, under which another program writes a file. Nobody can place a link there before."""
    return path.with_name(f".{path.stem}.{os.urandom(4).hex()}.part{path.suffix}")


def try_writing(path: Path) -> None:
    """Make the folder of a file that another program will write, and test that it can be written there.

    Raises:
        OSError: it cannot be written, or there is something of that name, also a link.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    os.close(os.open(path, NEW_FILE, 0o666))
    path.unlink()


def rename_to_free(path: Path, names: Iterable[Path]) -> Path:
    """Rename a file to the first of the names in its folder that is free, and never over a file that has it by then; the new path.

    Raises:
        OSError: it cannot be renamed, or no name is free.
    """
    for free in names:
        with suppress(FileExistsError):
            try:
                os.link(path, free)
            except FileExistsError:
                if not os.path.samefile(path, free):  # else a killed process did not come to the end
                    raise
            except OSError:  # a file system without second names
                os.close(os.open(free, NEW_FILE))
                os.replace(path, free)
                return free
            path.unlink()
            return free
    raise FileExistsError(errno.EEXIST, "no name is free", str(path))


def write_text(path: Path, text: str) -> None:
    """`write_bytes` of UTF-8 text. Bytes of a file's name that are no UTF-8 become escapes, which JSON reads back."""
    write_bytes(path, text.encode("utf-8", errors="backslashreplace"))


def write_json(path: Path, value: Any) -> None:
    """`write_bytes` of readable JSON. JSON has no NaN and no infinity: they become null."""
    write_text(path, json.dumps(without_nan(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def without_nan(value: Any) -> Any:
    """The value with null for every number that is not finite."""
    if isinstance(value, Mapping):
        return {name: without_nan(v) for name, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_json(path: Path) -> Any:
    """The value in a JSON file.

    Raises:
        InputError: the file cannot be read or is no JSON.
    """
    try:
        return bounded.json_of(bounded.text_of(path, bounded.JSON_BYTES))
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    except ValueError as error:
        raise InputError(f"{path} is not a JSON file ({error}); mend it, or remove it and run again.") from error


def save(path: Path, arrays: Mapping[str, np.ndarray], header: Mapping[str, Any], *, compress: bool = True) -> None:
    """Arrays and a JSON header into one .npz (no pickle). Checkpoints are not compressed: that takes longer than computing some."""
    own = {"store_version": STORE_VERSION, "arrays": sorted(arrays), CONTENT: _content(arrays)}
    text = json.dumps({**header, **own}, sort_keys=True, allow_nan=False)
    packed, pack = io.BytesIO(), np.savez_compressed if compress else np.savez
    pack(packed, **{HEADER: np.array(text)}, **arrays)  # type: ignore[arg-type]
    with written(path) as file:  # not packed into the file itself: where the disk is full, the archive would try to end itself later
        file.write(packed.getbuffer())


def load(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and header of a file written by `save`.

    Raises:
        InputError: it is missing, damaged, of a newer version, or was not written by Tricap.
    """
    try:
        arrays = load_arrays(path)
        header = bounded.json_of(str(arrays.pop(HEADER)))
    except FileNotFoundError as error:
        raise InputError(f"{path} is missing; run the stage that writes it.") from error
    except DAMAGED as error:
        raise InputError(f"{path} is not a result of Tricap or is damaged; remove it and run again.") from error
    if not isinstance(header, dict) or header.get("store_version") != STORE_VERSION:
        raise InputError(f"{path} was written by another version of Tricap; remove it and run again.")
    if header.pop("arrays", sorted(arrays)) != sorted(arrays):
        raise InputError(f"{path} is damaged: it lacks a part; remove it and run again.")
    if header.get(CONTENT, content := _content(arrays)) != content:
        raise InputError(f"{path} is damaged: it was changed after it was written; remove it and run again.")
    return arrays, header


def _content(arrays: Mapping[str, np.ndarray]) -> str:
    """A digest of arrays: their names, types, shapes and values."""
    parts = [(name, np.asarray(array)) for name, array in sorted(arrays.items())]
    return digest(*(part for name, a in parts for part in (f"{name} {a.dtype.str} {a.shape}", np.ascontiguousarray(a).tobytes())))


def header_of(path: Path) -> dict[str, Any]:
    """The header of a file written by `save`, without its arrays; empty if there is none that can be read."""
    try:
        with bounded.opened(path, bounded.ARRAYS_BYTES) as file, np.load(file, allow_pickle=False) as data:
            header = bounded.json_of(str(data[HEADER]))
    except (*DAMAGED, InputError):
        return {}
    return header if isinstance(header, dict) else {}


def check_layout(path: Path, arrays: Mapping[str, np.ndarray], **layout: tuple[str, str]) -> None:
    """Check that each array exists, with one of the kinds (numpy's letters) and the shape, as in `frames=("iu", "T"), xyz_m=("f", "TN3")`:
    a digit is a length, a letter the same length everywhere.

    Raises:
        InputError: one is missing or of another layout.
    """
    lengths: dict[str, int] = {}
    for name, (kinds, sides) in layout.items():
        array = arrays.get(name)
        if array is None:
            raise InputError(f"{path} has no {name}; run the stage that writes it again.")
        fits = array.dtype.kind in kinds and array.ndim == len(sides)
        for side, length in zip(sides, array.shape):
            fits = fits and length == (int(side) if side.isdecimal() else lengths.setdefault(side, length))
        if not fits:
            raise InputError(f"{path} is damaged: {name} has the shape {array.shape} of {array.dtype}; run the stage that writes it again.")


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz, without pickle.

    Raises:
        InputError: it is a small archive that would unpack to gigabytes.
        One of DAMAGED: it cannot be read.
    """
    with bounded.opened(path, bounded.ARRAYS_BYTES) as file:
        with zipfile.ZipFile(file) as archive:
            unpacked = sum(info.file_size for info in archive.infolist())
        if unpacked > max(LARGEST_UNPACKED, LARGEST_RATIO * os.fstat(file.fileno()).st_size):
            raise InputError(f"{path} would unpack to {unpacked / 1e9:.1f} GB, which no result of its size does; remove it and run again.")
        file.seek(0)
        with np.load(file, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}


def digest(*parts: bytes | str | Path, largest: int = bounded.IMAGE_BYTES) -> str:
    """A short SHA-256 over bytes, texts and the contents of files.

    Raises:
        InputError: a file cannot be read, or is larger than `largest` bytes.
    """
    total = hashlib.sha256()
    for part in parts:
        try:
            for piece in _file(part, largest) if isinstance(part, Path) else _bytes(part.encode() if isinstance(part, str) else part):
                total.update(piece)
        except OSError as error:
            raise InputError(f"Cannot read {part!s}: {error.strerror or error}. Check it and run again.") from error
    return total.hexdigest()[:16]


def _bytes(data: bytes) -> Iterator[bytes]:
    yield len(data).to_bytes(8, "little")
    yield data


def _file(path: Path, largest: int) -> Iterator[bytes]:
    """The size and the content of a file, in pieces."""
    with bounded.opened(path, largest) as file:
        yield os.fstat(file.fileno()).st_size.to_bytes(8, "little")
        while piece := file.read(1 << 20):
            yield piece
