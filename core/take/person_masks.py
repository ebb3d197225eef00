"""The silhouette of the person in the views, from the take's masks (white person), or from an image of the empty background.

A measured point must lie inside the silhouette of every view that has one and whose image contains it. In a frame in which a view differs
from its background everywhere (black, other light) it has no silhouette.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from ..foundation.errors import InputError
from ..images.background import OTHER_ROOM, WINDOW_PX, empty_view
from ..images.sequence import open_sequence
from ..matching.foreground import Silhouette
from .footage import Footage
from .sources import PERSON_SOURCES, read_picture

WHITE = 127.0  # grey values; brighter pixels of a mask are the person
PATTERN_PX, PATTERN = 3, 0.05  # so much of a mask is white, and nowhere in a square of that side: a pattern, or noise of a film's coding
HOLE_PX = 15  # px, side of the largest hole that is closed in a silhouette, where the person has the background's grey value


def silhouettes(footage: Footage, grey: Sequence[np.ndarray], frame: int, *, first: bool) -> tuple[Silhouette, ...]:
    """The silhouettes of the views that have masks or backgrounds; `grey` are the rows (h', w) of all views in that frame.

    Raises:
        InputError: a file is missing, damaged, or of another size than its view; in the `first` frame also where a background's image shows
            another room.
    """
    rows = footage.take.rows_at(frame)
    found = []
    for k, (view, camera, image) in enumerate(zip(footage.take.views, footage.rig.cameras, grey)):
        path = silhouette_file(footage, k, frame)
        if path is None:
            continue
        picture = rows.rows(footage.reduced_image(k, read_picture(path, view.name, footage.sizes_px[k])))
        if view.background is not None:
            mask = _unlike(picture, image, rows.step)
        else:
            check_mask(picture, path, of_all=view.masks is None)
            mask = picture > WHITE
        if mask is not None:
            found.append(Silhouette(camera=camera, rows=rows, mask=mask))
        elif first:
            raise InputError(
                f"The background image {path} looks nothing like view {view.name} in frame {frame}. Take it with the same camera and light."
            )
    return tuple(found)


def check_mask(picture: np.ndarray, path: Path, *, of_all: bool) -> None:
    """Refuse a mask (h, w) with a person who is not white. `of_all`: it is for all images, so that somebody is in it.

    Raises:
        InputError: it is neither black nor white anywhere, black everywhere for all images, or a pattern of single pixels.
    """
    if of_all and not picture.any():
        raise InputError(f"The mask {path} is black everywhere; paint white wherever the person comes, or remove `mask` from take.toml.")
    if 0 < picture.max() <= WHITE:
        raise InputError(f"The mask {path} is nowhere brighter than {picture.max():.0f} of 255; paint the person white.")
    white = (picture > WHITE).astype(np.uint8)
    if white.mean() > PATTERN and not cv2.erode(white, np.ones((PATTERN_PX, PATTERN_PX), np.uint8)).any():
        raise InputError(f"The mask {path} is a pattern of single white pixels, in which nothing can be matched; paint the person white.")


def silhouette_file(footage: Footage, view: int, frame: int) -> Path | None:
    """The mask or background image of a view for a frame, if it has one.

    Raises:
        InputError: there are no masks, or too few.
    """
    return next(iter(silhouette_files(footage, view, [frame])), None)


def silhouette_files(footage: Footage, view: int, frames: Iterable[int]) -> list[Path]:
    """The masks of a view for frames, or its one mask or background image; empty if it has none.

    Raises:
        InputError: there are no masks, too few, or they are the footage itself.
    """
    given, folder = footage.take.views[view], footage.take.folder
    if given.masks is None:
        name = given.mask or given.background
        _check_not_footage(footage, view, [folder / given.mask] if given.mask else [])
        return [] if name is None else [folder / name]
    files, found = open_sequence(folder, images=given.masks, movie=None, view=f"{given.name} (masks)").files(), dict[Path, None]()
    _check_not_footage(footage, view, files)
    for frame in frames:
        number = footage.number(view, frame)
        if not 0 <= number < len(files):
            raise InputError(f"View {given.name} has {len(files)} masks, but none for frame {frame}. There must be one for every image.")
        found[files[number]] = None
    return list(found)


def _check_not_footage(footage: Footage, view: int, masks: Sequence[Path]) -> None:
    if same := {*masks}.intersection(footage.sequences[view].files()):
        name = footage.take.views[view].name
        raise InputError(f"{min(same)} is an image of view {name}, and no mask; correct `mask` or `masks` of the view in take.toml.")


def silhouette_sources(footage: Footage) -> str:
    """Where the silhouettes come from, such as “mask of C”; "" where the user gave none."""
    views = footage.take.views
    return " and ".join(
        f"{key} of {', '.join(names)}" for key in PERSON_SOURCES if (names := [v.name for v in views if getattr(v, key) is not None])
    )


def _unlike(background: np.ndarray, image: np.ndarray, row_step: int) -> np.ndarray | None:
    """Where an image differs from the background, without specks and holes; None where it does everywhere."""
    empty = empty_view(background, image)
    if empty.noise > OTHER_ROOM:
        return None
    mask = (~empty.shown_by(image)).astype(np.uint8)
    speck, hole = (cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (n, max(3, n // row_step | 1))) for n in (WINDOW_PX, HOLE_PX))
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, speck)
    return np.asarray(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, hole, borderType=cv2.BORDER_REPLICATE) > 0)
