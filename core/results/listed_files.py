"""Files that a command writes into a folder of the user's choice, one for each frame or camera: a list among them says which are ours.

Other files of their kind in that folder are the user's, such as the images of a camera: they are neither replaced nor mixed with ours.
"""

from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from pathlib import Path

from ..foundation import bounded, store
from ..foundation.errors import InputError
from ..images.sequence import IMAGE_ENDINGS
from .folder import check_no_root

LIST = bounded.LISTED_FILES
PICTURES = tuple(f"*{ending}" for ending in IMAGE_ENDINGS)
PLY = ("*.ply",)


def check_files(folder: Path, patterns: Sequence[str]) -> None:
    """Check that a folder, if there is one, has no files of some kinds but those that an earlier call wrote.

    Raises:
        InputError: it has, or it is the root of a drive.
    """
    check_no_root(folder)
    ours = _listed(folder)
    for name in sorted(path.name for path in folder.iterdir()) if folder.is_dir() else ():
        if name not in ours and _is_of(name, patterns):
            raise InputError(f"{folder} contains “{name}”, which was not written there by Tricap; choose an empty or a new folder.")


def list_files(folder: Path, patterns: Sequence[str], names: Iterable[str]) -> None:
    """Note the names of the files that are written into a folder, and remove those of an earlier call that are not among them.

    Raises:
        InputError: the folder cannot be written to.
    """
    new = sorted(names)
    for name in _listed(folder) - {*new}:
        path = folder / name
        try:
            if _is_of(name, patterns) and (path.is_symlink() or path.is_file()):
                path.unlink()
        except OSError as error:
            raise InputError(f"Cannot remove {path}: {error.strerror or error}. Choose another folder.") from error
    store.write_json(folder / LIST, new)


def _is_of(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(name.lower(), pattern.lower()) for pattern in patterns)


def _listed(folder: Path) -> set[str]:
    """The names in the list of a folder; none without a list."""
    try:
        names = bounded.json_of(bounded.bytes_of(folder / LIST, bounded.JSON_BYTES))
    except (OSError, ValueError):
        return set()
    return {name for name in names if isinstance(name, str) and bounded.fits_file_names(name)} if isinstance(names, list) else set()
