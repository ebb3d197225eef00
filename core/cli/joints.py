"""`tricap joints TAKE [--write]`: the person's joints in one frame, found without clicks; with `--model`, in every image, by a network."""

import argparse
import json

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..run.joints import joints_of_take, pixels_of, write_joints_as_clicks
from ..run.network_joints import joints_by_file, write_network_joints
from ..take.footage import open_take
from ..take.take import read_take
from ..take.writing import COPIED, has_comments
from .arguments import overrides


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Find the joints, show them in pixels, and write them as clicks where that is asked for and certain.

    Raises:
        InputError: nobody is found; or, with --write, a click is needed to be certain.
    """
    if args.model is not None:
        return _by_network(args, monitor)
    footage, start, settings = joints_of_take(args.take, overrides(args.set), monitor)
    joints, limit = pixels_of(footage, start.xyz_m, start.unsure), settings["fitting"].least_start_probability
    certain = start.probability >= limit
    if args.write and not certain:
        raise InputError(f"Nothing was written. {start.question}")
    commented = has_comments(footage.take.folder)
    written = args.write and write_joints_as_clicks(footage.take.folder, start.frame, joints)
    if args.json:
        table = {
            "frame": start.frame,
            "probability": start.probability,
            "rivals": dict(start.rivals),
            "ask": start.ask,
            "unsure": list(start.unsure),
            "joints": joints,
        }
        return [json.dumps(table, indent=1)]
    rivals = ", ".join(f"{name} {p:.1%}" for name, p in start.rivals.items())
    lines = [f"Frame {start.frame}: {start.probability:.1%} certain" + (f" (otherwise: {rivals})." if rivals else ".")]
    lines += [f"{name:<12}" + "  ".join(f"{view} ({x:.1f}, {y:.1f})" for view, (x, y) in at.items()) for name, at in joints.items()]
    lines += [f"Left to the other frames: {', '.join(start.unsure)}."] if start.unsure else []
    lines += [] if certain else [start.question]
    return [*lines, *([f"{footage.take.folder / 'take.toml'} has them as clicks.{COPIED if commented else ''}"] if written else [])]


def _by_network(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """The joints in every image, by a network; written as [[keypoints]] where that is asked for."""
    take = read_take(args.take)
    found = joints_by_file(open_take(take), args.model, monitor)
    written = write_network_joints(take.folder, found) if args.write else []
    images = found.numbers.shape[1]
    counts = {view: {"points": int(n), "contradicted": int(c)} for view, n, c in zip(found.views, found.found, found.contradicted)}
    if args.json:
        return [json.dumps({"images": images, "names": found.names, "views": counts}, indent=1)]
    lines = [
        f"{view}: {count['points']} of {images * len(found.names)} points in {images} images; "
        f"{count['contradicted']} others were given up, for their rays miss those of other views."
        for view, count in counts.items()
    ]
    return [
        *lines,
        *([f"{take.folder / 'take.toml'} has them as [[keypoints]] ({', '.join(p.name for p in written)})."] if written else []),
    ]
