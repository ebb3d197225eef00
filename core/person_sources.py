"""What take.toml says of where a view shows the person: a mask, a mask for every image, or an image of the empty background."""

import glob
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .images.sequence import read_image
from .toml_values import inside

PERSON_SOURCES = ("mask", "masks", "background")  # keys of [[views]]; a view has one of them at most


def person_source(entry: Mapping[str, Any], label: str) -> dict[str, str]:
    """The key and the file, or the pattern of files, of a view's table.

    Raises:
        InputError: there are several, or one is no file inside the take.
    """
    said = {key: entry[key] for key in PERSON_SOURCES if key in entry}
    if len(said) > 1:
        raise InputError(f"The {label} has {' and '.join(f'`{key}`' for key in said)}; keep one of them.")
    for key, name in said.items():
        inside(Path(), name, label, key)
    return said


def read_picture(path: Path, view: str, size_px: tuple[int, int]) -> np.ndarray:
    """A mask or a background (h, w) of a view.

    Raises:
        InputError: it cannot be read, or is of another size than the view.
    """
    image = read_image(path)
    if image.shape[::-1] != size_px:
        size = f"{image.shape[1]}×{image.shape[0]} pixels, the view {size_px[0]}×{size_px[1]}"
        raise InputError(f"{path} of view {view} has {size}; make it of the view's own size.")
    return image


def person_files(folder: Path, view: str, kind: str, picture: Path) -> tuple[str, tuple[Path, Path]]:
    """What [[views]] says of a mask or background, or of the masks beside which `picture` lies, and the link into the take's folder.

    What is there under the same name and is something else stays; the link gets a number.
    """
    source, ending = (picture.parent, "") if kind == "masks" else (picture, picture.suffix)
    for number in count(1):
        target = Path(folder) / f"{view}_{kind}{f'_{number}' if number > 1 else ''}{ending}"
        if not target.exists() or target.samefile(source):
            break
    return f"{glob.escape(target.name)}/*{picture.suffix}" if kind == "masks" else target.name, (target, source)
