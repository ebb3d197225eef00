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
        kept = store.rename_to_free(path, _names(path))
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


def _noted(run: Mapping[str, Any]) -> list[str]:
    return list(run.get(DIGESTS, []))


def _as_written(path: Path) -> bool:
    try:
        return _digest(path) in _noted(read_run(path.with_name("run.json")))
    except InputError:  # nobody knows what was written, or the file cannot be read
        return False


def _digest(path: Path) -> str:
    return store.digest(path, largest=bounded.ARRAYS_BYTES)


def _names(path: Path) -> Iterator[Path]:
    yield path.with_name(f"{path.stem} (edited).blend")
    yield from (path.with_name(f"{path.stem} (edited {n}).blend") for n in count(2))
