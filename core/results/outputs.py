"""A file that a command writes is none that it reads, no part of a take, and no result of a run, whatever way leads there."""

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from ..foundation import bounded
from ..foundation.errors import InputError
from ..images.sequence import IMAGE_ENDINGS, MOVIE_ENDINGS
from ..take.footage_files import take_files
from ..take.take import read_take
from .blend_file import BLEND
from .folder import check_not_result, is_result

LONGEST_START = 200  # bytes
LEVELS = 4  # so far above a file its take is looked for


def check_output(file: Path, inputs: Iterable[Path] = (), *, may_be_rig: bool = False) -> None:
    """Check what a command is to write, a file or a folder. `may_be_rig`: it is a rig, which may replace the one of a take.

    Raises:
        InputError: it is an input, or lies in a folder of images that is one, or belongs to a take, or a run made it.
    """
    ways, inputs = {Path(os.path.abspath(file)), bounded.real_path(file)}, [path for path in inputs if path.exists()]
    for path in inputs:
        is_input = file.exists() and os.path.samefile(file, path)
        is_image = path.is_dir() and file.suffix.lower() in IMAGE_ENDINGS + MOVIE_ENDINGS and _holds(path, ways) and file.exists()
        is_run = (path / "run.json").is_file()
        if is_input or (is_image and not is_run):
            raise InputError(f"{file} is also an input; choose another name, so that it is not overwritten.")
        if is_run:
            check_not_result(file, path)
    above = {folder for way in ways for folder in (way, *way.parents[:LEVELS])}
    read = {bounded.real_path(path) for path in inputs}
    for folder in above:
        is_scene = bounded.real_path(file) == bounded.real_path(folder) / BLEND and bounded.real_path(folder) not in read
        if (is_scene or is_result(file, folder)) and bounded.is_of_a_run(folder):
            raise InputError(f"{file} is a result of the run in {folder}; choose another name, so that it is not replaced.")
    for folder in (folder for folder in above if (folder / "take.toml").is_file()):
        _check_apart(file, ways, folder, may_be_rig)
    for folder in filter(None, map(_take_of_run, inputs)):
        _check_apart(file, ways, folder, may_be_rig)


def _holds(folder: Path, ways: Iterable[Path]) -> bool:
    return any(bounded.real_path(way.parent) == bounded.real_path(folder) for way in ways)


def _check_apart(file: Path, ways: Iterable[Path], folder: Path, may_be_rig: bool) -> None:
    for part in _parts(folder, may_be_rig):
        if any(way.is_relative_to(place) for way in ways for place in (part, bounded.real_path(part))):
            raise InputError(f"{file} belongs to the take {folder}; choose another name, so that it is not overwritten.")


def _parts(folder: Path, may_be_rig: bool) -> Iterator[Path]:
    """take.toml, and what it names."""
    yield folder / "take.toml"
    try:
        take = read_take(folder)
        yield from take_files(folder)
    except InputError:  # a damaged take is protected, too, but nobody knows what belongs to it
        return
    yield from (folder / f"{view.name}.wav" for view in take.views)
    yield from (folder / view.timestamps for view in take.views if view.timestamps)
    if not may_be_rig:
        yield take.rig_path


def _take_of_run(out: Path) -> Path | None:
    """The folder of the take whose results are in a folder; None for another folder, or a take that has moved."""
    try:
        run = bounded.json_of(bounded.bytes_of(out / "run.json", bounded.JSON_BYTES))
        folder = Path(run["take"])
        return folder if (folder / "take.toml").is_file() else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def check_outputs(values: dict[str, object], outputs: Sequence[str], *, may_be_rig: bool = False, results: Path | None = None) -> None:
    """`check_output` of the arguments of a command that are named `outputs`; all others with names of files are inputs. `results`: the
    folder OUT whose files the command replaces.

    Raises:
        InputError: see there, or an input is one of these files.
    """
    texts = [text for name, value in values.items() if name not in outputs for text in (value if isinstance(value, list) else [value])]
    inputs = [Path(part) for text in texts if isinstance(text, (str, Path)) for part in {str(text), str(text).partition("=")[2]} if part]
    inputs = [path for path in inputs if _is_there(path)]
    for path in inputs:
        if results is not None and path.is_file() and is_result(path, results):
            raise InputError(f"{path} is a result, which this command replaces; copy it to another folder and give the copy.")
    for name in outputs:
        file = values.get(name)
        if isinstance(file, Path):
            check_output(file, inputs, may_be_rig=may_be_rig and name == "out")


def check_replaceable(file: Path, *starts: str) -> None:
    """Check that a file, if there is one, is of an earlier call, by how it begins (`starts`). Nobody gave its name.

    Raises:
        InputError: it is another one.
    """
    if not file.exists():
        return
    try:
        with bounded.opened(file, bounded.TABLE_BYTES) as opened:
            ours = opened.read(LONGEST_START).startswith(tuple(start.encode() for start in starts))
    except OSError:
        ours = False
    if not ours:
        raise InputError(f"{file} would be overwritten, and is not of an earlier call; rename it, or choose another name or folder.")


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a text that is no name, or too long for one
        return False
