"""The page of `tricap compare`: the published and the default method on one take, the same measures and pictures side by side."""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..images.sequence import decoded
from . import pictures
from .document import document, figure, table

PUBLISHED, DEFAULT = "published", "default"  # the methods, by the names of their presets
METHODS = (PUBLISHED, DEFAULT)
HIGHER, LOWER, NEITHER = "higher", "lower", ""  # which values of a measure are better
EQUAL = 0.02  # relative difference below which neither method is better
KINDS = ("trails", "vectors", "surface", "cloud", "tracks", "body", "layers")  # of pictures


@dataclass(frozen=True, kw_only=True, slots=True)
class Measure:
    """One measure of both methods. NaN: one of them has no such result."""

    name: str
    unit: str
    published: float
    default: float
    better: str = NEITHER

    @property
    def winner(self) -> str:
        """The name of the better method; "" if they differ by less than 2 %, or if no value is better than another."""
        a, b = self.published, self.default
        if not self.better or not np.isfinite([a, b]).all() or abs(a - b) <= EQUAL * max(abs(a), abs(b)):
            return ""
        return PUBLISHED if (a > b) == (self.better == HIGHER) else DEFAULT


def comparison_page(take: str, measures: Sequence[Measure], folders: Sequence[Path]) -> str:
    """The page of a take (its name), with pictures from the reports in the two result folders, in the order of `METHODS`."""
    rows = []
    for m in measures:
        cells = [_cell(m, method) for method in METHODS]
        rows.append([html.escape(m.name), *cells, html.escape(m.unit), f"{m.better} is better" if m.better else ""])
    wins = {method: [m.name for m in measures if m.winner == method] for method in METHODS}
    judged = sum(bool(m.better) for m in measures)
    body = (
        f"<h1>{html.escape(take)}: published and default method</h1>"
        f'<p class="verdict">Of {judged} measures, the default is better in {len(wins[DEFAULT])} and the published method in '
        f"{len(wins[PUBLISHED])}{_named(wins[PUBLISHED])}; in the others they differ by less than 2 %, or one has no value.</p>"
        f"{table(['', *METHODS, 'unit', ''], rows)}<h2>Pictures</h2>{''.join(_picture_rows(folders))}"
    )
    return document(f"Tricap: {take}, published and default", body)


def _named(names: Sequence[str]) -> str:
    return f" ({html.escape(', '.join(names))})" if names else ""


def _cell(measure: Measure, method: str) -> str:
    value = measure.published if method == PUBLISHED else measure.default
    text = f"{value:.4g}" if np.isfinite(value) else "–"
    return f'<b class="good">{text}</b>' if measure.winner == method else text


def _picture_rows(folders: Sequence[Path]) -> list[str]:
    """The pictures of the same name in both reports, a row each."""
    found = [{path.name: path for path in sorted((folder / "report").glob("*.png"))} for folder in folders]
    rows = []
    for kind in KINDS:
        for name in (name for name in found[0] if name.startswith(f"{kind}_") and name in found[1]):
            which = name.removesuffix(".png").removeprefix(f"{kind}_").replace("_", ", view ")
            label = f"trajectories, {which}" if kind == "trails" else f"{kind}, frame {which}"
            pair = [figure(f"{label}: {method}", pictures.jpeg(decoded(files[name]))) for method, files in zip(METHODS, found)]
            rows.append(f'<div class="row">{"".join(pair)}</div>')
    return rows
