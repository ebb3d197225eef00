"""The content of footage files as digests: a copy with new times of modification is recognised, another export of the same size is not.

Movies, which may have gigabytes, count by their size and by their first and last MiB: there, or close by, every container has its index
with the sizes of all pictures. Images beyond `MOST_READ` are not read: of such a take, a copy is another one.
"""

import hashlib
from pathlib import Path

from ..foundation import bounded
from ..images.sequence import MOVIE_ENDINGS
from ..take.footage import Footage

END_BYTES = 1 << 20  # of a movie, at its beginning and at its end
MOST_READ = 500_000_000  # bytes of images, which takes about a second


class FileDigests:
    """Digests by file; each is read once, as long as its size and its time of modification stay."""

    def __init__(self) -> None:
        self._of: dict[tuple[str, int, int], str] = {}

    def stamp(self, path: Path) -> tuple[str, int, str]:
        """Name, size, and digest of the content.

        Raises:
            OSError: it cannot be read.
        """
        state = path.stat()
        key = str(path), state.st_size, state.st_mtime_ns
        if key not in self._of:
            self._of[key] = _digest(path, state.st_size)
        return path.name, state.st_size, self._of[key]


def reads_content(footage: Footage) -> bool:
    """Whether the content of a take's images is read: not where they are too large."""
    return sum(path.stat().st_size for sequence in footage.sequences for path in sequence.files() if not is_movie(path)) <= MOST_READ


def is_movie(path: Path) -> bool:
    """Whether only the ends of a file are read."""
    return path.suffix.lower() in MOVIE_ENDINGS


def _digest(path: Path, size: int) -> str:
    content, movie = hashlib.blake2b(digest_size=16), is_movie(path)
    with bounded.opened(path, bounded.MOVIE_BYTES if movie else bounded.TABLE_BYTES) as file:
        if movie and size > 2 * END_BYTES:
            content.update(file.read(END_BYTES))
            file.seek(size - END_BYTES)
        while piece := file.read(END_BYTES):
            content.update(piece)
    return content.hexdigest()
