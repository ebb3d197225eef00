"""The figures of a run: name, value, sigma, unit. For people in report.html, for programs in report.json.

Curves as SVG: over the frames, with a band of one sigma; fields of metaballs over the radius.
"""

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..body.motion import BodyFit
from ..surface.cloud import PointCloud
from ..tracking.trajectories import Trajectories
from .silhouettes import PERSON, SilhouetteFit

FRAME_TO_FRAME = "scatter from frame to frame"
ESTIMATED = "from the adjustment"
Row = dict[str, Any]


def figure_rows(
    record: Mapping[str, Any],
    clouds: Sequence[PointCloud],
    trajectories: Trajectories | None,
    body: BodyFit | None,
    silhouettes: Sequence[SilhouetteFit] = (),
) -> list[Row]:
    """The rows; `sigma_of` is the origin of each sigma. NaN, where there is none, becomes null in the file."""
    per_frame = {
        ("points a frame", "points"): [float(len(c.xyz_m)) for c in clouds],
        ("residual of the rays (median)", "px"): [float(np.median(c.residual_px)) for c in clouds if len(c.residual_px)],
        ("sigma of a point (median)", "mm"): [1e3 * float(np.median(c.sigma_m)) for c in clouds if len(c.sigma_m)],
    }
    if trajectories is not None:
        per_frame["tracked points a frame", "points"] = trajectories.visible.sum(axis=1).astype(float).tolist()
    rows = [_row(name, float(np.median(v)), float(np.std(v)), unit, FRAME_TO_FRAME) for (name, unit), v in per_frame.items() if v]
    for view, offset in record.get("offsets", {}).items():
        if offset["late_frames"] is not None and offset["sigma_frames"] is not None:
            rows.append(_row(f"view {view} is late by", offset["late_frames"], offset["sigma_frames"], "frames", ESTIMATED))
    return rows + _of_silhouettes(silhouettes) + (_of_body(body) if body is not None else [])


def _of_silhouettes(fits: Sequence[SilhouetteFit]) -> list[Row]:
    """The overlap in each view, and the distance of the outlines."""
    rows = []
    for view, person in dict.fromkeys((f.view, f.person) for f in fits):
        mine = [f for f in fits if (f.view, f.person) == (view, person)]
        for name, unit, values in (
            (f"silhouette of view {view}, IoU with {PERSON[person]}", "", [f.iou for f in mine]),
            (f"silhouette of view {view}, share inside {PERSON[person]}", "", [f.inside for f in mine]),
            (f"outline of view {view} from the body's", "px", [f.distance_px for f in mine]),
        ):
            known = [v for v in values if np.isfinite(v)]
            rows += [_row(name, float(np.median(known)), float(np.std(known)), unit, FRAME_TO_FRAME)] if known else []
    return rows


def number(value: float) -> float | None:
    """A number for JSON: null if it is not finite."""
    return float(value) if np.isfinite(value) else None


def _of_body(body: BodyFit) -> list[Row]:
    """Lengths of bones, and the least and the greatest value of each joint angle."""
    skeleton, motion, rows = body.shape.skeleton, body.motion, []
    for bone, length, sigma in zip(skeleton.bones, body.shape.lengths_m, body.shape.length_sigma_m):
        rows.append(_row(f"length of {bone.name}", 1e3 * length, 1e3 * sigma, "mm", ESTIMATED))
    base = set(skeleton.layout.group("base").tolist())
    for d, name in enumerate(motion.dof_names):
        values = np.degrees(motion.values[:, d])
        if d in base or not np.isfinite(values).any():
            continue
        for word, at in (("least", int(np.nanargmin(values))), ("greatest", int(np.nanargmax(values)))):
            label = f"{name}, {word} (frame {motion.frames[at]})"
            rows.append(_row(label, values[at], np.degrees(motion.sigma[at, d]), "°", ESTIMATED))
    return rows


def _row(name: str, value: float, sigma: float, unit: str, sigma_of: str) -> Row:
    return {"name": name, "value": float(value), "sigma": float(sigma), "unit": unit, "sigma_of": sigma_of}


def quoted(value: float, sigma: float) -> tuple[str, str]:
    """Value and sigma as printed: the sigma with two significant digits, the value to the same decimal place."""
    if not np.isfinite(sigma) or sigma <= 0:
        return f"{value:.4g}", "–"
    places = max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{places}f}", f"{sigma:.{places}f}"


WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 520, 170, 56, 26, 26
COLOURS = ("#c0392b", "#2471a3", "#1e8449", "#b9770e", "#7d3c98", "#515a5a")
MOST_PER_CURVE = 1200  # frames, about two for each pixel of the width: of longer curves only the extremes of each interval are visible


def curve_graph(title: str, unit: str, frames: np.ndarray, curves: Mapping[str, np.ndarray], sigma: np.ndarray | None = None) -> str:
    """One graph; NaN interrupts a curve. `sigma` is the band of the first curve."""
    values = np.concatenate([c for c in curves.values()])
    first = next(iter(curves.values()))
    if sigma is not None:
        values = np.concatenate([values, first + sigma, first - sigma])
    values = values[np.isfinite(values)]
    if not len(values) or not len(frames):
        return ""
    low, high = float(values.min()), float(values.max())
    pad = 0.08 * (high - low) or max(abs(high), 1.0) * 0.1
    low, high = low - pad, high + pad
    x = LEFT + (WIDTH - LEFT - 10) * (frames - frames[0]) / max(1, frames[-1] - frames[0])

    def y(value: np.ndarray | float) -> np.ndarray:
        return TOP + (HEIGHT - TOP - BOTTOM) * (high - np.asarray(value)) / (high - low)

    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" font-size="11">',
        f'<text x="{LEFT}" y="15" font-size="13">{html.escape(title)}{f" [{html.escape(unit)}]" if unit else ""}</text>',
    ]
    for value in np.linspace(low + pad, high - pad, 3):
        parts.append(
            f'<line x1="{LEFT}" x2="{WIDTH - 10}" y1="{y(value):.1f}" y2="{y(value):.1f}" stroke="#ddd"/>'
            f'<text x="{LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:.4g}</text>'
        )
    parts += [
        f'<text x="{LEFT}" y="{HEIGHT - 8}">frame {frames[0]}</text>',
        f'<text x="{WIDTH - 10}" y="{HEIGHT - 8}" text-anchor="end">{frames[-1]}</text>',
    ]
    if sigma is not None:
        for px, c, s in _runs(*thinned(x, first, sigma)):
            band = _points(np.concatenate([px, px[::-1]]), np.concatenate([y(c + s), y(c - s)[::-1]]))
            parts.append(f'<polygon points="{band}" fill="{COLOURS[0]}" opacity="0.18"/>')
    for (_, curve), stroke in zip(curves.items(), COLOURS):
        runs = _runs(*thinned(x, curve))
        parts += [f'<polyline points="{_points(px, y(c))}" fill="none" stroke="{stroke}" stroke-width="1.6"/>' for px, c in runs]
    return "".join(parts) + "</svg>"


def field_graph(
    title: str, radius: np.ndarray, curves: Mapping[str, np.ndarray], marks: Mapping[str, tuple[float, float]], threshold: float
) -> str:
    """Fields (values 0 to 1) over the radius (N,) from 0, with the threshold w_t as a line, and of each curve in `marks` r_t as a dot on it
    and r_a as a stroke on the axis."""
    high = 2 * HEIGHT

    def x(r: np.ndarray | float) -> np.ndarray:
        return LEFT + (WIDTH - LEFT - 10) * np.asarray(r) / radius[-1]

    def y(value: np.ndarray | float) -> np.ndarray:
        return TOP + (high - TOP - BOTTOM) * (1 - np.asarray(value))

    line = '<line x1="{:.1f}" x2="{:.1f}" y1="{:.1f}" y2="{:.1f}" stroke="{}"/>'
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {high}" width="{WIDTH}" height="{high}" xmlns="http://www.w3.org/2000/svg" '
        'font-family="sans-serif" font-size="11">',
        f'<text x="{LEFT}" y="15" font-size="13">{html.escape(title)}</text>',
        line.format(LEFT, WIDTH - 10, y(0), y(0), "#888"),
        line.format(LEFT, LEFT, y(0), y(1), "#888"),
        line.format(LEFT, WIDTH - 10, y(threshold), y(threshold), "#bbb"),
        f'<text x="{LEFT - 6}" y="{y(threshold) + 4:.1f}" text-anchor="end">w_t = {threshold:g}</text>',
        f'<text x="{WIDTH - 10}" y="{high - 8}" text-anchor="end">r / l</text>',
    ]
    parts += [f'<text x="{x(r):.1f}" y="{high - 8}" text-anchor="middle">{r:g}</text>' for r in np.arange(0, radius[-1], 0.25)]
    for i, ((name, curve), stroke) in enumerate(zip(curves.items(), COLOURS)):
        visible, influence = marks[name]
        row = f"{name}: r_t {visible:.3f}, r_a {influence:.3f}"
        parts += [
            f'<polyline points="{_points(x(radius), y(curve))}" fill="none" stroke="{stroke}" stroke-width="1.6"/>',
            f'<circle cx="{x(visible):.1f}" cy="{y(threshold):.1f}" r="3.5" fill="{stroke}"/>',
            line.format(x(influence), x(influence), y(0) - 7, y(0) + 5, stroke),
            f'<text x="{WIDTH - 14}" y="{TOP + 14 * (i + 1)}" text-anchor="end" fill="{stroke}">{html.escape(row)}</text>',
        ]
    return "".join(parts) + "</svg>"


def thinned(x: np.ndarray, curve: np.ndarray, *more: np.ndarray) -> tuple[np.ndarray, ...]:
    """The lowest and the highest value of each stretch of a long curve, and a gap where there is one; a short curve as it is."""
    if len(x) <= MOST_PER_CURVE:
        return x, curve, *more
    chosen = set[int]()
    for part in np.array_split(np.arange(len(x)), MOST_PER_CURVE // 3):
        known = np.isfinite(curve[part])
        finite = part[known]
        chosen.update(part[~known][:1].tolist())
        chosen.update(finite[[curve[finite].argmin(), curve[finite].argmax()]].tolist() if len(finite) else ())
    kept = np.array(sorted(chosen))
    return tuple(a[kept] for a in (x, curve, *more))


def _runs(x: np.ndarray, *curves: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """The stretches in which all curves are finite."""
    finite = np.isfinite(np.stack(curves)).all(axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], finite, [False]]).astype(int)))
    return [(x[a:b], *(c[a:b] for c in curves)) for a, b in zip(edges[::2], edges[1::2])]


def _points(x: np.ndarray, y: np.ndarray) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y))
