"""`tricap joints TAKE [--write]`: the person's joints in one frame, found without clicks."""

import argparse
import json

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..run.joints import joints_of_take, pixels_of, write_joints_as_clicks
from .arguments import overrides


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Find the joints, show them in pixels, and write them as clicks where that is asked for and certain.

    Raises:
        InputError: nobody is found; or, with --write, a click is needed to be certain.
    """
    footage, start, settings = joints_of_take(args.take, overrides(args.set), monitor)
    joints, limit = pixels_of(footage, start), settings["fitting"].least_start_probability
    certain = start.probability >= limit
    if args.write and not certain:
        raise InputError(f"Nothing was written. {start.question}")
    written = args.write and write_joints_as_clicks(footage.take.folder, start.frame, joints)
    if args.json:
        table = {"frame": start.frame, "probability": start.probability, "rivals": dict(start.rivals), "ask": start.ask, "joints": joints}
        return [json.dumps(table, indent=1)]
    rivals = ", ".join(f"{name} {p:.1%}" for name, p in start.rivals.items())
    lines = [f"Frame {start.frame}: {start.probability:.1%} certain" + (f" (otherwise: {rivals})." if rivals else ".")]
    lines += [f"{name:<12}" + "  ".join(f"{view} ({x:.1f}, {y:.1f})" for view, (x, y) in at.items()) for name, at in joints.items()]
    lines += [] if certain else [start.question]
    return [*lines, *([f"{footage.take.folder / 'take.toml'} has them as clicks."] if written else [])]
