"""Commands that need Blender, joined with core's in one parser: `python -m tricap scene …`, `blender --command tricap scene …`.

Importing this module does not need bpy; running the command does.
"""

import argparse
import importlib.util
from pathlib import Path
from typing import Any

from ..core.body.fields import EXPONENTIAL, POTENTIALS
from ..core.body.skin.mesh import DETAIL
from ..core.cli.arguments import check_simplify, refuse_unused, standard_output_kept_clean
from ..core.foundation import bounded
from ..core.foundation.errors import InputError
from ..core.foundation.progress import Monitor
from .blender_module import load_blender
from .retarget import command as retargeting

FROM_DEG, TURN_DEG, ELEVATION_DEG = -45.0, 90.0, 12.0  # of the film of a scene: from one side of the cameras to the other
MOST_DEG = {"from": 360.0, "turn": 36_000.0, "elevation": 85.0}  # either way


def main(argv: list[str] | None = None) -> int:
    """Run one command of the `tricap` command line, of the core's or of those that need Blender; its exit code (docs/formats.md)."""
    from ..core.cli import main as commands

    return commands.main(argv, (add_commands, retargeting.add_commands))


def add_commands(subparsers: Any) -> None:
    """Add the sub-command `scene` to an argparse sub-parsers object; its `run(args, monitor)` returns lines to print."""
    if importlib.util.find_spec("bpy") is not None:
        from .movie_sound import movie_sound

        for name in ("synchronise", "calibrate"):
            subparsers.choices[name].set_defaults(movie_sound=movie_sound)
    about = "a Blender file with armature, action, skins, cameras, footage, cloud and trajectories"
    parser: argparse.ArgumentParser = subparsers.add_parser("scene", help=about, description=about)
    parser.add_argument("out", metavar="OUT", type=Path, help="output folder of a run")
    parser.add_argument("--blend", metavar="FILE.blend", type=Path, help="the file to write")
    parser.add_argument("--preview", metavar="FILE.png", type=Path, help="also write a picture: the body shaded, and over the footage")
    parser.add_argument("--turntable", metavar="FILE.mp4", type=Path, help="also write a turntable movie of the body")
    parser.add_argument("--film", metavar="FILE.mp4", type=Path, help="also write a movie of every frame, from a camera of its own")
    degrees = (
        ("--from", "start_deg", FROM_DEG, "where the film's camera begins: degrees around the person, from the middle camera to its right"),
        ("--turn", "turn_deg", TURN_DEG, "degrees by which it circles around the person until the last frame"),
        ("--elevation", "elevation_deg", ELEVATION_DEG, "degrees by which it stands above the person"),
    )
    for flag, name, usual, what in degrees:
        parser.add_argument(flag, dest=name, metavar="DEG", type=float, default=usual, help=f"{what} (default {usual:g})")
    parser.add_argument(
        "--frame", metavar="N", type=int, help="the frame of preview, turntable and implicit surface (default: the middle one)"
    )
    parser.add_argument(
        "--detail",
        metavar="N",
        type=int,
        default=DETAIL,
        choices=range(1, 9),
        help=f"level of detail of the skin, 1 to 8 (default {DETAIL})",
    )
    parser.add_argument(
        "--exact-skin", action="store_true", help="also the skin cast in every frame (0.3 s each), as FILE.pc2 next to the .blend"
    )
    parser.add_argument("--implicit", action="store_true", help="also the implicit surface itself in one frame, for checking")
    parser.add_argument(
        "--field",
        choices=tuple(POTENTIALS),
        default=EXPONENTIAL.name,
        help="the field function of that surface, see `tricap fields` (default: the fitted one)",
    )
    parser.add_argument("--rest-pose", choices=("A", "T"), default="A", help="of the armature (default A)")
    parser.add_argument(
        "--simplify",
        metavar="DEG",
        type=float,
        default=0.0,
        help="play a second action with fewer keys, within this many degrees; the measured one stays in the file",
    )
    parser.add_argument("--colour", choices=("intensity", "sigma", "speed"), default="intensity", help="the colour of the cloud")
    parser.add_argument("--arrows", action="store_true", help="velocities and accelerations as arrows")
    parser.add_argument("--removed", action="store_true", help="also what the filters removed from the trajectories, coloured by reason")
    parser.set_defaults(run=scene)


def scene(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Build the scene of args.out in an empty file, save it as args.blend, and make pictures and movies of it; the lines to show.

    Raises:
        InputError: there is no Blender in this Python, or the input is invalid.
        Cancelled: the monitor was cancelled; no file was written.
    """
    with standard_output_kept_clean(args):
        blender = load_blender()
    if not blender:
        raise InputError(
            "`tricap scene` needs Blender: use `blender --command tricap scene …`, or Python 3.11 or 3.13 with the module bpy."
        )
    with standard_output_kept_clean(args):
        import bpy

        from .scene.build import SceneOptions, write_scene
        from .scene.cameras import look_through
        from .scene.contents import read_contents
        from .scene.movies import film, turntable
        from .scene.preview import preview

        _check(args)
        contents = read_contents(args.out, monitor, skins=args.exact_skin, removed=args.removed)
        first, last = contents.frames
        if args.frame is not None and not first <= args.frame <= last:
            raise InputError(f"--frame {args.frame} is not among the frames {first} to {last}; choose another.")
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        look_through()
        options = SceneOptions(
            detail=args.detail,
            exact_skin=args.exact_skin,
            rest_pose=args.rest_pose,
            simplify_deg=args.simplify,
            colour=args.colour,
            arrows=args.arrows,
            implicit=args.implicit,
            field=args.field,
            frame=args.frame,
        )
        report = write_scene(contents, args.blend, options, monitor)
        if args.preview is not None:
            preview(contents, args.preview, args.frame)
        if args.turntable is not None:
            turntable(args.turntable, args.frame, monitor)
        if args.film is not None:
            film(args.film, monitor, start_deg=args.start_deg, turn_deg=args.turn_deg, elevation_deg=args.elevation_deg)
    written = [str(path) for path in (args.preview, args.turntable, args.film) if path is not None]
    args.always_shown = list(report.warnings)
    return [*report.warnings, *([f"{args.blend}: {report}"] if args.blend is not None else []), *written]


def _check(args: argparse.Namespace) -> None:
    """Check the arguments before anything is read.

    Raises:
        InputError: one of them is invalid.
    """
    check_simplify(args.simplify)
    for name, value in (("from", args.start_deg), ("turn", args.turn_deg), ("elevation", args.elevation_deg)):
        if not abs(value) <= MOST_DEG[name]:  # nor NaN
            raise InputError(f"--{name} {value:g} is out of range; choose an angle of {-MOST_DEG[name]:g} to {MOST_DEG[name]:g} degrees.")
    angles = {"--from": args.start_deg != FROM_DEG, "--turn": args.turn_deg != TURN_DEG, "--elevation": args.elevation_deg != ELEVATION_DEG}
    if args.film is None:
        refuse_unused(angles, "moves the camera of --film, which was not given")
    if not args.implicit:
        refuse_unused({"--field": args.field != EXPONENTIAL.name}, "is the field function of --implicit, which was not given")
    movies = ("--turntable", args.turntable, ".mp4"), ("--film", args.film, ".mp4")
    named = (("--blend", args.blend, ".blend"), ("--preview", args.preview, ".png"), *movies)
    if all(path is None for _, path, _ in named):
        raise InputError("Nothing to write: give --blend FILE.blend, --preview FILE.png, --turntable FILE.mp4 or --film FILE.mp4.")
    _check_skins(args)
    for flag, path, ending in named:
        if path is not None:
            bounded.check_name(bounded.real_path(path.parent) / path.name)
        if path is not None and path.suffix.lower() != ending:
            raise InputError(f"{flag} {path} is not a {ending} file; choose a name that ends in {ending}.")


def _check_skins(args: argparse.Namespace) -> None:
    """Skins next to no such .blend file are not of an earlier scene, unless they lie in OUT."""
    skins = None if args.blend is None or not args.exact_skin else args.blend.with_suffix(".pc2")
    if skins is not None and skins.exists() and not args.blend.exists() and bounded.real_path(skins.parent) != bounded.real_path(args.out):
        raise InputError(f"--exact-skin would overwrite {skins}, which is not of an earlier {args.blend.name}; choose another name.")


def register() -> None:
    """Register `blender --command tricap …`."""
    import bpy

    from .session import get_session

    get_session().cli_command = bpy.utils.register_cli_command("tricap", main)


def unregister() -> None:
    """Unregister it."""
    import bpy

    from .session import get_session

    bpy.utils.unregister_cli_command(get_session().cli_command)
