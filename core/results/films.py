"""OUT/film.mp4 and OUT/scene.mp4: a film is removed and replaced only as long as run.json has its digest; another one may be the user's."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ..foundation import bounded, store
from ..foundation.errors import InputError
from .run_json import read_run

FILM, SCENE_FILM = "film.mp4", "scene.mp4"
FILMS = (FILM, SCENE_FILM)
ENTRY = "films"  # of run.json: the digest of each as it was written


def place(part: Path, folder: Path, name: str) -> Path:
    """Give a finished film its name in the results `folder`, after run.json has its digest, so that a killed run leaves none that looks
    like the user's; the path.

    Raises:
        InputError: run.json is damaged, or the folder cannot be written to.
    """
    if (record := folder / "run.json").exists():
        run = read_run(record)
        store.write_json(record, {**run, ENTRY: {**run.get(ENTRY, {}), name: _digest(part)}})
    try:
        os.replace(part, folder / name)
    except OSError as error:
        raise InputError(f"Cannot write {folder / name}: {error.strerror or error}. Choose another folder or free some space.") from error
    return folder / name


def check_ours(folder: Path, run: dict[str, Any], names: Iterable[str] = FILMS) -> None:
    """Check that the films in a folder, if there are any, are those that its run wrote.

    Raises:
        InputError: one may be the user's.
    """
    for path in (folder / name for name in names):
        there = path.is_symlink() or path.exists()
        if there and not (path.is_file() and run.get(ENTRY, {}).get(path.name) == _digest(path)):
            raise InputError(f"{path} is not as a run wrote it, and would be replaced; rename it, or choose another folder.")


def _digest(path: Path) -> str:
    return store.digest(path, largest=bounded.MOVIE_BYTES)
