"""`tricap calibrate`: a rig from the images of a waved bar, or from another tool's calibration."""

import argparse
import json
from dataclasses import replace

from ..calibration import report
from ..calibration.calibrate import calibrate_rig, measure_bar, open_bar, write_report
from ..calibration.rig_files import read_any, write_as
from ..calibration.world_frame import WorldChoice, frame_like, frame_of_clicks
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.rig import read_rig, write_rig
from ..take.bar_file import write_bar
from ..tracking.point_tables import read_points
from .arguments import check_not_read


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Calibrate or convert; the lines to show.

    Raises:
        InputError: the arguments or the recording are faulty.
    """
    if (args.bar is None) == (args.source is None):
        raise InputError("Give either the folder of the bar's images, or --import with another tool's calibration.")
    return _convert(args) if args.source is not None else _calibrate(args, monitor)


def _convert(args: argparse.Namespace) -> list[str]:
    if args.format:
        check_not_read("--out", args.out, args.source)
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
    return [*lines, f"The scale of {args.source}: {rig.metadata['scale']}."] if "scale" in rig.metadata else lines


def _calibrate(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    if args.bar_length is None:
        raise InputError("The bar's length is missing; give --bar-length with the distance between its two targets in metres.")
    if args.focal_px is not None and not 10 < args.focal_px < 1e6:
        raise InputError(f"--focal-px is {args.focal_px:g}; give the focal length in pixels, such as 1200, or leave it out.")
    if not args.format and args.out.is_dir():
        raise InputError(f"--out {args.out} is a folder; give the file of the rig to write, such as {args.out / 'rig.toml'}.")
    world = _world(args)
    footage = open_bar(args.bar, args.interlaced, args.mask, args.first_field)
    measured = measure_bar(footage, args.bar_length, monitor, diameter_m=args.target_diameter)
    result = calibrate_rig(measured.observations, monitor, focal_px=args.focal_px, world=world)
    written = [args.out]
    if args.report:
        written += write_report(args.report, result)[:1]
    if args.format:
        write_as(args.out, result.rig, args.format)
    else:
        write_rig(args.out, result.rig)
        written.append(write_bar(args.out, result.rig, *result.bar))
    if args.json:
        return [json.dumps(report.figures(result.calibration, result.quality, result.verdict), indent=1, ensure_ascii=False)]
    return [result.verdict.sentence, f"To improve: {result.verdict.advice}.", f"Written: {', '.join(map(str, written))}"]


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
