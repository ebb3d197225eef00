"""`tricap fields --out FILE.svg`: the fields that metaballs can have, side by side (D'Apuzzo et al. 1999, Fig. 12)."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from . import store
from .body.fields import POTENTIALS, THRESHOLD, Potential
from .errors import InputError
from .progress import Monitor
from .report.graphs import HEIGHT, WIDTH, field_graph

FARTHEST = 1.5  # radius of the plot in units of l


def add_command(commands: Any) -> None:
    """Join the command to the parser's sub-commands."""
    about = "a plot of the fields that metaballs can have, with r_t, r_a and w_t"
    parser: argparse.ArgumentParser = commands.add_parser("fields", help=about, description=about[0].upper() + about[1:])
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.svg", help="the picture to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Write the plot; the lines to show are each field's radii.

    Raises:
        InputError: FILE is no .svg, or cannot be written.
    """
    if args.out.suffix.lower() != ".svg":
        raise InputError(f"--out {args.out} is no .svg; the plot of the fields is written as SVG.")
    seen = {name: p.as_seen() for name, p in POTENTIALS.items()}
    graphs = [_graph("Fields of one radius l", POTENTIALS), _graph("The same, as large to the eye as the exponential", seen)]
    second = graphs[1].replace("<svg ", f'<svg y="{2 * HEIGHT}" ', 1)
    head = f'<svg viewBox="0 0 {WIDTH} {4 * HEIGHT}" width="{WIDTH}" height="{4 * HEIGHT}" xmlns="http://www.w3.org/2000/svg">'
    store.write_text(args.out, f"{head}{graphs[0]}{second}</svg>\n")
    rows = [
        f"{name:<12} r_t {p.threshold_radius():.4f} l   r_a {p.influence:.4f} l{' (in name: it never ends)' if p.endless else ''}"
        for name, p in POTENTIALS.items()
    ]
    return [f"{args.out}: {len(rows)} fields, seen where they are w_t = {THRESHOLD:g} of their weight.", *rows]


def _graph(title: str, potentials: dict[str, Potential]) -> str:
    radius = np.linspace(0, FARTHEST, 301)
    return field_graph(
        title,
        radius,
        {name: p.value(radius**2) for name, p in potentials.items()},
        {name: (p.threshold_radius(), p.influence) for name, p in potentials.items()},
        THRESHOLD,
    )
