"""`tricap new`: a take from movies or image folders."""

import argparse
from pathlib import Path

from ..body.model_file import read_model
from ..calibration.rig_files import read_any
from ..foundation.bounded import real_path
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..images.sequence import movie_rate, open_sequence
from ..results.folder import check_no_root
from ..take.bar_file import read_bar, write_bar
from ..take.take import START_ALONE
from ..take.writing import ASSUMED_FPS, footage_entry, make_take, new_table, take_of_table


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Make TAKE with take.toml; footage outside the folder is linked into it, or copied where links are impossible.

    Everything is checked before the first file is written.
    """
    folder: Path = args.take
    check_no_root(folder)
    if (folder / "take.toml").exists():
        raise InputError(f"{folder} is a take already; choose another folder.")
    views = [tuple(v.split("=", 1)) for v in args.views]
    if any(len(v) != 2 or not all(v) for v in views):
        raise InputError("Write each view as NAME=FILE, such as L=left.mp4.")
    sources = [real_path(source) for _, source in views]
    for (name, _), source in zip(views, sources):
        if sources.count(source) > 1:
            raise InputError(f"View {name} has the same footage as another view, {source}; give each view the footage of its own camera.")
    entries, links = zip(*(footage_entry(folder, name, Path(source)) for name, source in views))
    stated = [rate for _, source in links if not source.is_dir() and (rate := round(movie_rate(source), 6)) > 0]
    fps = args.fps if args.fps is not None else next(iter(stated), ASSUMED_FPS)
    table = new_table(entries, fps=fps, interlaced=args.interlaced, model=args.model)
    take = take_of_table(folder, table)
    if take.joints_model:
        _check_model(take.joints_model)
    rig = read_any(args.rig) if args.rig else None
    cameras = [camera.name for camera in rig.cameras] if rig else []
    if rig and (unknown := [view.name for view in take.views if view.name not in cameras]):
        raise InputError(
            f"{args.rig} has no camera “{unknown[0]}”, but {', '.join(cameras)}; give --views these names, such as {cameras[0]}=FILE."
        )
    if rig:
        for (name, _), (_, source) in zip(views, links):
            _check_size(name, source, rig[name].size_px)
    make_take(folder, table, links, rig)
    if rig and (bar := read_bar(args.rig, rig)):
        write_bar(folder / "rig.toml", rig, *bar)
    todo = [] if rig else ["copy or calibrate rig.toml into it"]
    todo += ["click joints in Blender, or write them into its take.toml"] if take.body_model and take.body_model not in START_ALONE else []
    lines = [f"{folder}: a take of {len(views)} views, {fps:.6g} images per second. Next: {', '.join([*todo, f'tricap check {folder}'])}."]
    if args.fps is None and not stated:
        lines.append(f"The footage states no frame rate, so {fps:g} is assumed; if it is another, correct `fps` in {folder / 'take.toml'}.")
    return lines


def _check_model(model: str) -> None:
    """Check the body model of a take: one of ours by its name, or the path of the take's own.

    Raises:
        InputError: there is none, or it is faulty.
    """
    if model.endswith(".toml") and not Path(model).exists():
        raise InputError(
            f"The body model {model} is missing; copy it into that folder first, or leave --model out and write it under [body] later."
        )
    read_model(model)


def _check_size(name: str, source: Path, size_px: tuple[int, int]) -> None:
    """Check that the footage of a view is as large as the images of its camera.

    Raises:
        InputError: it is not, or its first image cannot be read.
    """
    if source.is_dir():
        sequence = open_sequence(source, images="*", movie=None, view=name, gaps=True, size_px=size_px)
    else:
        sequence = open_sequence(source.parent, images=None, movie=source.name, view=name, size_px=size_px)
    sequence.read(0)
