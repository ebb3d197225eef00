"""Values of take.toml, checked as they are read; every refusal is an InputError in one sentence.

Person sources of a view: a mask, a mask for every image, or an image of the empty background. [[keypoints]]: files with the joints from
another system, in the pixels of a view or in space.
"""

import glob
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from ..foundation import bounded
from ..foundation.errors import InputError, shown
from ..foundation.settings import nearest_name
from ..images.picture import header_size, read_image


def frame_pair(value: Any, where: str) -> tuple[int, int] | None:
    """`frames`, half-open, or None without it."""
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 2 or not all(type(v) is int for v in value) or not 0 <= value[0] < value[1]:
        raise InputError(f"`frames` of {where} is {shown(value)}; write [first, one after the last].")
    return value[0], value[1]


def inside(folder: Path, name: Any, where: str, key: str = "rig") -> Path:
    """The path of a file that must lie in the take's folder."""
    if not isinstance(name, str) or "\0" in name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise InputError(f"`{key}` of {where} is {shown(name)}; it must be a file inside the take's folder. Copy it there.")
    return folder / name


def table_of(table: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    """A table of a table, empty if it is missing."""
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"[{key}] of {where} must be a table.")
    return value


def tables_of(table: Mapping[str, Any], key: str, where: str) -> list[Mapping[str, Any]]:
    """A list of tables, empty if it is missing."""
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise InputError(f"`{key}` of {where} must be written as [[{key}]] tables.")
    return value


def check_keys(table: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
    """Refuse unknown keys."""
    for key in table:
        if key not in known:
            raise InputError(f"{where} has an unknown key “{key}”.{nearest_name(str(key), known)}")


def is_pixel(value: Any) -> bool:
    """Whether it is [x, y], not farther from any image than arithmetic can bear."""
    return isinstance(value, list) and len(value) == 2 and all(is_number(v) and abs(v) <= LARGEST_PX for v in value)


def is_number(value: Any) -> TypeGuard[float]:
    """Whether it is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


ANY_DEPTH = "**"  # in a pattern: folders within each other. Several of it take pathlib of Python 3.11 a time that grows exponentially
PERSON_SOURCES = ("mask", "masks", "background")  # keys of [[views]]; a view has at most one of them


def check_pattern(pattern: Any, label: str) -> None:
    """Check a pattern of files.

    Raises:
        InputError: it looks into folders of any depth more than once, or is too long.
    """
    if isinstance(pattern, str) and len(pattern) > bounded.LONGEST_PATTERN:
        raise InputError(f"The {label} has a pattern of {len(pattern)} characters; {bounded.LONGEST_PATTERN} is the most.")
    if isinstance(pattern, str) and pattern.count(ANY_DEPTH) > 1:
        raise InputError(f"The {label} has a pattern with more than one “{ANY_DEPTH}”; name the folder, as in “C/*.png”.")


def person_source(entry: Mapping[str, Any], label: str) -> dict[str, str]:
    """The key and the file, or the pattern of files, of a view's table.

    Raises:
        InputError: there are several, or one is not inside the take.
    """
    sources = {key: entry[key] for key in PERSON_SOURCES if key in entry}
    if len(sources) > 1:
        raise InputError(f"The {label} has {' and '.join(f'`{key}`' for key in sources)}; keep one of them.")
    for key, name in sources.items():
        inside(Path(), name, label, key)
        check_pattern(name, label)
    return sources


def read_picture(path: Path, view: str, size_px: tuple[int, int]) -> np.ndarray:
    """A mask or a background (h, w) of a view.

    Raises:
        InputError: it cannot be read, or is of another size than the view.
    """
    size = header_size(path)
    if size is None or size == size_px:
        image = read_image(path)
        size = image.shape[1], image.shape[0]
    if size != size_px:
        sizes = f"{size[0]}×{size[1]} pixels, the view {size_px[0]}×{size_px[1]}"
        raise InputError(f"{path} of view {view} has {sizes}; make it the size of the view.")
    return image


def person_files(folder: Path, view: str, kind: str, picture: Path) -> tuple[str, tuple[Path, Path]]:
    """The value in [[views]] for a mask or background, or for the folder of masks with `picture`, and the link into the take's folder.

    Another file of the same name stays, and the link gets a number.
    """
    source, ending = (picture.parent, "") if kind == "masks" else (picture, picture.suffix)
    for number in count(1):
        target = Path(folder) / f"{view}_{kind}{f'_{number}' if number > 1 else ''}{ending}"
        if not target.exists() or target.samefile(source):
            break
    return f"{glob.escape(target.name)}/*{picture.suffix}" if kind == "masks" else target.name, (target, source)


LARGEST_PX = 1e6  # of a click
MOST_TABLES = 200  # of keypoints: as many as views
LEAST_SIGMA, LARGEST_SIGMA = 1e-4, 1e4  # px, or m in space: beyond, the weights leave the range of numbers
KEYS = ("files", "view", "offset_frames", "sigma", "names", "axes")
PIXELS = (".json",)  # files of keypoints in pixels
SPACE = (".trc", ".c3d", ".csv")  # files of keypoints in space
SIGMA_PX = 8.0
SIGMA_M = 0.02


@dataclass(frozen=True, kw_only=True, slots=True)
class KeypointSource:
    """A file, or a pattern of files in natural order, inside the take's folder."""

    files: str
    view: str = ""  # of keypoints in pixels
    offset_frames: int = 0  # take frame t is frame t + offset_frames of the file (plus the offset of the view)
    sigma: float = SIGMA_PX  # px, or m in space
    names: Mapping[str, str] = field(default_factory=dict)  # the file's name -> our joint
    axes: str | None = None  # of a file in space; None: the usual axes of its format


def keypoint_sources(
    tables: Sequence[Mapping[str, Any]], views: Sequence[str], joints: Sequence[str], where: str
) -> tuple[KeypointSource, ...]:
    """The keypoint sources of a take.toml.

    Raises:
        InputError: a key, view or joint is unknown, a value is impossible, or there are very many tables, or two of the same files.
    """
    if len(tables) > MOST_TABLES:
        raise InputError(f"{where} has {len(tables)} tables [[keypoints]]; {MOST_TABLES} is the most. One pattern can name many files.")
    found = tuple(_source(table, views, joints, f"[[keypoints]] of {where}") for table in tables)
    named = [(source.files, source.view) for source in found]
    if twice := next((one for n, one in enumerate(named) if one in named[:n]), None):
        raise InputError(f"Two tables [[keypoints]] of {where} name the files “{twice[0]}” for the same view; remove one of them.")
    return found


def _source(table: Mapping[str, Any], views: Sequence[str], joints: Sequence[str], where: str) -> KeypointSource:
    for key in table:
        if key not in KEYS:
            raise InputError(f"A {where} has an unknown key “{key}”.{nearest_name(key, KEYS)}")
    files, view, names = table.get("files"), table.get("view", ""), table.get("names", {})
    if not isinstance(files, str) or Path(files).is_absolute() or ".." in Path(files).parts:
        raise InputError(f'`files` of a {where} is {shown(files)}; it must be files inside the take\'s folder, such as "kp/C/*.json".')
    check_pattern(files, where)
    kind = Path(files).suffix.lower()
    if kind not in PIXELS + SPACE:
        raise InputError(f"`files` of a {where} is {shown(files)}; keypoints are read from {', '.join(PIXELS + SPACE)}.")
    if (kind in PIXELS) != bool(view) or (view and view not in views):
        need = f"must name its view.{nearest_name(str(view), tuple(views))}" if kind in PIXELS else "is in space and has no view."
        raise InputError(f"The {where} with “{files}” {need}")
    if not isinstance(names, dict):
        raise InputError(f'`names` of a {where} must be a table, such as {{ RKnee = "knee.R" }}.')
    for joint in names.values():
        if joint not in joints:
            raise InputError(f"A {where} has an unknown joint {shown(joint)}.{nearest_name(str(joint), tuple(joints))}")
    offset, sigma, axes = table.get("offset_frames", 0), table.get("sigma", SIGMA_PX if view else SIGMA_M), table.get("axes")
    fits = isinstance(sigma, (int, float)) and LEAST_SIGMA <= sigma <= LARGEST_SIGMA
    if not isinstance(offset, int) or not fits or not isinstance(axes, str | None):
        needs = f"a whole `offset_frames`, a positive `sigma` ({LEAST_SIGMA:g} to {LARGEST_SIGMA:g}) and a name as `axes`"
        raise InputError(f"The {where} with “{files}” needs {needs}.")
    if view and axes is not None:
        raise InputError(f"`axes` of the {where} with “{files}” is for files in space, and these are of pixels; remove it.")
    return KeypointSource(files=files, view=view, offset_frames=offset, sigma=float(sigma), names=names, axes=axes)
