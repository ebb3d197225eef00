"""The footage of a bar or a board: a folder of images, or a movie, for each camera; or the images of all cameras in one folder.

In one folder, the names of the files tell the cameras apart: one of the numbers in them counts the images, and the rest names the camera
(00001_cam0_L.jpg, 00001_cam1_M.jpg, 00137_cam0_L.jpg …).
"""

import re
from collections.abc import Iterable
from pathlib import Path

from ..foundation.errors import InputError
from ..images.sequence import IMAGE_ENDINGS, MOVIE_ENDINGS, ImageSequence, open_sequence

MOST_CAMERAS = 32  # of images in one folder
FEWEST_IMAGES = 2  # of each of them

Group = dict[tuple[str, str], list[str]]  # the files by what stands before and after the number


def open_views(folder: Path, noun: str, gaps: bool = False) -> tuple[tuple[str, ...], tuple[ImageSequence, ...]]:
    """Names and sequences of the cameras in a folder that has their images or movies; `gaps`: images may be missing.

    Raises:
        InputError: the folder is missing, or has fewer than two views.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give the folder that has one folder of images or one movie of the {noun} per camera.")
    names: list[str] = []
    sequences: list[ImageSequence] = []
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            endings = {p.suffix for p in path.iterdir() if p.suffix.lower() in IMAGE_ENDINGS}
            if endings:
                ending = max(sorted(endings), key=lambda e: sum(1 for _ in path.glob(f"*{e}")))
                names.append(path.name)
                sequences.append(open_sequence(folder, images=f"{path.name}/*{ending}", movie=None, view=path.name, gaps=gaps))
        elif path.suffix.lower() in MOVIE_ENDINGS:
            names.append(path.stem)
            sequences.append(open_sequence(folder, images=None, movie=path.name, view=path.stem))
    if not names:
        for name, pattern in cameras_of_files(p.name for p in folder.iterdir() if p.suffix.lower() in IMAGE_ENDINGS).items():
            names.append(name)
            sequences.append(open_sequence(folder, images=pattern, movie=None, view=name, gaps=gaps))
    if len(names) < 2:
        what = "no views" if not names else f"only the view {names[0]}"
        raise InputError(
            f"{folder} has {what}; it needs a folder of images, or a movie, for each of at least two cameras, or the images of all, "
            "named by number and camera, such as 0001_L.png."
        )
    return tuple(names), tuple(sequences)


def cameras_of_files(files: Iterable[str]) -> dict[str, str]:
    """The pattern of the images of each camera by its name, from the names of all files; nothing if these do not tell cameras apart.

    Of the numbers in the names, that one counts the images which gives the fewest cameras.
    """
    every = sorted(name for name in files if not name.startswith("."))
    columns = max((len(re.findall(r"\d+", Path(name).stem)) for name in every), default=0)
    guesses = [group for group in (_by_number(every, column) for column in range(columns)) if _tells_cameras_apart(group, len(every))]
    if not guesses:
        return {}
    found = {_name(*around): f"{_literal(around[0])}*{_literal(around[1])}" for around in min(guesses, key=len)}
    return found if len(found) == len(min(guesses, key=len)) else {}


def _by_number(files: list[str], column: int) -> Group:
    """The files by what stands before and after their number `column`; without those that have no such number."""
    groups: Group = {}
    for name in files:
        numbers = list(re.finditer(r"\d+", name[: len(Path(name).stem)]))
        if column < len(numbers):
            at = numbers[column]
            groups.setdefault((name[: at.start()], name[at.end() :]), []).append(name)
    return groups


def _tells_cameras_apart(groups: Group, files: int) -> bool:
    """Whether these are all files, of several cameras, and the pattern of none matches a file of another."""
    every = [name for of_camera in groups.values() for name in of_camera]
    if not (1 < len(groups) <= MOST_CAMERAS and len(every) == files and min(map(len, groups.values())) >= FEWEST_IMAGES):
        return False
    return all(
        sum(name.startswith(before) and name.endswith(after) for name in every) == len(of_camera)
        for (before, after), of_camera in groups.items()
    )


def _name(before: str, after: str) -> str:
    """The name of a camera: the name of its files without the number."""
    parts = (before.strip("_-. "), Path(after).stem.strip("_-. ") if after.startswith(("_", "-", " ")) or "." in after[1:] else "")
    return "_".join(part for part in parts if part)


def _literal(text: str) -> str:
    """Text in which a pattern's special characters match themselves."""
    return re.sub(r"([*?\[])", r"[\1]", text)
