"""OUT/body.blend, which people edit and save: Tricap replaces and removes it only as long as it is byte for byte what Tricap wrote.

run.json has the digest of what was written. A file that differs from it, or for which there is no digest (earlier versions wrote none),
may have edits: it gets another name. The digest is noted before the file gets its name, and the one before it stays, so that a killed run
leaves no file of its own that looks edited.
"""

from collections.abc import Iterator, Mapping
from contextlib import nullcontext, suppress
from itertools import count
from pathlib import Path
from typing import Any

from ..foundation import bounded, lock, store
from ..foundation.errors import InputError
from .run_json import read_run

BLEND = "body.blend"
PLAIN, ZSTANDARD = b"BLENDER", b"\x28\xb5\x2f\xfd"  # first bytes of a file, not compressed and compressed
LAST_BLOCK, TABLE_END, TAIL_BYTES = b"ENDB", b"\xb1\xea\x92\x8f", 64  # and what is in the last ones
DIGESTS = "blend"  # entry of run.json: of the file as Tricap wrote it, and of the one that it replaced


def keep_edited(folder: Path) -> str:
    """Rename body.blend in the results `folder` if it may have edits; the sentence that says so, else "". A link is no file of its own.

    Raises:
        InputError: it cannot be renamed.
    """
    path = folder / BLEND
    if path.is_symlink() or not path.is_file() or _as_written(path):
        return ""
    try:
        kept = store.rename_to_free(path, edited_names(path))
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"Cannot rename {path}: {reason}. Close the program that uses it, or choose another folder.") from error
    return f"{path} may have edits of yours and is kept as “{kept.name}”."


def note_written(folder: Path, file: Path) -> None:
    """Note in run.json that a file, which is or will be body.blend, is ours. A run does this in its own folder; while another run has it,
    nothing is noted, and the file later counts as edited."""
    with suppress(InputError), nullcontext() if lock.is_ours(folder) else lock.locked(folder):
        run, new = read_run(folder / "run.json"), _digest(file)
        if new not in (before := _noted(run)):
            store.write_json(folder / "run.json", {**run, DIGESTS: [*before[-1:], new]})


def lacking(folder: Path, run: Mapping[str, Any]) -> str:
    """What is wrong with body.blend in the results `folder`, as the end of a sentence; "" if it is whole, or was never written."""
    path = folder / BLEND
    if not path.exists():
        return "is missing" if _noted(run) else ""
    return "" if is_whole(path) else "is cut, or no Blender file"


def is_whole(path: Path) -> bool:
    """Whether a Blender file has its end: the last block, or the table of a compressed file's parts. An unreadable one has none."""
    try:
        with bounded.opened(path, bounded.ARRAYS_BYTES) as file:
            first = file.read(len(PLAIN))
            file.seek(max(0, path.stat().st_size - TAIL_BYTES))
            tail = file.read()
    except OSError:
        return False
    return tail.endswith(TABLE_END) if first.startswith(ZSTANDARD) else first == PLAIN and LAST_BLOCK in tail


def _noted(run: Mapping[str, Any]) -> list[str]:
    return list(run.get(DIGESTS, []))


def _as_written(path: Path) -> bool:
    try:
        return _digest(path) in _noted(read_run(path.with_name("run.json")))
    except InputError:  # nobody knows what was written, or the file cannot be read
        return False


def _digest(path: Path) -> str:
    return store.digest(path, largest=bounded.ARRAYS_BYTES)


def edited_names(path: Path) -> Iterator[Path]:
    """Names for a file of which there is a new version and that was edited, the first choice first."""
    yield path.with_stem(f"{path.stem} (edited)")
    yield from (path.with_stem(f"{path.stem} (edited {n})") for n in count(2))
