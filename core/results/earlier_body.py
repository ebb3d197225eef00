"""OUT/earlier_body: the finished body that a new fit is to replace, as a folder of results of its own. A fit that is stopped, or that asks
for a click, thus takes nothing away; the next finished body that is replaced takes its place.

Its run.json comes first and body.toml last, so that a killed run is continued, and nothing that is incomplete looks complete.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..foundation import store
from ..foundation.errors import InputError
from .blend_file import DIGESTS
from .films import ENTRY as FILM_DIGESTS
from .folder import EARLIER, lost
from .own_files import MADE_IN, files_of, remove_own
from .run_json import ASKS, UNTIL

STAGES = ("fit", "report")
NOT_ITS_OWN = (DIGESTS, FILM_DIGESTS, ASKS)  # of run.json
NAMES = ("report", "frames.csv", "joints.csv", "motion.csv", "skin", "body.toml")


def keep(folder: Path, run: Mapping[str, Any], key: str) -> list[str]:
    """Move the body of this run.json to earlier_body in the results `folder`; the sentence that says so. Nothing is moved without a whole
    body, or where the new one has the same input (`key`, of the fit), and will be the same.

    Raises:
        InputError: a file cannot be moved.
    """
    stages = {name: entry for name, entry in run.get("stages", {}).items() if name in STAGES}
    if "fit" not in stages or "not_done" in stages["fit"] or stages["fit"].get("key") == key:
        return []
    place, record = folder / EARLIER, {name: value for name, value in run.items() if name not in NOT_ITS_OWN}
    files = {name: size for name, size in run.get("files", {}).items() if name in NAMES}
    record |= {UNTIL: "fit", "stages": stages, "files": files}
    begun = _is_begun(place, record)  # by a run that was killed
    if not begun and "fit" in lost(folder, run):
        return []
    try:
        if not begun:
            _remove(place)
            place.mkdir(exist_ok=True)
            store.write_json(place / "run.json", record)
        for name in NAMES:
            _move(folder / name, place / name)
    except OSError as error:
        reason = f"Cannot move {error.filename}: {error.strerror or error}. Close the program that uses it, or choose another folder."
        raise InputError(reason) from error
    return [f"The body that was fitted before is kept in {place}, until the next finished one is replaced."]


def _is_begun(place: Path, record: Mapping[str, Any]) -> bool:
    try:
        return bool(store.read_json(place / "run.json") == record)
    except InputError:
        return False


def _remove(place: Path) -> None:
    """Remove our files from an earlier body's folder, run.json last."""
    for name in (*NAMES, "run.json"):
        if name in MADE_IN:
            remove_own(place / name, name)
        elif (path := place / name).is_symlink() or path.is_file():
            path.unlink()


def _move(path: Path, to: Path) -> None:
    """Move a file, or our files of a folder; what is not there was moved before."""
    if path.name not in MADE_IN:
        if path.is_symlink() or path.is_file():
            os.replace(path, to)
        return
    for own in [*files_of(path, path.name)]:
        to.mkdir(exist_ok=True)
        os.replace(own, to / own.name)
