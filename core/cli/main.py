"""The `tricap` command, for a terminal and for `blender --command tricap`. __main__.py adds the commands that need Blender.

Exit codes: 0 done, 2 invalid input (one sentence on stderr), 130 cancelled (finished work is saved), 1 a bug (with a traceback).
"""

import argparse
import importlib.util
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2

from ..body.model_file import model_names, read_model
from ..calibration.rig_files import read_any
from ..foundation.errors import InputError
from ..foundation.progress import Cancelled, Monitor
from ..foundation.threads import one_thread_in_linear_algebra
from ..images.interlace import BOTH, INTERLACE
from ..results.folder import check_separate_folder
from ..run import pipeline, take_run
from ..take.bar_file import read_bar, write_bar
from ..take.footage import open_take
from ..take.take import read_take
from ..take.writing import footage_entry, make_take, new_table, take_of_table
from . import batch, calibrate, check, contour, fields, points, track2d
from .arguments import frame_range, named_path, overrides, with_joined_frames

# Adds a sub-command to the parser. The command's `run(args, monitor)` returns the lines to show, and sets `args.always_shown` to those
# that --quiet does not suppress: findings and failures.
Adder = Callable[[Any], None]


def main(argv: list[str] | None = None, adders: tuple[Adder, ...] = ()) -> int:
    """Run one command of the core, or one that `adders` add; returns the exit code."""
    parser = build_parser(adders)
    args = parser.parse_args(with_joined_frames(sys.argv[1:] if argv is None else argv))
    args.parser = parser
    _quiet_decoders()
    monitor = Monitor(_progress_line if sys.stderr.isatty() and not args.quiet else None if args.quiet else _plain_progress())
    try:
        with _interrupts(monitor), one_thread_in_linear_algebra():
            lines = args.run(args, monitor)
    except InputError as error:
        _write_line(f"tricap: {error}", sys.stderr)
        return 2
    except Cancelled as stop:
        _write_line(f"tricap: {stop}", sys.stderr)
        return 130
    shown = lines if not args.quiet or getattr(args, "json", False) else getattr(args, "always_shown", [])
    for line in shown:
        _write_line(line, sys.stdout)
    return int(getattr(args, "exit_code", 0))


def build_parser(adders: tuple[Adder, ...] = ()) -> argparse.ArgumentParser:
    """The parser with all commands."""
    parser = argparse.ArgumentParser(prog="tricap", description="Measure a moving person from the video of calibrated cameras.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _new_command(commands)
    _stage_command(commands, "seeds", "count the surface seeds in one frame and show their depths", _seeds, out=False)
    _stage_command(commands, "measure", "measure the surface of each frame", _stages("measure"))
    points.add_arguments(_stage_command(commands, "track", "track the points of the surface, or chosen points", _track))
    _stage_command(commands, "fit", "fit the body's shape and motion", _stages("fit"))
    everything = _stage_command(commands, "run", "run all stages, from the images to the Blender file; a stopped run resumes", _run)
    everything.add_argument("--restart", action="store_true", help="start again instead of resuming")
    everything.add_argument("--pictures", nargs="+", type=int, default=[], metavar="FRAME", help="frames to show in the report")
    demo = commands.add_parser("demo", help="make a synthetic recording, run all stages on it, and compare with the truth")
    demo.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder for the recording and the results")
    demo.set_defaults(run=_demo, json=False)
    core_commands = (check, calibrate, track2d, contour, batch, fields)
    for add in (*(module.add_command for module in core_commands), *adders):
        add(commands)
    for sub in commands.choices.values():
        for action in sub._actions:
            action.type = named_path if action.type is Path else action.type
        sub.add_argument("--quiet", action="store_true", help="show errors and findings only")
    return parser


def _new_command(commands: Any) -> None:
    new = commands.add_parser("new", help="make a take from movies or image folders")
    new.add_argument("take", type=Path, metavar="TAKE", help="the folder to create")
    new.add_argument("--views", nargs="+", required=True, metavar="NAME=FILE", help="movies or image folders, in the order of the cameras")
    new.add_argument("--interlaced", choices=(*INTERLACE, BOTH), default="none", help="the lines of interlaced video to measure")
    new.add_argument("--fps", type=float, default=25.0, metavar="F", help="images per second (default: 25)")
    new.add_argument("--rig", type=Path, metavar="FILE", help="the cameras: rig.toml, or a calibration of another tool")
    about = f"the body model: {', '.join(model_names())}, your own .toml file, or none (surface and tracks only)"
    new.add_argument("--model", default=None, metavar="NAME", help=about)
    new.set_defaults(run=_new)


def _stage_command(commands: Any, name: str, about: str, action: Callable[..., list[str]], *, out: bool = True) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=about, description=about[0].upper() + about[1:])
    parser.add_argument("take", type=Path, metavar="TAKE", help="folder with take.toml")
    if out:
        parser.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder for the results")
        parser.add_argument("--json", action="store_true", help="print run.json at the end, and nothing else on standard output")
        parser.add_argument("--frames", metavar="A:B", help="only frames A to B - 1")
    parser.add_argument("--set", action="append", default=[], metavar="GROUP.NAME=VALUE", help="a setting, such as matching.patch_px=17")
    about = "the settings that are not set otherwise: the defaults, or the published method"
    parser.add_argument("--preset", dest="set", action="append", type="method.preset={}".format, metavar="default|published", help=about)
    about = "how much to measure: what a body's motion needs (the default), or every point of the surface"
    parser.add_argument("--quality", dest="set", action="append", type="surface.quality={}".format, metavar="motion|surface", help=about)
    parser.set_defaults(run=action)
    return parser


def _stages(*names: str) -> Callable[[argparse.Namespace, Monitor], list[str]]:
    def action(args: argparse.Namespace, monitor: Monitor) -> list[str]:
        with take_run.open_run(args.take, args.out, overrides(args.set), frame_range(args.frames)) as job:
            for name in names:
                getattr(pipeline, name)(job, monitor)
            return _summary(job, args.json)

    return action


def _track(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    return points.run(args, monitor) if args.points else _stages("measure", "track")(args, monitor)


def _run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    given = args.take, args.out, overrides(args.set), frame_range(args.frames)
    with take_run.open_run(*given, restart=args.restart, pictures=args.pictures) as job:
        if not args.pictures and pipeline.is_complete(job) and _has_scene(job, args):
            job.record["warnings"] = job.results.read_run().get("warnings", [])
            return _summary(job, args.json) + ([] if args.json else ["Nothing has changed since that run; --restart begins anew."])
        pipeline.all_stages(job, monitor)
        scene = _build_scene(job, args, monitor)
        return _summary(job, args.json) + ([] if args.json else scene)


def _has_scene(job: take_run.Run, given: argparse.Namespace) -> bool:
    """Whether body.blend is there, or cannot be made by this command."""
    without = "scene" not in _names_of(given.parser) or importlib.util.find_spec("bpy") is None
    return without or job.results.path("body.blend").is_file()


def _build_scene(job: take_run.Run, given: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Build body.blend with the add-on's command `scene`, where Blender is available."""
    blend = job.results.path("body.blend")
    if "scene" not in _names_of(given.parser):
        return []
    try:
        quiet = ["--quiet"] if given.quiet else []
        args = given.parser.parse_args(["scene", str(job.results.folder), "--blend", str(blend), *quiet])
        return [str(line) for line in args.run(args, monitor)]
    except InputError as error:
        job.warn(f"No body.blend was written: {error}")
        job.results.write_run(job.record)
    return []


def _summary(job: take_run.Run, as_json: bool) -> list[str]:
    if as_json:
        return [json.dumps(job.results.read_run(), indent=1, ensure_ascii=False)]
    return [f"{job.results.folder}: {job}", *(f"Note: {sentence}" for sentence in job.record["warnings"])]


def _seeds(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    from ..surface.measure import MeasureSettings, first_seeds
    from ..surface.resolution import measured_footage

    take = read_take(args.take)
    settings = take_run.settings_of(take.settings, overrides(args.set), str(args.take))
    footage = open_take(take, click_sigma_px=settings["fitting"].click_sigma_px)
    frame = footage.take.clicks.frame if footage.take.clicks.frame in footage.frames else footage.frames.start
    measured = measured_footage(footage, settings["surface"].quality, settings["growing"].spacing_px)
    where, seeds = first_seeds(measured, MeasureSettings.of(settings), frame, monitor)
    near, far = where.depth_range_m
    args.always_shown = [
        f"Frame {frame}: {len(seeds.depth_m)} surface seeds between {near:.2f} and {far:.2f} m (depths from {where.method}), "
        f"{len(footage.take.clicks.joints)} clicked joints, {len(where.planes)} planes of the room excluded."
    ]
    return list(args.always_shown)


def _new(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Make TAKE with take.toml; footage outside the folder is linked into it, or copied where links are impossible.

    Everything is checked before the first file is written.
    """
    folder: Path = args.take
    if (folder / "take.toml").exists():
        raise InputError(f"{folder} is a take already; choose another folder.")
    views = [tuple(v.split("=", 1)) for v in args.views]
    if any(len(v) != 2 or not all(v) for v in views):
        raise InputError("Write each view as NAME=FILE, such as L=left.mp4.")
    sources = [Path(source).resolve() for _, source in views]
    for (name, _), source in zip(views, sources):
        if sources.count(source) > 1:
            raise InputError(f"View {name} has the same footage as another view, {source}; give each view the footage of its own camera.")
    entries, links = zip(*(footage_entry(folder, name, Path(source)) for name, source in views))
    table = new_table(entries, fps=args.fps, interlaced=args.interlaced, model=args.model)
    take = take_of_table(folder, table)
    if take.body_model and not args.model.endswith(".toml"):  # a user's own model may be copied into the folder later
        read_model(args.model)
    rig = read_any(args.rig) if args.rig else None
    if rig:
        for view in take.views:
            rig[view.name]
    make_take(folder, table, links, rig)
    if rig and (bar := read_bar(args.rig, rig)):
        write_bar(folder / "rig.toml", rig, *bar)
    todo = [] if rig else ["copy or calibrate rig.toml into it"]
    todo += ["click joints in Blender, or write them into its take.toml"] if take.body_model else []
    return [
        f"{folder}: a take of {len(views)} views, {args.fps:g} images per second. Next: {', '.join([*todo, f'tricap check {folder}'])}."
    ]


def _demo(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Make the synthetic arm, run all stages, and compare with the truth."""
    from ..synthetic.arm import make_arm_take
    from ..synthetic.score import score_run

    take, out = args.out / "take", args.out
    check_separate_folder(out)
    if not (take / "take.toml").exists():
        make_arm_take(take, monitor=monitor)
    job = pipeline.run(take, out, None, monitor)
    lines = _build_scene(job, args, monitor)
    return [
        str(job),
        *lines,
        "Compared with the truth of the recording:",
        str(score_run(take, out, monitor)),
        f"Pictures: {out / 'report'}   Report: {out / 'report' / 'report.html'}   Blender file: {out / 'body.blend'}",
    ]


@contextmanager
def _interrupts(monitor: Monitor) -> Iterator[None]:
    """Ctrl-C cancels at the next step; a second Ctrl-C interrupts at once."""
    try:
        before = signal.getsignal(signal.SIGINT)
        if before is None:  # set outside Python, as Blender does: it could not be restored
            raise ValueError

        def stop(number: int, frame: Any) -> None:
            monitor.cancel()
            signal.signal(signal.SIGINT, before)

        signal.signal(signal.SIGINT, stop)
    except ValueError:  # also outside the main thread: the caller owns the signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _quiet_decoders() -> None:
    """Silence the messages of the video decoders: a broken file is reported in one sentence of ours."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    getattr(cv2.utils, "logging", cv2).setLogLevel(0)  # OpenCV 5, OpenCV 4


def _names_of(parser: argparse.ArgumentParser) -> list[str]:
    """The names of the sub-commands."""
    return [name for action in parser._actions if isinstance(action.choices, dict) for name in action.choices]


def _progress_line(stage: str, done: float, total: float) -> None:
    part = min(1.0, done / total) if total else 1.0
    sys.stderr.write(f"\r{stage:<24} [{'#' * round(30 * part):<30}] {100 * part:3.0f} %" + ("\n" if part >= 1 else ""))
    sys.stderr.flush()


def _plain_progress() -> Callable[[str, float, float], None]:
    """A line per tenth of a stage."""
    last: dict[str, int] = {}

    def report(stage: str, done: float, total: float) -> None:
        tenth = int(10 * done / total) if total else 10
        if last.get(stage) != tenth:
            last[stage] = tenth
            _write_line(f"{stage}: {10 * tenth} %", sys.stderr)

    return report


def _write_line(text: str, stream: Any) -> None:
    stream.write(text + "\n")
    stream.flush()
