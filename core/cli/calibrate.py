"""`tricap calibrate`: a rig from the images of a waved bar or of a board, or from another tool's calibration; and boards to print."""

import argparse
import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

from ..calibration import report
from ..calibration.bars import BarObservations
from ..calibration.boards.board import Board, BoardKind, Lens, write_board
from ..calibration.boards.footage import measure_boards
from ..calibration.boards.observations import BoardObservations
from ..calibration.calibrate import Start, Starts, calibrate_rig, check_report, measure_bar, open_bar, open_boards, write_report
from ..calibration.rig_files import FOLDERS, check_place, lens_note, read_any, write_as
from ..calibration.together import BarAndBoard, check_names
from ..calibration.world_frame import WorldChoice, frame_like, frame_of_clicks
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.rig import Rig, read_rig, write_rig
from ..images.interlace import BOTH
from ..images.sequence import MOVIE_ENDINGS, ImageSequence, movie_rate
from ..results.outputs import check_output, check_replaceable
from ..take.bar_file import STARTS, bar_path, write_bar
from ..tracking.point_tables import read_points
from .arguments import DICTIONARY, check_not_read, refuse_unused

RIG = ".toml"  # of a rig of our own: by its ending it is read again
SAME_RATE = 0.0005  # relative difference of films' rates: an image in half a minute


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Calibrate or convert; the lines to show.

    Raises:
        InputError: the arguments or the recording are faulty.
    """
    board = _board(args)
    if args.printed is not None:
        return _print(args, board)
    if (args.bar is None) == (args.source is None):
        raise InputError("Give either the folder of the images of the bar or board, or --import with another tool's calibration.")
    if args.out is None:
        raise InputError("Give --out with the rig to write, such as --out rig.toml.")
    if not args.format and args.out.suffix.lower() != RIG and not args.out.is_dir():
        raise InputError(f"--out {args.out} must end in {RIG}; for another tool's format give --export.")
    return _convert(args) if args.source is not None else _calibrate(args, board, monitor)


def _board(args: argparse.Namespace) -> Board | None:
    """The board that was described, or None for a bar."""
    if args.board is None:
        if args.squares or args.square or args.marker is not None or args.printed:
            raise InputError("--squares, --square, --marker and --print describe a board; give --board chessboard or --board charuco, too.")
        refuse_unused({"--dictionary": args.dictionary != DICTIONARY}, "describes the markers of --board charuco, which was not given")
        if args.with_board is not None:
            raise InputError("--with-board needs the board; give --board chessboard or --board charuco, --squares and --square.")
    if args.lenses_only and args.with_board is None:
        raise InputError("--lenses-only belongs to --with-board, the folder of the films of the board.")
    return None if args.board is None else _described(args)


def _described(args: argparse.Namespace) -> Board:
    """The board of --board.

    Raises:
        InputError: its description is faulty, or options of a bar were given without a bar.
    """
    for given, flag in ((args.bar_length, "--bar-length"), (args.target_diameter, "--target-diameter"), (args.mask, "--mask")):
        if given is not None and args.with_board is None:
            raise InputError(f"{flag} belongs to a bar, and --board was given; leave one of them out.")
    if args.interlaced != "none" and args.with_board is None:
        raise InputError("Boards are measured in whole images; leave out --interlaced, or calibrate interlaced cameras with a bar.")
    if args.board != BoardKind.CHARUCO:
        markers = {"--marker": args.marker is not None, "--dictionary": args.dictionary != DICTIONARY}
        refuse_unused(markers, "describes the markers of --board charuco, and a chessboard has none")
    if args.marker == 0:
        raise InputError("--marker 0 is no side of a marker; give it in metres, or leave it out for three quarters of a square.")
    numbers = re.fullmatch(r"(\d{1,3})[x×](\d{1,3})", args.squares or "")
    if numbers is None or args.square is None:
        raise InputError("Describe the board with --squares, such as 9x6, and --square, the side of a square in metres, such as 0.03.")
    across, down = (int(n) for n in numbers.groups())
    return Board(
        kind=BoardKind(args.board), squares=(across, down), square_m=args.square, dictionary=args.dictionary, marker_m=args.marker or 0.0
    )


def _print(args: argparse.Namespace, board: Board | None) -> list[str]:
    if board is None or args.bar is not None or args.source is not None:
        raise InputError("--print writes a board only; calibrate in a second call, when it is printed.")
    refuse_unused(
        {"--out": args.out is not None, "--report": args.report is not None}, "belongs to a calibration, and --print writes a board"
    )
    write_board(args.printed, board)
    return [
        f"{args.printed}: a {board.kind.value} of {board.label}. "
        "Print it without scaling, glue it to a flat plate, and measure its squares."
    ]


def _refuse_images_options(args: argparse.Namespace) -> None:
    """Refuse what describes the images or the adjustment of a calibration, where another tool's is converted.

    Raises:
        InputError: there is such an option.
    """
    absent = ("board", "report", "mask", "bar_length", "target_diameter", "focal_px", "with_board", "synchronise", "rates")
    usual = {"interlaced": "none", "first_field": "odd", "lens": "auto"}
    values = {name: vars(args)[name] != usual.get(name) for name in (*absent, *usual)}
    flags = {f"--{name.replace('_', '-')}": given for name, given in values.items()}
    refuse_unused(flags, "belongs to a calibration from images, and not to --import")


def _convert(args: argparse.Namespace) -> list[str]:
    _refuse_images_options(args)
    if args.format:
        check_not_read("--out", args.out, args.source)
        if any(args.source.match(name) for name in FOLDERS.get(args.format, ())):
            check_not_read("--out", args.out, args.source.parent)
    rig = read_any(args.source)
    world = _world(args)
    if world.floor_frames or world.level_frames:
        raise InputError("--floor and --level need the bar's images; with --import give --points or --like.")
    if world.points or world.like:
        frame = frame_like(rig.cameras, world.like.cameras) if world.like else frame_of_clicks(rig.cameras, world.points)
        rig = replace(rig, cameras=tuple(map(frame.camera, rig.cameras)), metadata={**rig.metadata, "floor": world.on_floor})
    written = write_as(args.out, rig, args.format) if args.format else [args.out]
    if not args.format:
        write_rig(args.out, rig)
    lines = [f"{', '.join(map(str, written))}: {len(rig.cameras)} cameras ({', '.join(c.name for c in rig.cameras)}) from {args.source}."]
    if "scale" in rig.metadata:
        lines.append(f"The scale of {args.source}: {rig.metadata['scale']}.")
    return [*lines, *rig.remarks, *_lens_notes(args, rig)]


def _lens_notes(args: argparse.Namespace, rig: Rig) -> list[str]:
    note = lens_note(args.out, rig, args.format) if args.format else ""
    return [note] if note else []


def _calibrate(args: argparse.Namespace, board: Board | None, monitor: Monitor) -> list[str]:
    if (board is None or args.with_board is not None) and args.bar_length is None:
        raise InputError(
            "The bar's length is missing; give --bar-length with the distance between its two targets in metres, or --board with --squares "
            "and --square."
        )
    if args.interlaced != BOTH:
        refuse_unused({"--first-field": args.first_field != "odd"}, "belongs to --interlaced both")
    if args.focal_px is not None and not 10 < args.focal_px < 1e6:
        raise InputError(f"--focal-px is {args.focal_px:g}; give the focal length in pixels, such as 1200, or leave it out.")
    if not args.format and args.out.is_dir():
        raise InputError(f"--out {args.out} is a folder; give the file of the rig to write, such as {args.out / 'rig.toml'}.")
    if not args.format and (board is None or args.with_board is not None):
        check_output(bar_path(args.out), [path for path in (args.points, args.like) if path is not None])
        check_replaceable(bar_path(args.out), *STARTS)
    if args.report:
        check_report(args.report)
    if args.format:
        check_place(args.out, args.format)
    world = _world(args)
    result = calibrate_rig(_observed(args, board, monitor), monitor, focal_px=args.focal_px, lens=Lens(args.lens), world=world)
    written = [args.out]
    if args.report:
        written += write_report(args.report, result)[:1]
    if args.format:
        write_as(args.out, result.rig, args.format)
    else:
        write_rig(args.out, result.rig)
        if isinstance(result.calibration.observations, BarObservations):
            written.append(write_bar(args.out, result.rig, *result.bar))
    if args.json:
        figures = report.figures(result.calibration, result.quality, result.verdict)
        figures["remarks"] += [*args.started, *_lens_notes(args, result.rig)]
        return [json.dumps(figures, indent=1, ensure_ascii=False)]
    remarks = [f"{line[0].upper()}{line[1:]}." for line in result.calibration.remarks]
    return [
        *args.started,
        result.verdict.sentence,
        f"To improve: {result.verdict.advice}.",
        *remarks,
        *_lens_notes(args, result.rig),
        f"Written: {', '.join(map(str, written))}",
    ]


def _observed(args: argparse.Namespace, board: Board | None, monitor: Monitor) -> BarObservations | BoardObservations | BarAndBoard:
    starts = _starts(args, monitor, args.bar)
    if board is not None and args.with_board is None:
        return measure_boards(open_boards(args.bar, starts), board, monitor)
    footage = open_bar(args.bar, args.interlaced, args.mask, args.first_field, starts)
    if board is None:
        return measure_bar(footage, args.bar_length, monitor, diameter_m=args.target_diameter).observations
    boards = open_boards(args.with_board, _starts(args, monitor, args.with_board), together=not args.lenses_only)
    check_names(footage.names, boards.names)
    return BarAndBoard(
        bars=measure_bar(footage, args.bar_length, monitor, diameter_m=args.target_diameter).observations,
        boards=measure_boards(boards, board, monitor),
        lenses_only=args.lenses_only,
    )


def _starts(args: argparse.Namespace, monitor: Monitor, folder: Path) -> Starts | None:
    """Finds what belongs together in the films of a folder; None where images of the same number do."""
    if args.synchronise is not None and args.rates is not None:
        raise InputError("Give the rates with --synchronise, such as --synchronise L=24,C=30,R=60, or with --rates, not with both.")
    if args.synchronise is None and args.rates is None:
        args.started = [*args.started, *_other_rates(folder)]
        return None
    return partial(_start, args, monitor, folder)


def _other_rates(folder: Path) -> list[str]:
    """A sentence where the films in a folder state different rates, and their images are taken to belong together one by one."""
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    films = [path for path in paths if path.suffix.lower() in MOVIE_ENDINGS and path.name[0] != "."]
    rates = {path.stem: rate for path in films if (rate := movie_rate(path)) > 0}
    if not rates or max(rates.values()) <= (1 + SAME_RATE) * min(rates.values()):
        return []
    stated = ", ".join(f"{name} {rate:.5g}" for name, rate in rates.items())
    return [
        f"The films in {folder} state different rates ({stated} images per second), but are taken image by image. If these are true, give "
        f"--rates {','.join(f'{name}={rate:.5g}' for name, rate in rates.items())}, or --synchronise with them."
    ]


def _start(args: argparse.Namespace, monitor: Monitor, folder: Path, names: tuple[str, ...], sequences: tuple[ImageSequence, ...]) -> Start:
    from ..synchronising.bar_and_board import common_start

    if args.rates is not None and "=" not in args.rates:
        raise InputError(f"--rates is {args.rates}; give the images per second of each view, such as L=24,C=30,R=60.")
    by_sound = args.synchronise is not None
    rates = str(args.synchronise if by_sound else args.rates)
    start, timings = common_start(folder, names, sequences, rates, monitor, args.movie_sound, by_sound)
    args.started = [*args.started, *(str(timing) for timing in timings)]
    return start


def _world(args: argparse.Namespace) -> WorldChoice:
    points: dict[str, dict[str, list[float]]] = {}
    if args.points is not None:
        table = read_points(args.points, with_views=True)
        for name, view, xy in zip(table.names, table.views, table.xy_px.tolist()):
            points.setdefault(name, {})[view] = xy
    like = None if args.like is None else read_rig(args.like)
    return WorldChoice(floor_frames=_frames(args.floor, "--floor"), level_frames=_frames(args.level, "--level"), points=points, like=like)


def _frames(text: str | None, flag: str) -> tuple[int, ...]:
    if not text:
        return ()
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{flag} {text} cannot be read; write frame numbers, such as 0,40,80.") from error
