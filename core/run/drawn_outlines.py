"""The images on which each outline of `tricap contour` was drawn: once these are others, the outline is set aside, and no fit uses it.

run.json has, for each contours/VIEW.csv, a digest of the table and one of the images: by the times of the files, and where it was read, by
their content, so that a copy of a project keeps its outlines. A table without an entry (of an earlier version, or of the user) counts as
drawn on the present images.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from ..foundation import bounded, store
from ..foundation.errors import InputError
from ..take.footage import Footage
from ..tracking.contour import ContourTable
from .file_digests import FileDigests, reads_content
from .stages import Stamp, stamp_for

ENTRY = "outlines"  # of run.json
TABLE, IMAGES, CONTENT = "table", "images", "content"
FOLDER = "contours"

Drawn = dict[str, str]  # digests of a table, of the images by their times, and of their content where it was read


@dataclass(frozen=True, kw_only=True, slots=True)
class DrawnOutlines:
    """The outlines in a folder of results: `current` has the entries of run.json by view, `outdated` the views whose images are others."""

    current: dict[str, Drawn]
    outdated: Sequence[str]


def outlines_in(folder: Path, run: Mapping[str, Any], footage: Footage, digests: FileDigests) -> DrawnOutlines:
    """The outlines in the results `folder` with the run record `run`, compared with the present images of a take.

    Raises:
        InputError: a table or an image cannot be read.
    """
    current, outdated = dict[str, Drawn](), list[str]()
    for view in (v.name for v in footage.take.views):
        path, then = table_of(folder, view), run.get(ENTRY, {}).get(view, {})
        if not path.is_file():
            continue
        table, images = _digest(path), images_of(footage, view)
        if then.get(TABLE) != table:
            current[view] = {TABLE: table, **drawn_on(footage, view, digests)}
        elif then.get(IMAGES) == images:
            current[view] = then
        elif then.get(CONTENT) and then[CONTENT] == drawn_on(footage, view, digests).get(CONTENT):
            current[view] = {**then, IMAGES: images}
        else:
            outdated.append(view)
    return DrawnOutlines(current=current, outdated=outdated)


def drawn_on(footage: Footage, view: str, digests: FileDigests) -> Drawn:
    """The digests of the images of a view, as they are now; of large ones without their content.

    Raises:
        InputError: an image cannot be read.
    """
    content = {CONTENT: images_of(footage, view, digests.stamp)} if reads_content(footage) else {}
    return {IMAGES: images_of(footage, view), **content}


def images_of(footage: Footage, view: str, stamp: Stamp | None = None) -> str:
    """A digest of the images of a view and of what decides which of them, and which of their rows, show a frame.

    Raises:
        InputError: an image cannot be read.
    """
    take = footage.take
    at = [v.name for v in take.views].index(view)
    own = take.views[at]
    files = [*footage.sequences[at].files(), *([take.folder / own.timestamps] if own.timestamps else [])]
    clock = (take.fps, *own.clock) if own.has_clock else ()
    try:
        stamp = stamp or stamp_for(footage)
        stamps = [stamp(path) for path in files]
    except OSError as error:
        raise InputError(f"Cannot read {error.filename}: {error.strerror or error}.") from error
    return store.digest(repr((own.offset_frames, take.interlaced, take.first_field, clock, stamps)))


def entry_of(folder: Path, view: str, images: Drawn) -> Drawn:
    """The entry of run.json for a table that was just written, drawn on these images."""
    return {TABLE: _digest(table_of(folder, view)), **images}


def check_tables(folder: Path, views: Sequence[str]) -> None:
    """Check that the tables of outlines can be read.

    Raises:
        InputError: one is damaged.
    """
    for view in views:
        ContourTable(table_of(folder, view))


def sentence(folder: Path, view: str) -> str:
    """What is wrong with an outdated outline."""
    return f"{table_of(folder, view)} was drawn on other images of view {view} than the take has now"


def set_aside(folder: Path, view: str) -> str:
    """Rename the table of an outdated outline, so that nothing uses it; the sentence that says so.

    Raises:
        InputError: it cannot be renamed.
    """
    path = table_of(folder, view)
    try:
        kept = store.rename_to_free(path, _names(path))
    except OSError as error:
        raise InputError(f"Cannot rename {path}: {error.strerror or error}. Close the program that uses it.") from error
    return f"{sentence(folder, view)}: it is not used, and kept as “{kept.name}”. `tricap contour` draws a new one."


def table_of(folder: Path, view: str) -> Path:
    """contours/VIEW.csv"""
    return folder / FOLDER / f"{view}.csv"


def _digest(path: Path) -> str:
    return store.digest(path, largest=bounded.TABLE_BYTES)


def _names(path: Path) -> Iterator[Path]:
    yield path.with_name(f"{path.name}.bak")
    yield from (path.with_name(f"{path.name}.bak{n}") for n in count(2))
