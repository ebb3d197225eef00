"""What people edit of a fit's results besides body.blend: the fit replaces it only as long as it is byte for byte what the fit wrote.

run.json has the digests in the entry of the fit. A file that differs from its own is copied to another name, and a sentence says so;
without a digest (earlier versions wrote none, and a killed fit has none yet) it is replaced.
"""

import os
from collections.abc import Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any

from ..foundation import bounded, store
from ..foundation.errors import InputError
from .blend_file import edited_names

EDITABLE = ("motion.csv", "joints.csv", "body.toml", "skin/texture.png")
ENTRY = "written"  # of the fit in run.json: the digests by the names of the files


def digests(folder: Path) -> dict[str, str]:
    """Those of the editable files in a folder of results, as they are."""
    return {name: _digest(folder / name) for name in EDITABLE if (folder / name).is_file()}


def edited(folder: Path, stages: Mapping[str, Any]) -> list[str]:
    """The editable files that are not as the fit among the `stages` of run.json wrote them."""
    noted = stages.get("fit", {}).get(ENTRY)
    now = digests(folder) if isinstance(noted, Mapping) else {}
    return [name for name in now if noted.get(name, now[name]) != now[name]]


def keep(folder: Path, stages: Mapping[str, Any]) -> list[str]:
    """Copy edited files to other names; a sentence for each.

    Raises:
        InputError: one cannot be copied.
    """
    sentences = []
    for name in edited(folder, stages):
        path = folder / name
        try:
            kept = _copied_before(path)
            if kept is None:
                store.write_bytes(part := path.with_name(f".{path.name}.part"), bounded.bytes_of(path, bounded.ARRAYS_BYTES))
                kept = store.rename_to_free(part, edited_names(path))
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"Cannot copy {path}: {reason}. Free some space, or choose another folder.") from error
        sentences.append(f"{path} was changed since the fit wrote it, and is kept as “{kept.name}”.")
    return sentences


def _copied_before(path: Path) -> Path | None:
    """The copy of a file as it is, if a run that was killed has made one."""
    copies = takewhile(os.path.lexists, edited_names(path))
    return next((copy for copy in copies if copy.is_file() and _digest(copy) == _digest(path)), None)


def _digest(path: Path) -> str:
    return store.digest(path, largest=bounded.ARRAYS_BYTES)
