"""The folder of a run (OUT): the path of each result, the checkpoints, and run.json, the record of the run.

A checkpoint contains a digest of everything that it depends on; if that differs, it is computed again. Files: docs/formats.md.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..body.shape import LAST_LINE
from ..foundation import bounded, store
from ..foundation.errors import InputError
from ..foundation.lock import NAME, locked
from ..images.sequence import IMAGE_ENDINGS
from . import run_json
from .films import FILMS
from .own_files import MADE_IN, files_of, remove_own
from .run_json import FORMAT, VERSION

RESULTS = (  # files and folders that a run replaces
    "clouds", "frames.csv", "trajectories.npz", "trajectories_raw.npz", "tracked",
    "joints.csv", "motion.csv", "body.toml", "skin", "outlines", "report", *FILMS,
    "body.blend",
)  # fmt: skip

MADE_BY = {  # what of them the stages write, and others need
    "measure": ("clouds",),
    "track": ("trajectories.npz", "trajectories_raw.npz", "tracked"),
    "fit": ("joints.csv", "motion.csv", "body.toml", "frames.csv", "skin"),
    "report": ("report",),
}

MOST_ROW = 1 << 16  # bytes of a row of a table

FIELDS = "fields"  # the pictures of single fields of interlaced video, for Blender
EARLIER = "earlier_body"  # the finished body that was replaced last: see earlier_body.py
PARENTS = ("cache", FIELDS, EARLIER)  # whose folders are written to
WRITTEN = (
    *PARENTS,
    "contours",
    "planar",
    "points2d.csv",
    "points3d.csv",
    "run.json",
    NAME,
    *RESULTS,
)  # every name in OUT that a command writes to


def check_separate_folder(out: Path, take: Path | None = None, footage: Iterable[Path] = ()) -> None:
    """Refuse to mix results with footage, because one could replace the other. `footage`: all its files.

    Raises:
        InputError: OUT is a take, contains its footage or lies among its images, is the root of a drive, or take or footage lie where
            results are replaced.
    """
    check_no_root(out)
    where = bounded.real_path(out)
    advice = f"choose a separate folder for the results, such as {(where if take is None else take) / 'results'}."
    if (where / "take.toml").exists():
        raise InputError(f"{out} is itself a take; {advice}")
    replaced = [where / name for name in WRITTEN]
    for path, folders in _folders_of(footage):
        among = path.suffix.lower() in IMAGE_ENDINGS and take is not None and bounded.real_path(take) not in folders
        if where in folders or (among and folders.intersection(where.parents)):
            raise InputError(f"{out} contains the footage {path.name}; {advice}")
        if any(folder.is_relative_to(place) for folder in folders for place in replaced):
            raise InputError(f"The footage {path} is inside {out}, where a run replaces files; choose another folder for the results.")
    if take is not None and any(bounded.real_path(take).is_relative_to(place) for place in replaced):
        raise InputError(f"The take {take} is inside {out}, where a run replaces files; choose another folder for the results.")


def check_no_root(folder: Path) -> None:
    """Refuse the root of a drive as a folder for files of ours.

    Raises:
        InputError: it is one.
    """
    where = bounded.real_path(folder)
    if where == where.parent:
        raise InputError(f"{folder} is the root of a drive; choose a folder on it, such as {where / 'results'}.")


def _folders_of(footage: Iterable[Path]) -> list[tuple[Path, frozenset[Path]]]:
    """The real folders of files, that of the name and that of the file which it leads to: one file for all that are in the same ones."""
    real, found = dict[Path, Path](), dict[frozenset[Path], Path]()
    for path in footage:
        if path.parent not in real:
            real[path.parent] = bounded.real_path(path.parent)
        ends = {real[path.parent], bounded.real_path(path).parent if path.is_symlink() else real[path.parent]}
        found.setdefault(frozenset(ends), path)
    return [(path, folders) for folders, path in found.items()]


def check_not_result(file: Path, out: Path) -> None:
    """Refuse to write over a result of the run, or over the motion file, that is being read.

    Raises:
        InputError: `file` is such a file.
    """
    if bounded.real_path(file) == bounded.real_path(out) or is_result(file, out):
        raise InputError(f"{file} is also an input; choose another name, so that it is not overwritten.")


def is_result(file: Path, out: Path) -> bool:
    """Whether a file in the folder `out` is one that a run writes there, the scene excepted."""
    path, read = bounded.real_path(file), bounded.real_path(out)
    own = path.relative_to(read).parts[:1] if path != read and path.is_relative_to(read) else ()
    return bool(set(own) & {*WRITTEN} - {"body.blend"})


class Results:
    """An OUT folder. Creating the object checks that it is writable."""

    def __init__(self, folder: Path) -> None:
        self.folder = bounded.real_path(folder)
        check_no_root(folder)
        bounded.check_name(self.folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise InputError(f"{folder} is a file; choose a folder for the results.")
        for path in _written(self.folder):
            check_inside(path, self.folder)
        foreign = _not_from_a_run(self.folder)
        if foreign:
            raise InputError(
                f"{folder} contains “{foreign[0]}”, which was not written by Tricap; choose an empty or a new folder for the results."
            )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"Cannot make the folder {folder}: {error.strerror or error}. Choose another place for the results."
            ) from error
        if not os.access(self.folder, os.W_OK):
            raise InputError(f"The folder {folder} is read-only; choose another place for the results.")

    @contextmanager
    def opened(self) -> Iterator["Results"]:
        """Lock the folder against other runs, and remove the partial files of a killed run.

        Raises:
            InputError: another run is using it.
        """
        with locked(self.folder):
            folders = [self.path(name) for name in ("clouds", "tracked", "skin", "report", "contours", "outlines", EARLIER)]
            for folder in (self.folder, *folders, *self.path("cache").glob("*/")):
                for path in [*folder.glob(".*.part"), *folder.glob(".*.part.blend")]:
                    self.remove(str(path.relative_to(self.folder)))
            yield self

    def path(self, *names: str) -> Path:
        """A file or folder inside OUT."""
        return self.folder.joinpath(*names)

    def cloud_path(self, frame: int) -> Path:
        """clouds/NNNN.ply"""
        return self.path("clouds", f"{frame:04d}.ply")

    def load_checkpoint(self, stage: str, name: str, key: str) -> dict[str, np.ndarray] | None:
        """The arrays of a checkpoint, or None when it is missing, damaged, changed by somebody, or made from other input."""
        path = self.path("cache", stage, f"{name}.npz")
        if not path.exists():
            return None
        try:
            arrays, header = store.load(path)
        except InputError:
            return None  # a damaged checkpoint is computed again
        return arrays if header.get("key") == key and store.CONTENT in header else None

    def has_checkpoint(self, stage: str, name: str, key: str) -> bool:
        """Whether there is a checkpoint from this input; its arrays are not read."""
        return store.header_of(self.path("cache", stage, f"{name}.npz")).get("key") == key

    def save_checkpoint(self, stage: str, name: str, key: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a checkpoint."""
        store.save(self.path("cache", stage, f"{name}.npz"), arrays, {"key": key}, compress=False)

    def remove(self, *names: str) -> None:
        """Remove results of an earlier run, files or folders, if they are there. In a folder, only files that a run makes are removed.

        Raises:
            InputError: it cannot be removed.
        """
        for name in names:
            path = self.path(name)
            try:
                kind = path.relative_to(self.folder).parts[0]
                if kind in MADE_IN and (kind == name or path.is_dir()):
                    remove_own(path, kind)
                elif path.is_symlink() or path.is_file():
                    path.unlink()
            except OSError as error:
                reason = f"Cannot remove {path}: {error.strerror or error}. Close the program that uses it, or choose another folder."
                raise InputError(reason) from error

    def remove_other_clouds(self, frames: range) -> None:
        """Remove the clouds of all other frames."""
        for path in self.path("clouds").glob("*.ply"):
            if path.stem.isdecimal() and int(path.stem) not in frames:
                path.unlink()

    def read_run(self) -> dict[str, Any]:
        """run.json, or an empty table where there is none yet.

        Raises:
            InputError: it is damaged, or of a newer version.
        """
        path = self.path("run.json")
        return run_json.read_run(path) if path.exists() else {}

    def write_run(self, run: Mapping[str, Any]) -> None:
        """run.json, with the number and the bytes of the files as they are now."""
        files = {name: size for names in MADE_BY.values() for name in names if (size := _size(self.path(name)))[0]}
        store.write_json(self.path("run.json"), {"format": FORMAT, "version": VERSION, **run, "files": files})


class FitCheckpoints:
    """The checkpoints of a running fit: cache/fit, or another folder for a second fit of the same run."""

    def __init__(self, results: Results, key: str, folder: str = "fit") -> None:
        self._results, self._key, self._folder = results, key, folder

    def load(self, name: str) -> dict[str, np.ndarray] | None:
        """The checkpoint of an interrupted fit of the same input, if there is one."""
        return self._results.load_checkpoint(self._folder, name, self._key)

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a checkpoint, in place of an earlier one of this name."""
        self._results.save_checkpoint(self._folder, name, self._key, arrays)


def lost(folder: Path, run: Mapping[str, Any], among: Iterable[str] | None = None) -> dict[str, list[str]]:
    """By stage, the results in a folder, all of them or those `among` some, that have fewer files or bytes than when run.json was written,
    or arrays (.npz) with another content. The run.json of earlier versions has no sizes to compare.

    A table or a body that somebody edited may have fewer bytes, if it still ends as it did."""
    then, found, last = run.get("files", {}), dict[str, list[str]](), run.get("frames", [0, 0])[1] - 1
    for stage, names in MADE_BY.items():
        known = [name for name in names if name in then and (among is None or name in among)]
        smaller = [name for name in known if any(now < was for now, was in zip(_size(folder / name), then[name]))]
        less = [name for name in known if (name in smaller and not _ends_with(folder / name, last)) or _is_damaged(folder / name)]
        if less:
            found[stage] = less
    return found


def with_fewer_files(folder: Path, run: Mapping[str, Any], among: Iterable[str]) -> list[str]:
    """The folders of results, among some, that have fewer files than when run.json was written."""
    then = run.get("files", {})
    return [name for name in among if name in then and _size(folder / name)[0] < then[name][0]]


def check_complete(folder: Path, names: Iterable[str]) -> None:
    """Check that some results in the folder of a run are as the run wrote them.

    Raises:
        InputError: one is missing, cut or damaged; or run.json is.
    """
    run = run_json.read_run(folder / "run.json") if (folder / "run.json").is_file() else {}
    if less := [name for of_stage in lost(folder, run, [*names]).values() for name in of_stage]:
        what = f"{', '.join(less)} in {folder}"
        raise InputError(f"{what} is missing, cut, damaged, or lacks files; repeat the run, which makes it again.")


def _files(path: Path) -> Iterable[Path]:
    return (p for p in (files_of(path, path.name) if path.name in MADE_IN else [path]) if p.is_file())


def _size(path: Path) -> tuple[int, int]:
    """The number of files that a result has, and their bytes."""
    sizes = [p.stat().st_size for p in _files(path)]
    return len(sizes), sum(sizes)


def _ends_with(path: Path, frame: int) -> bool:
    """Whether a file is a table whose last row is of this frame, with as many columns as the first, or a whole body.toml."""
    if path.suffix not in (".csv", ".toml"):
        return False
    try:
        if path.suffix == ".toml":
            return bounded.text_of(path, bounded.TOML_BYTES).rstrip().endswith(f"\n{LAST_LINE}")
        with bounded.opened(path, bounded.TABLE_BYTES) as file:
            columns = file.readline(MOST_ROW).count(b",")
            file.seek(max(0, file.seek(0, os.SEEK_END) - MOST_ROW))
            last = file.read().replace(b"\r", b"").removesuffix(b"\n").rpartition(b"\n")[2]
    except (OSError, ValueError):
        return False
    return last.startswith(f"{frame},".encode()) and last.count(b",") == columns


def _is_damaged(path: Path) -> bool:
    """Whether arrays of a result are not as they were written."""
    try:
        for file in _files(path):
            if file.suffix == ".npz":
                store.load(file)
    except InputError:
        return True
    return False


def _written(folder: Path) -> list[Path]:
    """Every path that a command writes to in a folder of results, and the existing folders of checkpoints and of fields."""
    parents = [folder / name for name in PARENTS]
    inside = [path for parent in parents if parent.is_dir() and not parent.is_symlink() for path in parent.iterdir()]
    return [*(folder / name for name in WRITTEN), *inside]


def check_inside(path: Path, folder: Path) -> None:
    """Check that a path to be written to is not a link out of the folder that the user chose (resolved).

    Raises:
        InputError: it is.
    """
    if path.is_symlink() and not bounded.real_path(path).is_relative_to(folder):
        raise InputError(f"{path} is a link to a place outside {folder}; remove the link, or choose another folder.")


def _not_from_a_run(folder: Path) -> list[str]:
    """Files and folders that have the name of a result, `cache` or run.json, although no run has written to the folder.

    A run that was stopped early leaves a checkpoint, and a killed one its lock.
    """
    if bounded.is_of_a_run(folder) or has_checkpoints(folder / "cache"):
        return []
    found = [name for name in ("cache", "run.json", *RESULTS) if (folder / name).exists()]
    return [name for name in found if name != "cache" or any(not p.is_dir() for p in (folder / name).rglob("*"))]


def has_checkpoints(cache: Path) -> bool:
    """Whether a folder has our checkpoints, and nothing else."""
    if not cache.is_dir() or not all(p.is_dir() for p in cache.iterdir()):
        return False
    files = [file for stage in cache.iterdir() for file in stage.iterdir()]
    return all(file.suffix in (".npz", ".part") for file in files) and any(store.header_of(file) for file in files)
