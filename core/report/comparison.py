"""The page of `tricap compare`: the published and the default method on one take, the same measures and pictures side by side."""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..images.picture import decoded
from . import pictures
from .document import SCRIPT, document, figure, notes, table

PUBLISHED, DEFAULT = "published", "default"  # the methods, by the names of their presets
METHODS = (PUBLISHED, DEFAULT)
HIGHER, LOWER, NEITHER = "higher", "lower", ""  # which values of a measure are better
LEAST = 0.001  # smaller values are not written out
EQUAL = 0.02  # relative difference below which neither method is better
KINDS = {  # of pictures, and their captions
    "patches": "least squares matching of one point, at the start (black) and as found (white)",
    "surface": "measured points, coloured by their sigma",
    "cloud": "the cloud from the reference camera and from its right side",
    "tracks": "the paths of the points over the last frames, coloured by speed",
    "trails": "trajectories from the reference camera and from its right side",
    "vectors": "vectors of the tracked points, from the reference camera and from its right side",
    "body": "the fitted body",
    "layers": "the layers of the body in its rest pose",
}
WHICH = {"all": "before the filters", "kept": "kept by the filters", "removed": "removed by the filters, coloured by reason"}


@dataclass(frozen=True, kw_only=True, slots=True)
class Measure:
    """One measure of both methods. NaN: one of them has no such result."""

    name: str
    unit: str
    published: float
    default: float
    better: str = NEITHER
    group: str = ""  # of measures, in the table

    @property
    def winner(self) -> str:
        """The name of the better method; "" if they differ by less than 2 %, or if no value is better than another."""
        a, b = self.published, self.default
        if not self.better or not np.isfinite([a, b]).all() or abs(a - b) <= EQUAL * max(abs(a), abs(b)):
            return ""
        return PUBLISHED if (a > b) == (self.better == HIGHER) else DEFAULT


def comparison_page(take: str, measures: Sequence[Measure], folders: Mapping[str, Path], remarks: Sequence[str] = ()) -> str:
    """The page of a take (its name), with remarks and the pictures from the reports in the result folders of the methods that ran."""
    body = (
        f"<h1>{html.escape(take)}: published and default method</h1>"
        f'<p class="verdict">{_verdict(measures) if len(folders) == len(METHODS) else "Only the default method ran."}</p>{notes(remarks)}'
        '<p class="soft">Published: as D\'Apuzzo et al. 1999 and 2000 describe it, from clicked points. Default: Tricap as it is.</p>'
        f"{_table(measures)}<h2>Pictures</h2>{''.join(_picture_rows(folders))}"
    )
    return document(f"Tricap: {take}, published and default", body, SCRIPT)


def _verdict(measures: Sequence[Measure]) -> str:
    """In how many measures each of the methods is better."""
    wins = {method: [m.name for m in measures if m.winner == method] for method in METHODS}
    return (
        f"Of {sum(bool(m.better) for m in measures)} measures, the default is better in {len(wins[DEFAULT])} and the published method in "
        f"{len(wins[PUBLISHED])}{_named(wins[PUBLISHED])}; in the others they differ by less than 2 %, or one has no value."
    )


def _table(measures: Sequence[Measure]) -> str:
    """The measures that either method has, by group; the better value is bold."""
    rows, group = list[list[str]](), ""
    for m in (m for m in measures if np.isfinite([m.published, m.default]).any()):
        if m.group != group:
            group = m.group
            rows.append([f'<span class="soft">{html.escape(group)}</span>', *[""] * 4])
        cells = [_cell(m, method) for method in METHODS]
        rows.append([html.escape(m.name), *cells, html.escape(m.unit), f"{m.better} is better" if m.better else ""])
    return table(["", *METHODS, "unit", ""], rows)


def _named(names: Sequence[str]) -> str:
    return f" ({html.escape(', '.join(names))})" if names else ""


def _cell(measure: Measure, method: str) -> str:
    value = measure.published if method == PUBLISHED else measure.default
    text = html.escape(written(value))
    return f'<b class="good">{text}</b>' if measure.winner == method else text


def written(value: float) -> str:
    """A value with three digits; a dash for none, and for very small ones what they are below."""
    if not np.isfinite(value):
        return "–"
    if 0 < abs(value) < LEAST:
        return f"< {LEAST:g}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:#.3g}".rstrip(".") if value else "0"


def _picture_rows(folders: Mapping[str, Path]) -> list[str]:
    """The pictures of the same name in all reports, a row each."""
    found = {method: {path.name: path for path in sorted((folder / "report").glob("*.png"))} for method, folder in folders.items()}
    shared = [name for name in found[DEFAULT] if all(name in files for files in found.values())]
    rows = []
    for kind in KINDS:
        for name in (name for name in shared if name.startswith((f"{kind}_", f"{kind}."))):
            caption = _caption(kind, name.removesuffix(".png").removeprefix(kind).removeprefix("_"))
            pair = [figure(f"{method}: {caption}", pictures.jpeg(decoded(files[name]))) for method, files in found.items()]
            rows.append(f'<div class="row broad">{"".join(pair)}</div>')
    return rows


def _caption(kind: str, rest: str) -> str:
    """A caption from the rest of a picture's file name: the frame and view, or which trajectories."""
    frame, _, view = rest.partition("_")
    if frame.isdecimal():
        return f"{KINDS[kind]}, frame {int(frame)}{f', view {view}' if view else ''}"
    return f"{KINDS[kind]}: {WHICH.get(rest, rest)}" if rest else KINDS[kind]
