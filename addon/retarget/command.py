"""`tricap retarget …` and `tricap export …`; importing this module does not need bpy, running the commands mostly does."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...core.cli.arguments import check_not_read, check_simplify, refuse_unused, standard_output_kept_clean
from ...core.foundation import store
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.foundation.settings import from_table
from ...core.results.folder import check_not_result
from ...core.results.outputs import check_replaceable
from ..blender_module import load_blender

FORMAT, PICTURE = "tricap-retarget", "picture"  # of the figures of --report; and their entry with the digest of its picture
# those of programs.py and of core/motion/formats/markers.py, which are imported when a command runs
PROGRAM_NAMES = ("plain", "mixamo", "unreal", "unity", "maya", "motionbuilder", "opensim")
UNITS = ("m", "meters", "metres", "dm", "cm", "mm", "um", "in", "inch")
PLY_FOLDERS = ("skin", "clouds", "tracked")  # of OUT
FORMATS = ("bvh", "mot", "fbx", "glb", "usd", "abc", "trc", "c3d", "csv", "ply")


def add_commands(subparsers: Any) -> None:
    """Add `retarget` and `export` to an argparse sub-parsers object."""
    about = "retarget a motion onto a rig"
    parser: argparse.ArgumentParser = subparsers.add_parser("retarget", help=about, description=about.capitalize())
    parser.add_argument("out", metavar="OUT", type=Path, help="output folder of a run, or a motion: BVH, TRC, C3D, CSV, FBX, glTF, .blend")
    parser.add_argument("--rig", metavar="FILE", type=Path, required=True, help="the rig: .blend, .glb, .gltf, .vrm, .fbx or .bvh")
    parser.add_argument("--out", dest="blend", metavar="FILE.blend", type=Path, required=True, help="the file to write")
    parser.add_argument("--map", metavar="FILE.json", type=Path, help="the mapping of the bones; default: recognised by names and shape")
    parser.add_argument("--armature", metavar="NAME", default="", help="the armature, if the rig's file has several")
    parser.add_argument("--root", choices=("travel", "in place", "still"), default="travel", help="how the body travels")
    parser.add_argument("--feet", choices=("off", "auto", "always"), default="auto", help="when feet are planted on the floor")
    parser.add_argument(
        "--hands",
        choices=("free", "keep"),
        default="free",
        help="keep: hands keep their distance from each other, head, hips and thighs where they are near",
    )
    parser.add_argument(
        "--twist",
        choices=("off", "bones", "forearms"),
        default="bones",
        help="spread twist over twist bones, or half of a hand's also over a forearm that has none",
    )
    parser.add_argument(
        "--scale",
        metavar="F",
        type=float,
        default=0.0,
        help="size of the steps relative to the source's; default: by the length of the legs",
    )
    _add_axes(parser)
    parser.add_argument("--simplify", metavar="DEG", type=float, default=0.0, help="remove keys within this tolerance")
    parser.add_argument("--report", action="store_true", help="also write figures (JSON) and a picture next to FILE.blend")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    parser.set_defaults(run=_clean(retarget))
    about = "export a run's motion or points to another format"
    parser = subparsers.add_parser("export", help=about, description=about.capitalize())
    parser.add_argument("out", metavar="OUT", type=Path, help="output folder of a run, or a motion: BVH, TRC, C3D, CSV, FBX, glTF, .blend")
    parser.add_argument("--format", choices=FORMATS, required=True)
    parser.add_argument("--out", dest="file", metavar="FILE", type=Path, required=True, help="the file to write (for ply: a folder)")
    parser.add_argument("--ply", choices=PLY_FOLDERS, default="", help="which files of ply: skins (default), clouds, or tracked clouds")
    parser.add_argument("--preset", choices=PROGRAM_NAMES, default="plain", help="names, units and axes of a program")
    _add_axes(parser)
    parser.set_defaults(run=_clean(export))


def _clean(run: Callable[[argparse.Namespace, Monitor], list[str]]) -> Callable[[argparse.Namespace, Monitor], list[str]]:
    """A command that keeps Blender's own messages off standard output."""

    def kept_clean(args: argparse.Namespace, monitor: Monitor) -> list[str]:
        with standard_output_kept_clean(args):
            return run(args, monitor)

    return kept_clean


def _add_axes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--up", choices=("Y", "Z"), default="", help="the up axis of a BVH, TRC, C3D or CSV file")
    parser.add_argument("--unit", choices=UNITS, default="", help="the unit of such a file, if not the one stated in it")


def _check_axes(args: argparse.Namespace) -> None:
    """--up and --unit are those of a file that is read and may not state them.

    Raises:
        InputError: it is another file, or the folder of a run.
    """
    if args.out.is_dir() or (args.out.is_file() and args.out.suffix.lower() not in (".bvh", ".trc", ".c3d", ".csv")):
        why = f"is that of a BVH, TRC, C3D or CSV file that is read, and {args.out} is none (--preset chooses what is written)"
        refuse_unused({"--up": bool(args.up), "--unit": bool(args.unit)}, why)


def _need_blender(what: str) -> None:
    if not load_blender():
        raise InputError(f"`tricap {what}` needs Blender: install bpy in this Python, or use `blender --command tricap {what} …`.")


def retarget(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Retarget args.out onto args.rig and save args.blend; the lines to show.

    Raises:
        InputError: there is no Blender in this Python, or the input is invalid.
        Cancelled: the monitor was cancelled; no file was written.
    """
    _need_blender("retarget")
    _check_axes(args)
    import bpy

    from ...core.motion.retarget.contacts import FeetSettings
    from ...core.motion.retarget.mapping import MappedMotion
    from ...core.motion.retarget.retarget import RetargetSettings
    from ..scene.build import save_blend
    from . import apply, files

    if args.blend.suffix != ".blend":
        raise InputError(f"{args.blend.name} is not the name of a Blender file; let it end in .blend.")
    check_simplify(args.simplify)
    check_not_result(args.blend, args.out)
    check_not_read("--out", args.blend, args.rig)
    if args.report:
        check_not_read("--report would overwrite an input:", args.blend.with_suffix(".json"), args.map)
        _check_replaceable_report(args.blend.with_suffix(".json"), args.blend.with_suffix(".png"))
    table = {"root": args.root, "hands": args.hands, "twist": args.twist, "scale": args.scale}
    settings = from_table(RetargetSettings, table, "--root, --hands, --twist, --scale")
    feet = from_table(FeetSettings, {"mode": args.feet}, "--feet")
    motion = files.open_motion(args.out, monitor, up=args.up, unit=args.unit)
    source = MappedMotion(motion=motion, map=apply.map_of(motion.rig, called=f"the motion of {args.out}"))
    files.open_rig(args.rig)
    armature_object = files.the_armature(args.armature, str(args.rig))
    target = apply.read_target(armature_object, args.map)
    result = apply.transfer(source, target, settings, feet, monitor)
    apply.set_range(bpy.context.scene, motion)
    outcome = apply.apply(armature_object, source, target, result, args.out.stem or "Retargeted", args.simplify)
    bpy.context.scene.frame_set(bpy.context.scene.frame_start)
    table = outcome_table(outcome, source.map, target.rig_map)
    if args.report:
        from .picture import draw

        draw(args.blend.with_suffix(".png"), motion, source.map, armature_object, result.motion, target.rig_map)
        picture = store.digest(args.blend.with_suffix(".png"))
        store.write_json(args.blend.with_suffix(".json"), table | {PICTURE: picture})
    kept = save_blend(args.blend)
    if args.json:
        import json

        return [json.dumps(table, indent=1, ensure_ascii=False)]
    return [f"{args.blend}: {outcome.figures}", *(f"Note: {note}" for note in [*outcome.notes, kept] if note)]


def _check_replaceable_report(figures: Path, picture: Path) -> None:
    """Check that the files of a report, if they are there, are of an earlier one; its figures have a digest of its picture.

    Raises:
        InputError: they are not, or the picture was changed.
    """
    check_replaceable(figures, f'{{\n "format": "{FORMAT}"')
    if not figures.exists():
        check_replaceable(picture)
    elif picture.exists() and store.digest(picture) != store.read_json(figures).get(PICTURE, store.digest(picture)):
        raise InputError(f"{picture} would be overwritten, and was changed since; rename it, or choose another name for --out.")


def outcome_table(outcome: Any, source_map: Any, target_map: Any) -> dict[str, Any]:
    """The outcome of a retargeting, as the table of --json and --report. `outcome`: apply.Outcome; maps: RigMap."""
    figures, result = outcome.figures, outcome.result
    return {
        "format": FORMAT,
        "version": 1,
        "frames": figures.frames,
        "keys": outcome.written.keys,
        "scale": result.scale,
        "direction_rms_deg": figures.direction_rms_deg,
        "direction_worst_deg": figures.direction_worst_deg,
        "by_part_deg": figures.by_part_deg,
        "slide_mm": figures.slide_mm,
        "penetration_mm": figures.penetration_mm,
        "float_mm": figures.float_mm,
        "largest_step_deg": figures.largest_step_deg,
        "contacts": figures.contacts,
        "notes": list(outcome.notes),
        "source": {role: list(chain) for role, chain in source_map.bones.items()},
        "target": {role: list(chain) for role, chain in target_map.bones.items()},
        "mapped_by": target_map.origin,
    }


def export(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Write args.file (with the format's ending) in args.format; the lines to show.

    Raises:
        InputError: OUT lacks the data, or the input is invalid.
        Cancelled: the monitor was cancelled.
    """
    _check_axes(args)
    if args.format == "ply":
        refuse_unused({"--preset": args.preset != "plain"}, "changes no PLY files, which are copied as they are")
    from .export import BY_BLENDER, export_file, named_for
    from .programs import is_imported_by_blender

    if args.ply and args.format != "ply":
        raise InputError(f"--ply chooses files of --format ply; leave it out for {args.format}.")
    file = named_for(args.format, args.file, args.out)

    if args.format in BY_BLENDER or is_imported_by_blender(args.out):
        _need_blender("export")
    done = export_file(args.out, args.format, file, args.preset, monitor, up=args.up, unit=args.unit, of=args.ply)
    return [f"{file}: {done}"]
