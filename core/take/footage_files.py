"""The footage of the cameras: its files, names of the views guessed from the names of the files, and footage that was moved."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..foundation import bounded, store
from ..foundation.errors import InputError
from ..images.sequence import IMAGE_ENDINGS, MOVIE_ENDINGS, natural
from .bar_file import bar_path
from .sources import PERSON_SOURCES
from .take import read_take
from .writing import make_take, read_table

SIDES = {  # words for the sides, in the order of the cameras
    "L": ("l", "left", "links", "gauche", "izquierda", "sinistra"),
    "C": ("c", "centre", "center", "middle", "mid", "m", "mitte", "centro", "milieu"),
    "R": ("r", "right", "rechts", "droite", "derecha", "destra"),
}
SIDE_OF = {word: side for side, words in SIDES.items() for word in words}


def find_footage(folder: Path, names: Sequence[str]) -> list[Path]:
    """The movies and image folders chosen as files `names` in `folder`; without names, all in the folder.

    An image stands for its folder.

    Raises:
        InputError: there is no footage, or a file is not footage.
    """
    folder = Path(folder)
    chosen = [folder / name for name in names if name]
    if not chosen:
        try:
            inside = sorted((p for p in folder.iterdir() if not p.name.startswith(".")), key=natural)
        except OSError as error:
            raise InputError(f"Cannot read the folder {folder}: {error.strerror or error}.") from error
        chosen = [p for p in inside if _is_movie(p) or _has_images(p)]
        chosen = chosen or [p for p in inside if _is_image(p)][:1]
    if not chosen:
        raise InputError(f"{folder} holds no footage; choose the movies, or the folder that has a folder of images for every camera.")
    found: dict[Path, None] = {}
    for path in chosen:
        if not path.exists():
            raise InputError(f"The footage {path} is missing; check the path.")
        if not (path.is_dir() or _is_movie(path) or _is_image(path)):
            raise InputError(f"{path.name} is neither a movie nor an image; choose the footage of the cameras.")
        found[path.parent if _is_image(path) else path] = None
    return list(found)


def name_views(sources: Sequence[Path], taken: Sequence[str] = ()) -> list[tuple[str, Path]]:
    """Names for footage, in the order of the cameras: L, C, R if the file names contain the side, else the parts in which they differ."""
    sides = [side_of_name(path.stem if path.is_file() else path.name) for path in sources]
    if all(sides) and len({*sides, *taken}) == len(sides) + len(taken):
        named = list(zip([str(side) for side in sides], sources))
        return sorted(named, key=lambda pair: list(SIDES).index(pair[0]))
    ordered = sorted(sources, key=natural)
    named = []
    for path, short in zip(ordered, _different_parts([p.stem if p.is_file() else p.name for p in ordered])):
        name, known = short, {*taken, *(n for n, _ in named)}
        number = 2
        while name in known:
            name, number = f"{short} {number}", number + 1
        named.append((name, path))
    return named


def take_files(folder: Path, chosen: Sequence[str] = ()) -> list[Path]:
    """The files and folders in FOLDER that its take.toml names, apart from the rig.

    Empty where there is no take.toml, or where the `chosen` files are not the footage of all its views.

    Raises:
        InputError: take.toml cannot be read or is no take.
    """
    table = read_table(folder)
    views = table.get("views", [])
    footage = _in_folder(folder, [view.get("images") or view["movie"] for view in views])
    if {folder / name for name in chosen} - {folder / "take.toml"} not in (set(), set(footage)):
        return []
    persons = [view[key] for view in views for key in PERSON_SOURCES if key in view]
    model = table.get("body", {}).get("model", "")
    others = [*persons, *(source["files"] for source in table.get("keypoints", [])), *([model] if model.endswith(".toml") else [])]
    return list(dict.fromkeys([*footage, *_in_folder(folder, others)]))


def copy_take(source: Path, folder: Path) -> None:
    """Make FOLDER the same take as `source`: with its own take.toml and rig.toml, and links to the footage.

    Raises:
        InputError: `source` is no take, or something cannot be written.
    """
    rig_path, rig = read_take(source).rig_path, folder / "rig.toml"
    make_take(folder, {**read_table(source), "rig": rig.name}, [(folder / path.name, path) for path in take_files(source)])
    try:
        for path, copy in ((rig_path, rig), (bar_path(rig_path), bar_path(rig))):
            if path.exists():
                store.write_bytes(copy, bounded.bytes_of(path, bounded.CALIBRATION_BYTES))
    except OSError as error:
        raise InputError(f"Cannot copy the cameras {rig_path} into {folder}: {error.strerror or error}.") from error


def _in_folder(folder: Path, patterns: Sequence[str]) -> list[Path]:
    """What lies directly in FOLDER of the files that these patterns name."""
    return [path for pattern in patterns for path in sorted(bounded.matching(folder, Path(pattern).parts[0]))]


def find_moved(links: Mapping[str, Path], place: Path) -> dict[Path, Path]:
    """The present place of footage whose links in the take are broken: link → movie or folder of images.

    `links` are all links, by view. The footage is searched for by its former name, in the folder `place`, its parent and its subfolders.

    Raises:
        InputError: some is not found.
    """
    lost = {view: link for view, link in links.items() if not link.exists()}
    found = {view: _moved(link, place) for view, link in lost.items()}
    if missing := [view for view, path in found.items() if path is None]:
        names = ", ".join(_former(lost[view]) for view in missing)
        raise InputError(f"{place} does not contain {names} (the footage of {', '.join(missing)}); choose the folder where it is now.")
    return {lost[view]: path for view, path in found.items() if path is not None}


def _former(link: Path) -> str:
    """The former name of the footage of a link."""
    return link.readlink().name if link.is_symlink() else link.name


def _moved(link: Path, place: Path) -> Path | None:
    try:
        below = sorted((p for p in place.iterdir() if p.is_dir()), key=natural)
    except OSError as error:
        raise InputError(f"Cannot read the folder {place}: {error.strerror or error}.") from error
    tried = [root / _former(link) for root in (place, place.parent, *below)]
    is_footage = _is_movie if link.suffix.lower() in MOVIE_ENDINGS else _has_images
    return next((path for path in tried if is_footage(path)), None)


def side_of_name(stem: str) -> str | None:
    """L, C or R if a file's name contains exactly one side."""
    words = re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", stem).lower())
    found = {SIDE_OF[word] for word in words if word in SIDE_OF}
    return found.pop() if len(found) == 1 else None


def _different_parts(stems: Sequence[str]) -> list[str]:
    """The names without the words that all of them have in common; unchanged if that leaves nothing."""
    words = [re.findall(r"[^\W_]+", stem) for stem in stems]
    common = set(words[0]).intersection(*words[1:]) if len(words) > 1 else set()
    short = ["_".join(w for w in each if w not in common) for each in words]
    return short if all(short) and len(set(short)) == len(short) else list(stems)


def _is_movie(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in MOVIE_ENDINGS


def _is_image(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in IMAGE_ENDINGS


def _has_images(path: Path) -> bool:
    return path.is_dir() and any(map(_is_image, path.iterdir()))
