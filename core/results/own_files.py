"""The files that a run makes in the folders of its results: these alone are counted and removed. Whatever else lies there is the user's."""

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ..foundation import bounded

NUMBERED = r"\d{4,}\.ply"  # a file for each frame
QUESTION = "question.png"  # in the report's folder: the poses between which a click decides
PICTURES = r"(surface|cloud|tracks|body|outlines|patches|trails|vectors)_.+\.png|(layers|question)\.png"
CACHE = "cache"
MADE_IN = {  # names of files by folder
    "clouds": NUMBERED,
    "tracked": NUMBERED,
    "skin": rf"{NUMBERED}|rest\.npz|texture(_mask)?\.png",
    "outlines": r".+\.csv",
    "report": rf"report\.(html|json)|figures\.csv|{PICTURES}",
    CACHE: r".+\.npz|\..+\.part|film\.mp4|scene\.mp4",
}
OUTLINE_START = b"frame,vertex,"  # of a table of outlines; another table there is the user's


def files_of(folder: Path, kind: str) -> Iterator[Path]:
    """The files of ours in a folder of results of this kind (a key of MADE_IN), or links in their places; none without a folder."""
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if re.fullmatch(MADE_IN[kind], path.name) and (path.is_symlink() or path.is_file()):
            if kind != "outlines" or path.is_symlink() or _begins(path):
                yield path


def remove_own(folder: Path, kind: str) -> None:
    """Remove our files from a folder, and the folder if nothing else is in it. Folders in it stay, but those of the checkpoints.

    Raises:
        OSError: a file cannot be removed.
    """
    for path in files_of(folder, kind):
        path.unlink()
    if folder.name == CACHE and folder.is_dir():
        for inner in [path for path in folder.iterdir() if path.is_dir() and not path.is_symlink()]:
            remove_own(inner, kind)
    with suppress(OSError):  # somebody else's files are in it
        folder.rmdir()


def _begins(path: Path) -> bool:
    try:
        with bounded.opened(path, bounded.TABLE_BYTES) as file:
            return file.read(len(OUTLINE_START)) == OUTLINE_START
    except OSError:
        return False
