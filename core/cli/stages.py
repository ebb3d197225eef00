"""`tricap seeds, measure, track, fit, run, demo`: the stages of a run."""

import argparse
import importlib.util
import json

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.settings import from_table
from ..report.film import write_film
from ..results import blend_file, films
from ..results.folder import Results, check_separate_folder
from ..results.own_files import CACHE
from ..results.run_json import UNTIL, notes_of
from ..run import pipeline, take_run
from ..run.around_clicks import fit_around_clicks
from ..run.engine import Engine, of_this_machine
from ..run.settings import settings_of
from ..surface.resolution import measured_footage, person_seen
from ..surface.starts import MeasureSettings, first_frame, first_seeds
from ..synthetic.arm import PERSON, ArmTakeSettings, is_arm_take, make_arm_take
from ..synthetic.score import score_run
from ..take.footage import open_take
from ..take.take import read_take
from . import points
from .arguments import frame_range, overrides, refuse_unused

MOST_ASKED = 1000  # workers


def seeds(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """The surface seeds of one frame."""
    take = read_take(args.take)
    settings = settings_of(take.settings, overrides(args.set), str(args.take))
    footage = open_take(take, click_sigma_px=settings["fitting"].click_sigma_px)
    measuring = MeasureSettings.of(settings)
    person = person_seen(footage, measuring, monitor)
    measured = measured_footage(footage, measuring, person.distance_m if person else None)
    frame = first_frame(measured)
    where, found = first_seeds(measured, measuring, frame, monitor)
    near, far = where.depth_range_m
    args.always_shown = [
        f"Frame {frame}: {len(found.depth_m)} surface seeds between {near:.2f} and {far:.2f} m (depths from {where.method}), "
        f"{len(footage.take.clicks.joints)} clicked joints, {len(where.planes)} planes of the room excluded."
    ]
    return list(args.always_shown)


def measure(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """The surface of every frame."""
    return _stages(("measure",), args, monitor)


def track(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """The trajectories of the surface's points, or of points that the user chose."""
    if args.pictures is not None and not args.points:
        raise InputError("--pictures draws the points of --points; without them, `tricap run` has pictures of the tracks in its report.")
    if not args.points:
        refuse_unused({"--points-frame": args.points_frame is not None}, "is the frame of --points, which were not given")
    return points.run(args, monitor) if args.points else _stages(("measure", "track"), args, monitor)


def fit(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """The body's shape and motion, or the motion around new clicks alone."""
    return _fit_around_clicks(args, monitor) if args.around_clicks else _stages(("fit",), args, monitor)


def _fit_around_clicks(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    refuse_unused({"--restart": args.restart}, "is of a whole fit, and --around-clicks keeps one")
    if not (args.out / "body.toml").is_file():
        raise InputError(f"There is no fitted body in {args.out}; fit all frames first, without --around-clicks.")
    found = fit_around_clicks(args.take, args.out, overrides(args.set), monitor, frame_range(args.frames))
    if found is None:
        raise InputError(
            "More than the clicks of fitted frames has changed since the body was fitted (or it was with other --frames or --set); fit all "
            "frames, without --around-clicks."
        )
    if args.json:
        return [json.dumps(Results(args.out).read_run(), indent=1, ensure_ascii=False)]
    return [f"{args.out}: {found} `tricap scene` builds the Blender file anew; a whole fit also adjusts the shape and renews the report."]


def _stages(names: tuple[str, ...], args: argparse.Namespace, monitor: Monitor) -> list[str]:
    given = args.take, args.out, overrides(args.set), frame_range(args.frames)
    with take_run.open_run(*given, restart=args.restart, spares=True) as job:
        job.engine, job.record[UNTIL] = of_this_machine(), names[-1]
        for name in names:
            getattr(pipeline, name)(job, monitor)
        return _summary(job, args.json)


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """All stages, from the images to the Blender file; the lines to show."""
    given, engine = (args.take, args.out, overrides(args.set), frame_range(args.frames)), _engine(args)
    with take_run.open_run(*given, restart=args.restart, spares=True, pictures=args.pictures) as job:
        if not args.pictures and pipeline.is_complete(job):
            job.record["warnings"] = job.results.read_run().get("warnings", [])
            unchanged = "Nothing has changed since that run; --restart begins anew."
            lines = [unchanged] if _has_scene(job, args) else _build_scene(job, args, monitor)
        else:
            job.engine = engine
            pipeline.all_stages(job, monitor)
            lines = _build_scene(job, args, monitor)
        if args.film:
            lines += _films(job, args, monitor)
        return _summary(job, args.json) + ([] if args.json else lines)


def demo(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Make a synthetic recording, of a whole person unless `sample.subject` says otherwise, run all stages, and compare with the truth."""
    take, out, given = args.out / "take", args.out, overrides(args.set)
    sample: ArmTakeSettings = from_table(ArmTakeSettings, {"subject": PERSON, **given.pop("sample", {})}, "[sample]")
    settings_of({}, given, "")
    check_separate_folder(out)
    if not is_arm_take(take, sample):
        make_arm_take(take, sample, monitor)
    job = pipeline.run(take, out, given, monitor, engine=of_this_machine())
    lines, blend = _build_scene(job, args, monitor), out / blend_file.BLEND
    return [
        str(job),
        *(f"Note: {sentence}" for sentence in job.notes),
        *lines,
        *([] if blend.is_file() else [f"Note: {sentence}" for sentence in job.record["warnings"][-1:]]),
        "Compared with the truth of the recording:",
        str(score_run(take, out, monitor)),
        f"Pictures: {out / 'report'}   Report: {out / 'report' / 'report.html'}" + (f"   Blender file: {blend}" if blend.is_file() else ""),
    ]


def _engine(args: argparse.Namespace) -> Engine | None:
    """Where the frames are measured; None: in this process alone."""
    if args.workers is not None and not 1 <= args.workers <= MOST_ASKED:
        raise InputError(f"--workers {args.workers} is out of range; write 1 to {MOST_ASKED}.")
    if args.scheduler is not None:
        return Engine(scheduler=args.scheduler)
    if args.workers is None:
        return of_this_machine()
    return Engine(workers=args.workers) if args.workers > 1 else None


def _has_scene(job: take_run.Run, given: argparse.Namespace) -> bool:
    """Whether body.blend is there and whole, or cannot be made by this command."""
    without = "scene" not in _names_of(given.parser) or importlib.util.find_spec("bpy") is None
    return without or blend_file.is_whole(job.results.path(blend_file.BLEND))


def _build_scene(job: take_run.Run, given: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Build body.blend with the add-on's command `scene`, where Blender is available."""
    blend = job.results.path(blend_file.BLEND)
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


def _films(job: take_run.Run, given: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Write the films that are missing: over every frame of every view, and where Blender is available, of the scene."""
    lines, folder = [], job.results.folder
    films.check_ours(folder, job.results.read_run())
    if not (folder / films.FILM).is_file():
        lines.append(f"Film: {write_film(job.footage, job.results, monitor)}")
    if "scene" in _names_of(given.parser) and importlib.util.find_spec("bpy") is not None and not (folder / films.SCENE_FILM).is_file():
        part = folder / CACHE / films.SCENE_FILM
        args = given.parser.parse_args(["scene", str(folder), "--film", str(part), *(["--quiet"] if given.quiet else [])])
        args.run(args, monitor)
        lines.append(f"Film of the scene: {films.place(part, folder, films.SCENE_FILM)}")
    return lines


def _summary(job: take_run.Run, as_json: bool) -> list[str]:
    if as_json:
        run = job.results.read_run()
        return [json.dumps({**run, "warnings": [*run["warnings"], *job.notes]}, indent=1, ensure_ascii=False)]
    notes = [*notes_of(job.record), *job.record["warnings"], *job.notes]
    return [f"{job.results.folder}: {job}", *(f"Note: {sentence}" for sentence in notes)]


def _names_of(parser: argparse.ArgumentParser) -> list[str]:
    """The names of the sub-commands."""
    return [name for action in parser._actions if isinstance(action.choices, dict) for name in action.choices]
