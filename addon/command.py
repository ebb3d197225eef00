"""Commands that need Blender, joined with core's in one parser: `python -m tricap scene …`, `blender --command tricap scene …`.

Importing this module does not need bpy; running the command does.
"""

import argparse
import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.progress import Monitor

_handles: list[Any] = []


def add_commands(subparsers: Any) -> None:
    """Add the sub-command `scene` to an argparse sub-parsers object; its `run(args, monitor)` returns lines to print."""
    about = "a Blender file with armature, action, skins, cameras, footage, cloud and trajectories"
    parser: argparse.ArgumentParser = subparsers.add_parser("scene", help=about, description=about)
    parser.add_argument("out", metavar="OUT", type=Path, help="output folder of a run")
    parser.add_argument("--blend", metavar="FILE.blend", type=Path, required=True, help="the file to write")
    parser.set_defaults(run=scene)


def scene(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Build the scene of args.out in an empty file and save it as args.blend; the lines to show.

    Raises:
        InputError: there is no Blender in this Python, or the input needs mending.
        Cancelled: the monitor was cancelled; no file was written.
    """
    if importlib.util.find_spec("bpy") is None:
        raise InputError("`tricap scene` needs Blender: install bpy in this Python, or use `blender --command tricap scene …`.")
    with _standard_output_kept_clean():
        import bpy

        from .scene.build import build_scene
        from .scene.cameras import look_through

        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        look_through()
        report = build_scene(args.out, args.blend, monitor)
    return [*report.warnings, f"{args.blend}: {report}"]


@contextmanager
def _standard_output_kept_clean() -> Iterator[None]:
    """Blender itself, below Python, writes notes to standard output; they go to standard error, so that ours can be read by machines."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def register() -> None:
    """Make `blender --command tricap …` known."""
    import bpy

    from ..__main__ import main

    _handles.append(bpy.utils.register_cli_command("tricap", main))


def unregister() -> None:
    """Forget it again."""
    import bpy

    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
