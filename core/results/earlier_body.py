"""OUT/earlier_body: the finished body that a new fit is to replace, as a folder of results of its own. A fit that is stopped, or that asks
for a click, thus takes nothing away; the next finished body that is replaced takes its place.

Its run.json comes first and body.toml last, so that a killed run is continued, and nothing that is incomplete looks complete. A folder of
this name with anything else than a run moved there, such as edits, gets another name.
"""

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..foundation import store
from ..foundation.errors import InputError
from . import edited_tables
from .blend_file import DIGESTS, edited_names
from .films import ENTRY as FILM_DIGESTS
from .folder import EARLIER, lost
from .own_files import MADE_IN, files_of, remove_own
from .run_json import ASKS, UNTIL

STAGES = ("fit", "report")
NOT_ITS_OWN = (DIGESTS, FILM_DIGESTS, ASKS)  # of run.json
RUN = "run.json"
NAMES = ("report", "frames.csv", "joints.csv", "motion.csv", "skin", "body.toml")


def keep(folder: Path, run: Mapping[str, Any], key: str) -> list[str]:
    """Move the body of this run.json to earlier_body in the results `folder`; the sentences that say so. Nothing is moved without a whole
    body, or where the new one has the same input (`key`, of the fit), and will be the same.

    Raises:
        InputError: a file cannot be moved.
    """
    stages = {name: dict(entry) for name, entry in run.get("stages", {}).items() if name in STAGES}
    if "fit" not in stages or "not_done" in stages["fit"]:
        return []
    place, own_key = folder / EARLIER, stages["fit"].get("key")
    begun, sentences = _begun(place, own_key), list[str]()  # by a run that was killed
    try:
        if own_key == key:
            if begun:
                _remove(place)
            return []
        if not begun:
            if "fit" in lost(folder, run):
                return []
            sentences = _make_room(place)
            place.mkdir()
            store.write_json(place / RUN, _record(folder, run, stages))
        for name in NAMES:
            _move(folder / name, place / name)
    except OSError as error:
        reason = f"Cannot move {error.filename}: {error.strerror or error}. Close the program that uses it, or choose another folder."
        raise InputError(reason) from error
    scene = f"`tricap scene {shlex.quote(str(place))} --blend FILE.blend` makes its Blender file."
    return [*sentences, f"The body that was fitted before is kept in {place}, until the next finished one is replaced; {scene}"]


def _record(folder: Path, run: Mapping[str, Any], stages: dict[str, Any]) -> dict[str, Any]:
    """The run.json of an earlier body, from that of the results in `folder`; its tables count as unedited as they are now."""
    stages["fit"][edited_tables.ENTRY] = edited_tables.digests(folder)
    files = {name: size for name, size in run.get("files", {}).items() if name in NAMES}
    return {name: value for name, value in run.items() if name not in NOT_ITS_OWN} | {UNTIL: "fit", "stages": stages, "files": files}


def _begun(place: Path, key: Any) -> bool:
    """Whether a run was killed while it moved the body with this key of the fit here."""
    try:
        record = {} if place.is_symlink() else store.read_json(place / RUN)
        return bool(record["stages"]["fit"]["key"] == key) and not (place / NAMES[-1]).exists() and not _foreign(place)
    except (InputError, KeyError, TypeError):
        return False


def _make_room(place: Path) -> list[str]:
    """Remove an earlier body as a run moved it here; anything else of its name gets another one, and a sentence says so."""
    if not os.path.lexists(place):
        return []
    if place.is_dir() and not place.is_symlink() and not _foreign(place) and _as_moved(place):
        _remove(place)
        return []
    other = next(path for path in edited_names(place) if not os.path.lexists(path))
    place.rename(other)
    return [f"{place} has files that no run moved there, or edits, and is kept as “{other.name}”."]


def _foreign(place: Path) -> bool:
    """Whether a folder has anything else than the files of an earlier body."""
    own = {place / name for name in (RUN, *NAMES)} | {path for name in NAMES if name in MADE_IN for path in files_of(place / name, name)}
    there = [path for name in ("", *MADE_IN) if (place / name).is_dir() for path in (place / name).iterdir()]
    return any(path.is_symlink() or path not in own or path.is_dir() != (path.name in MADE_IN) for path in there)


def _as_moved(place: Path) -> bool:
    try:
        return not edited_tables.edited(place, store.read_json(place / RUN)["stages"])
    except (InputError, KeyError, TypeError, AttributeError):
        return False


def _remove(place: Path) -> None:
    """Remove an earlier body, its run.json last."""
    for name in (*NAMES, RUN):
        if name in MADE_IN:
            remove_own(place / name, name)
        else:
            (place / name).unlink(missing_ok=True)
    place.rmdir()


def _move(path: Path, to: Path) -> None:
    """Move a file, or our files of a folder; what is not there was moved before."""
    if path.name not in MADE_IN:
        if path.is_symlink() or path.is_file():
            os.replace(path, to)
        return
    for own in [*files_of(path, path.name)]:
        to.mkdir(exist_ok=True)
        os.replace(own, to / own.name)
