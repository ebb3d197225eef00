"""The commands of the core and their arguments.

A command's module is imported when it runs: help and invalid arguments need neither scipy nor the stages (tests/core/cli/test_start.py).
"""

import argparse
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from ..body.model_file import model_names
from ..foundation.progress import Monitor
from ..images.interlace import BOTH, INTERLACE
from . import streams
from .arguments import DICTIONARY, named_path

# Adds a sub-command to the parser. The command's `run(args, monitor)` returns the lines to show, and sets `args.always_shown` to those
# that --quiet does not suppress: findings and failures.
Adder = Callable[[Any], None]
Action = Callable[[argparse.Namespace, Monitor], list[str]]
RIG_FORMATS = ("agisoft", "anipose", "caliscope", "colmap", "easymocap", "opencv", "openptv", "pose2sim")  # of calibration/rig_files
BOARDS = ("chessboard", "charuco")  # of calibration/boards
LENSES = ("auto", "brown", "fisheye")
WORKERS = 2  # of a batch, by default
RETRIES = 3  # of a take whose worker died; one that dies more often probably lacks memory


def action(module: str, name: str = "run") -> Action:
    """A command's action: the function `name` of a module of this folder, which is imported when the command runs."""

    def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
        lines: list[str] = getattr(importlib.import_module(f".{module}", __package__), name)(args, monitor)
        return lines

    return run


class _Parser(argparse.ArgumentParser):
    """A parser, also of a command, whose help text is written as all output is: argparse ignores a full disk."""

    def print_help(self, file: Any = None) -> None:
        """Write the help text; raises an InputError where that fails."""
        streams.write(self.format_help(), sys.stdout if file is None else file)

    def error(self, message: str) -> NoReturn:
        """As argparse does, but no argument steers the terminal."""
        super().error(streams.visible(message))


def build_parser(adders: tuple[Adder, ...] = ()) -> argparse.ArgumentParser:
    """The parser with all commands, those of the core and those that `adders` add."""
    parser = _Parser(prog="tricap", description="Measure a moving person from the video of calibrated cameras.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    own = _new, _stages, _joints, _synchronise, _check, _calibrate, _track2d, _contour, _compare, _batch, _settings, _fields
    for add in (*own, *adders):
        add(commands)
    for sub in commands.choices.values():
        for argument in sub._actions:
            argument.type = named_path if argument.type is Path else argument.type
        sub.set_defaults(words={argument.dest for argument in sub._actions if argument.choices})  # that name no file
        sub.add_argument("--quiet", action="store_true", help="show errors and findings only")
    return parser


def _command(commands: Any, name: str, about: str, run: Action) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=about, description=about[0].upper() + about[1:])
    parser.set_defaults(run=run, json=False)
    return parser


def _take_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("take", type=Path, metavar="TAKE", help="folder with take.toml")


def _set_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", action="append", default=[], metavar="GROUP.NAME=VALUE", help="a setting, such as matching.patch_px=17")


def _new(commands: Any) -> None:
    new = _command(commands, "new", "make a take from movies or image folders", action("take"))
    new.add_argument("take", type=Path, metavar="TAKE", help="the folder to create")
    new.add_argument("--views", nargs="+", required=True, metavar="NAME=FILE", help="movies or image folders, in the order of the cameras")
    new.add_argument("--interlaced", choices=(*INTERLACE, BOTH), default="none", help="the lines of interlaced video to measure")
    new.add_argument("--fps", type=float, default=None, metavar="F", help="images per second (default: what the movies state, or else 25)")
    new.add_argument("--rig", type=Path, metavar="FILE", help="the cameras: rig.toml, or a calibration of another tool")
    about = (
        f"the body model: {', '.join(model_names())}, your own .toml file, or none (surface and tracks only); "
        "default: the whole person or the upper body, whichever is seen"
    )
    new.add_argument("--model", default=None, metavar="NAME", help=about)


def _stages(commands: Any) -> None:
    """The commands that run stages, and the demo, which runs them on a synthetic take."""
    seeds = _command(commands, "seeds", "count the surface seeds in one frame and show their depths", action("stages", "seeds"))
    measure = _command(commands, "measure", "measure the surface of each frame", action("stages", "measure"))
    track = _command(commands, "track", "track the points of the surface, or chosen points", action("stages", "track"))
    fit = _command(commands, "fit", "fit the body's shape and motion", action("stages", "fit"))
    about = "run all stages, from the images to the Blender file; a stopped run resumes"
    everything = _command(commands, "run", about, action("stages", "run"))
    for parser in (seeds, measure, track, fit, everything):
        _take_argument(parser)
        if parser is not seeds:
            parser.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder for the results")
            parser.add_argument("--json", action="store_true", help="print run.json at the end, and nothing else on standard output")
            parser.add_argument("--frames", metavar="A:B", help="only frames A to B - 1")
            parser.add_argument("--restart", action="store_true", help="start again instead of resuming")
        _set_argument(parser)
        preset = "method.preset={}".format
        about = "the settings that are not set otherwise: the defaults, or the published method"
        parser.add_argument("--preset", dest="set", action="append", type=preset, metavar="default|published", help=about)
        about = "how much to measure: what a body's motion needs (the default), or every point of the surface"
        parser.add_argument(
            "--quality", dest="set", action="append", type="surface.quality={}".format, metavar="motion|surface", help=about
        )
    about = "fit only the 0.4 s around joints whose clicks were added, moved or removed since the fit; the shape stays"
    fit.add_argument("--around-clicks", action="store_true", help=about)
    track.add_argument("--points", type=Path, metavar="FILE", help="track only the points of a CSV: point,view,x,y (two views or more)")
    track.add_argument("--points-frame", type=int, metavar="N", help="the frame in which they were clicked; by default the first")
    track.add_argument("--pictures", type=Path, metavar="DIR", help="with --points: also draw the points and their paths over the images")
    where = everything.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, metavar="N", help="processes that measure frames at once (default: one for every core)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler, such as tcp://farm:8786, whose workers measure frames")
    everything.add_argument("--pictures", nargs="+", type=int, default=[], metavar="FRAME", help="frames to show in the report")
    everything.add_argument(
        "--film",
        action="store_true",
        help="also write film.mp4, the body over every frame of every view, and scene.mp4, from a camera of its own",
    )
    demo = _command(
        commands, "demo", "make a synthetic recording, run all stages on it, and compare with the truth", action("stages", "demo")
    )
    demo.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder for the recording and the results")
    about = "a setting, such as matching.patch_px=17, or of the recording: sample.noise=2, sample.texture=0.3, sample.seed=7"
    demo.add_argument("--set", action="append", default=[], metavar="GROUP.NAME=VALUE", help=about)


def _joints(commands: Any) -> None:
    joints = _command(commands, "joints", "find the person's joints in one frame, without clicks", action("joints"))
    _take_argument(joints)
    joints.add_argument("--model", type=Path, metavar="FILE.onnx", help="find them in every image with a pose network of your own")
    about = "write them into take.toml: as clicks, where they are certain; those of a network as [[keypoints]]"
    joints.add_argument("--write", action="store_true", help=about)
    joints.add_argument("--json", action="store_true", help="print them as JSON")
    _set_argument(joints)


def _synchronise(commands: Any) -> None:
    about = "when each view began: by sound (NAME.wav; in Blender the movie's own), light or time codes, then by rays of moving points"
    parser = _command(commands, "synchronise", about, action("synchronise"))
    _take_argument(parser)
    parser.add_argument("--write", action="store_true", help="write the starts into take.toml, if all were found")
    parser.add_argument("--json", action="store_true", help="print them as JSON")
    parser.set_defaults(movie_sound=None)  # the add-on's command reads that of movies


def _check(commands: Any) -> None:
    check = _command(commands, "check", "what is wrong or doubtful about a take, a rig or a result, and what to do", action("check"))
    check.add_argument("subject", type=Path, metavar="TAKE|OUT|RIG", help="folder of a take or of a run, or rig.toml")
    check.add_argument("--json", action="store_true", help="print the findings and figures as JSON")


def _calibrate(commands: Any) -> None:
    about = "a rig from the images of a waved bar or of a printed board, or from another tool's calibration"
    parser = _command(commands, "calibrate", about, action("calibrate"))
    parser.add_argument("bar", nargs="?", type=Path, metavar="BARDIR", help="folder with a folder of images, or a movie, per camera")
    parser.add_argument("--bar-length", type=float, metavar="M", help="distance between the middles of the bar's targets in metres")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the rig to write, such as rig.toml")
    parser.add_argument("--board", choices=BOARDS, help="the images show a board instead of a bar")
    about = "with --bar-length: a folder like BARDIR of the board, filmed by the same cameras; both go into one adjustment"
    parser.add_argument("--with-board", type=Path, metavar="DIR", help=about)
    about = "with --with-board: the cameras were moved between the films, or filmed the board one after another; it gives their lenses only"
    parser.add_argument("--lenses-only", action="store_true", help=about)
    parser.add_argument("--squares", metavar="9x6", help="across and down: inner corners of a chessboard, squares of a ChArUco board")
    parser.add_argument("--square", type=float, metavar="M", help="side of a square in metres, as measured on the print")
    parser.add_argument("--dictionary", default=DICTIONARY, metavar="NAME", help="OpenCV's name of the markers of a ChArUco board")
    parser.add_argument("--marker", type=float, metavar="M", help="side of a marker in metres; three quarters of a square")
    about = "the model of the lenses; auto: the one that fits the images, with a board that of each camera"
    parser.add_argument("--lens", choices=LENSES, default="auto", help=about)
    parser.add_argument("--print", dest="printed", type=Path, metavar="FILE", help="write the board as .pdf or .png for a printer")
    about = "images per second (30, or L=24,C=30,R=60); finds when each view began: by sound (NAME.wav; in Blender the movie's), light, …"
    parser.add_argument("--synchronise", metavar="F", help=about)
    parser.add_argument(
        "--rates", metavar="L=24,…", help="images per second of each view, if they differ, of films that begin at the same instant"
    )
    parser.set_defaults(movie_sound=None, started=[])  # the add-on's command reads that of movies
    parser.add_argument("--focal-px", type=float, metavar="F", help="rough focal length in pixels, if known")
    parser.add_argument(
        "--interlaced",
        choices=(*INTERLACE, BOTH),
        default="none",
        help="the lines of interlaced video to use; both: two frames per image, one of the odd lines and one of the even lines",
    )
    parser.add_argument("--first-field", choices=("odd", "even"), default="odd", help="with both: the lines that were exposed first")
    parser.add_argument(
        "--mask", type=Path, metavar="PATH", help="image that is black where no target can be, or a folder of them named like the cameras"
    )
    parser.add_argument("--target-diameter", type=float, metavar="M", help="diameter of the bar's targets in metres, if known")
    parser.add_argument("--floor", metavar="A,B,…", help="frames in which the bar or board lies on the floor, which becomes z = 0")
    parser.add_argument("--level", metavar="A,B,…", help="frames in which the bar or board is held level")
    parser.add_argument(
        "--points",
        type=Path,
        metavar="FILE",
        help="CSV of point,view,x,y: the pixels of “origin”, “x” and “y”, which become the world's origin and axes",
    )
    parser.add_argument("--like", type=Path, metavar="RIG", help="put the cameras where those of the same names stand in this rig.toml")
    parser.add_argument("--report", type=Path, metavar="DIR", help="folder for the report: text, JSON, pictures")
    parser.add_argument("--import", dest="source", type=Path, metavar="FILE", help="read another tool's calibration instead of images")
    parser.add_argument("--export", dest="format", choices=RIG_FORMATS, help="write the rig in another tool's format")
    parser.add_argument("--json", action="store_true", help="print the figures")


def _track2d(commands: Any) -> None:
    about = "the 2-D mode: track chosen points through the images of one camera"
    parser = _command(commands, "track2d", about, action("track2d"))
    parser.add_argument("sequence", type=Path, metavar="SEQUENCE", help="a movie, or a folder of images")
    parser.add_argument("--points", type=Path, required=True, metavar="FILE", help="CSV with point,x,y in the first frame (and joined_to)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="CSV to write: frame,point,x,y,sigma,correlation,status")
    parser.add_argument("--frames", metavar="A:B", help="only frames A to B - 1; the points are those of frame A")
    parser.add_argument("--interlaced", choices=INTERLACE, default="none", help="which lines of interlaced video to use")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="also draw the named points, joined with lines, over the images")
    _set_argument(parser)


def _contour(commands: Any) -> None:
    about = "the outline of the person in one view, tracked through the frames"
    parser = _command(commands, "contour", about, action("contour"))
    _take_argument(parser)
    parser.add_argument("--view", required=True, nargs="+", metavar="NAME", help="the view, such as C, or several")
    parser.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder for the results; contours/NAME.csv is written")
    parser.add_argument("--frames", metavar="A:B", help="only frames A to B - 1")
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--polygon", type=Path, metavar="FILE", help="CSV with x,y of the outline in the first frame")
    start.add_argument("--background", type=Path, metavar="FILE", help="image of the view without the person")
    start.add_argument("--from-body", action="store_true", help="start from the outline of the body that was fitted in OUT")
    _set_argument(parser)


def _compare(commands: Any) -> None:
    parser = _command(commands, "compare", "run the published and the default method on a take, and compare them", action("compare"))
    _take_argument(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for compare.html and both results")
    parser.add_argument("--frames", metavar="A:B", help="only frames A to B - 1")
    _set_argument(parser)
    parser.add_argument("--restart", action="store_true", help="start again instead of resuming")
    parser.add_argument("--json", action="store_true", help="print the measures as JSON, and nothing else on standard output")


def _batch(commands: Any) -> None:
    about = "run many takes, on the processors of this machine or on a Dask cluster"
    parser = _command(commands, "batch", about, action("batch"))
    parser.add_argument("takes", type=Path, nargs="+", metavar="TAKE", help="folders with take.toml")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results; each take gets one in it")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler, such as tcp://farm:8786; its workers need Tricap")
    where.add_argument("--workers", type=int, default=WORKERS, metavar="N", help=f"processes on this machine (default {WORKERS})")
    parser.add_argument(
        "--retries", type=int, default=RETRIES, metavar="N", help=f"retries of a take whose worker dies (default {RETRIES})"
    )
    parser.add_argument("--restart", action="store_true", help="start every take again instead of resuming")
    _set_argument(parser)
    parser.add_argument("--json", action="store_true", help="print the outcomes as JSON, and nothing else on standard output")


def _settings(commands: Any) -> None:
    parser = _command(commands, "settings", "list all settings for --set and take.toml, with defaults and limits", action("settings"))
    parser.add_argument("group", nargs="?", metavar="GROUP", help="those of a group alone, such as fitting")


def _fields(commands: Any) -> None:
    about = "plot the field functions of metaballs, with r_t, r_a and w_t"
    parser = _command(commands, "fields", about, action("fields"))
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.svg", help="the picture to write")
