"""`tricap fields --out FILE.svg`: a plot of the field functions of metaballs (D'Apuzzo et al. 1999, Fig. 12)."""

import argparse

import numpy as np

from ..body.fields import POTENTIALS, THRESHOLD, Potential
from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..report.graphs import HEIGHT, WIDTH, field_graph

PLOT_RADIUS = 1.5  # in units of l
SAMPLES = 301


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Write the plot; returns lines with the radii of each field.

    Raises:
        InputError: FILE is not an .svg, or cannot be written.
    """
    if args.out.suffix.lower() != ".svg":
        raise InputError(f"--out {args.out} is not an .svg file; choose a name that ends in .svg.")
    same_size = {name: p.of_visible_size() for name, p in POTENTIALS.items()}
    graphs = [_graph("Fields of one radius l", POTENTIALS), _graph("The same, with the surface of the exponential", same_size)]
    second = graphs[1].replace("<svg ", f'<svg y="{2 * HEIGHT}" ', 1)
    head = f'<svg viewBox="0 0 {WIDTH} {4 * HEIGHT}" width="{WIDTH}" height="{4 * HEIGHT}" xmlns="http://www.w3.org/2000/svg">'
    store.write_text(args.out, f"{head}{graphs[0]}{second}</svg>\n")
    rows = [
        f"{name:<12} r_t {p.threshold_radius():.4f} l   r_a {p.influence:.4f} l{' (nominal: the field is never 0)' if p.endless else ''}"
        for name, p in POTENTIALS.items()
    ]
    return [f"{args.out}: {len(rows)} fields; their surface is at w_t = {THRESHOLD:g} of their weight.", *rows]


def _graph(title: str, potentials: dict[str, Potential]) -> str:
    radius = np.linspace(0, PLOT_RADIUS, SAMPLES)
    return field_graph(
        title,
        radius,
        {name: p.value(radius**2) for name, p in potentials.items()},
        {name: (p.threshold_radius(), p.influence) for name, p in potentials.items()},
        THRESHOLD,
    )
