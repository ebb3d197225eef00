"""Making and changing take.toml: it is checked, then written completely or not at all, and not written where nothing changes.

Editors change the table of the file; keys that they do not change stay. Comments are lost: a file that has some is copied before.
"""

import errno
import glob
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..foundation import bounded, store
from ..foundation.errors import InputError
from ..geometry.rig import Rig, write_rig
from ..images.sequence import IMAGE_ENDINGS, MOVIE_ENDINGS
from .bar_file import bar_path
from .take import FORMAT, VERSION, Take, take_of_text

Link = tuple[Path, Path]  # its path in the take's folder, and the footage that it leads to
Table = dict[str, Any]
DEFAULTS = {"interlaced": "none", "first_field": "odd", "rig": "rig.toml", "frame": 0, "offset_frames": 0}  # that a file may leave out
STRING = re.compile(r'"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'')
MOST_COPIES = 99
OWN_NAMES = ("take.toml", "take.toml.bak", "rig.toml", bar_path(Path("rig.toml")).name, "fields")  # of files and folders of a take
COPIED = " The file with your comments was copied beside it (*.bak)."
ASSUMED_FPS = 25.0  # of footage that states no frame rate, where nobody says it either


def new_table(views: Sequence[Table], *, fps: float = ASSUMED_FPS, interlaced: str = "none", model: str | None = None) -> Table:
    """The table of a new take.toml; `views` as in [[views]]."""
    table: Table = {"format": FORMAT, "version": VERSION, "fps": fps, "interlaced": interlaced, "rig": "rig.toml", "views": [*views]}
    return table | ({"body": {"model": model}} if model else {})


def read_table(folder: Path) -> Table:
    """The table in FOLDER/take.toml, checked; empty if there is no such file.

    Raises:
        InputError: the file cannot be read or is no take.
    """
    path = Path(folder) / "take.toml"
    if not path.exists():
        return {}
    try:
        text = bounded.text_of(path, bounded.TOML_BYTES)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"Cannot read {path}: {getattr(error, 'strerror', None) or error}.") from error
    take_of_text(text, path)
    return bounded.toml_of(text)


def take_of_table(folder: Path, table: Table) -> Take:
    """The take described by this table of FOLDER/take.toml.

    Raises:
        InputError: a key is unknown, or a value is impossible.
    """
    return take_of_text(toml_text(table), Path(folder) / "take.toml")


def write_table(folder: Path, table: Table) -> bool:
    """Write FOLDER/take.toml; returns False, without writing, if the file has the same content already.

    Raises:
        InputError: the table is no take, or the file cannot be written; it is unchanged then.
    """
    take_of_table(folder, table)
    path = Path(folder) / "take.toml"
    if path.exists() and _essential(read_table(folder)) == _essential(table):
        return False
    if path.is_symlink():
        raise InputError(f"{path} is a link, which a file would replace; put a copy in its place, or change the take that it leads to.")
    if has_comments(folder):
        copy_aside(path)
    store.write_text(path, toml_text(table))
    return True


def has_comments(folder: Path) -> bool:
    """Whether FOLDER/take.toml has comments, which are lost when it is written: then the earlier file is copied to take.toml.bak."""
    try:
        return "#" in STRING.sub("", bounded.text_of(Path(folder) / "take.toml", bounded.TOML_BYTES))
    except (OSError, UnicodeDecodeError):
        return False


def copy_aside(path: Path) -> None:
    """Copy a file to NAME.bak, or to NAME.2.bak, … where that is another file."""
    content = bounded.bytes_of(path, bounded.TOML_BYTES)
    for number in range(1, MOST_COPIES + 1):
        copy = path.with_name(f"{path.name}{f'.{number}' if number > 1 else ''}.bak")
        if not os.path.lexists(copy):
            store.write_bytes(copy, content)
            return
    raise InputError(f"{path.parent} has {MOST_COPIES} copies of {path.name} with comments; remove some of them (*.bak).")


def renumbered(table: Table, per_image: int, before: int) -> Table:
    """A take's table for images of `per_image` frames instead of `before`, with all frame numbers converted."""

    def first(frame: int) -> int:
        return frame * per_image // before

    def span(frames: list[int]) -> list[int]:
        return [first(frames[0]), -(-frames[1] * per_image // before)]

    made = dict(table)
    if "frames" in made:
        made["frames"] = span(made["frames"])
    if "seeds" in made:
        made["seeds"] = {**made["seeds"], "frame": first(made["seeds"].get("frame", 0))}
    if "keyframes" in made:
        by_frame = {first(k["frame"]): {**k, "frame": first(k["frame"])} for k in reversed(made["keyframes"])}
        seeds = made.get("seeds", {})
        if seeds.get("joints") and (same := by_frame.pop(seeds["frame"], None)):
            made["seeds"] = {**seeds, "joints": {**same.get("joints", {}), **seeds["joints"]}}
        made["keyframes"] = [by_frame[frame] for frame in sorted(by_frame)]
    if "corrections" in made:
        made["corrections"] = [{**c, **({"frame": first(c["frame"])} if "frame" in c else {"frames": span(c["frames"])})}
                               for c in made["corrections"]]  # fmt: skip
    return made


def footage_entry(folder: Path, name: str, source: Path) -> tuple[Table, Link]:
    """The entry of [[views]] for footage, a movie or a folder of images, and the link into the take's folder that it needs.

    Raises:
        InputError: the footage is missing, holds the folder, or another file has its name in the folder, or may get it.
    """
    if name.casefold() in OWN_NAMES:
        raise InputError(f"A view cannot be named “{name}”, as a file of the take itself is; choose another name for it, such as C.")
    if not source.exists():
        whole = f" (for a pattern give its folder, {source.parent})" if "*" in source.name else ""
        raise InputError(f"The footage {source} of view {name} is missing; check the path{whole}.")
    if source.is_dir():
        if bounded.real_path(folder).is_relative_to(bounded.real_path(source)):
            raise InputError(f"{folder} is the folder of the images of view {name}, or lies in it; choose another folder for the take.")
        endings = sorted({p.suffix for p in source.iterdir() if p.suffix.lower() in IMAGE_ENDINGS})
        if len(endings) != 1:
            raise InputError(
                f"The folder {source} of view {name} has {'no images' if not endings else 'images of several kinds'}; it needs one kind."
            )
        entry, target = {"name": name, "images": f"{glob.escape(name)}/*{endings[0]}"}, folder / name
    elif source.suffix.lower() not in MOVIE_ENDINGS or not source.is_file():
        raise InputError(f"The footage {source} of view {name} is neither a folder of images nor a movie ({', '.join(MOVIE_ENDINGS)}).")
    else:
        entry, target = {"name": name, "movie": name + source.suffix}, folder / f"{name}{source.suffix}"
    if target.exists() and not target.samefile(source):
        raise InputError(f"{target} exists and is not the footage {source}; choose another folder or another name for the view.")
    return entry, (target, source)


def make_take(folder: Path, table: Table, links: Sequence[Link], rig: Rig | None = None) -> None:
    """Make a take's folder: its footage linked, or copied where links cannot be made, take.toml, and rig.toml.

    Raises:
        InputError: something cannot be written; everything made so far is removed.
    """
    take_of_table(folder, table)
    made = link_footage(folder, links)
    try:
        if rig:
            write_rig(folder / "rig.toml", rig)
        store.write_text(folder / "take.toml", toml_text(table))
    except (OSError, InputError) as error:
        unlink_footage(made)
        raise error if isinstance(error, InputError) else _cannot_make(folder, error) from error


def link_footage(folder: Path, links: Sequence[Link]) -> list[Path]:
    """Link footage into a take's folder; returns the new links.

    Raises:
        InputError: the folder cannot be written to; the new links are removed.
    """
    made: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for target, source in links:
            if not target.exists():
                if target.is_symlink():  # a copy, where links cannot be made, would be written to its end
                    raise FileExistsError(errno.EEXIST, "it is a link to a place that does not exist; remove it", str(target))
                made.append(target)
                _link(target, source)
    except OSError as error:
        unlink_footage(made)
        raise _cannot_make(folder, error) from error
    return made


def relink_footage(moved: Mapping[Path, Path]) -> None:
    """Let links in a take's folder lead to footage elsewhere (`footage_files.find_moved`).

    Raises:
        InputError: the folder cannot be written to.
    """
    for link, source in moved.items():
        try:
            link.unlink(missing_ok=True)
            _link(link, source)
        except OSError as error:
            raise InputError(f"Cannot link {source} into the take as {link}: {error.strerror or error}.") from error


def toml_text(table: Table) -> str:
    """A table as TOML: plain values, then [tables] and [[lists of tables]]; deeper levels are written in one line."""
    return "\n".join(_lines(table, ())).lstrip("\n") + "\n"


def _lines(table: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    """The lines of a table at `path`."""
    opened = {k: v for k, v in table.items() if len(path) < 2 and _is_table(v) or not path and _is_tables(v)}
    for key, value in table.items():
        if key not in opened:
            yield f"{_key(key)} = {_value(value)}"
    for key, value in opened.items():
        for each in value if isinstance(value, list) else [value]:
            name = ".".join(map(_key, (*path, key)))
            yield f"\n[[{name}]]" if isinstance(value, list) else f"\n[{name}]"
            yield from _lines(each, (*path, key, "") if isinstance(value, list) else (*path, key))


def _essential(value: Any) -> Any:
    """A table without the values that a file may leave out."""
    if isinstance(value, list):
        return [_essential(each) for each in value]
    if not isinstance(value, Mapping):
        return value
    pairs = ((key, _essential(each)) for key, each in value.items())
    return {key: each for key, each in pairs if each not in ({}, [], "") and not (key in DEFAULTS and each == DEFAULTS[key])}


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping)


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(_is_table, value))


def _key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else _text(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }" if value else "{}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value)


def _text(text: str) -> str:
    """A TOML basic string; JSON's escapes are valid in TOML."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _link(target: Path, source: Path) -> None:
    try:
        target.symlink_to(bounded.real_path(source), target_is_directory=source.is_dir())
    except OSError:
        (shutil.copytree if source.is_dir() else shutil.copy2)(source, target)


def unlink_footage(made: Sequence[Path]) -> None:
    """Remove the links that `link_footage` made; the footage stays."""
    for target in made:
        if target.is_dir() and not target.is_symlink():
            shutil.rmtree(target, ignore_errors=True)
        else:
            target.unlink(missing_ok=True)


def _cannot_make(folder: Path, error: OSError) -> InputError:
    return InputError(f"Cannot make the take {folder}: {error.strerror or error}. Choose another folder.")
