"""Graphs as SVG: curves over the frames, with bands of one sigma, limits and marked frames; fields of metaballs over the radius.

`SCRIPT` lets a reader of the page point at a curve to read its value, drag over a range to enlarge it, and double-click to see all of it.
It reads the graph's own points: a graph carries no second copy of its data. Without the script the graphs are pictures.
"""

import html
from collections.abc import Mapping, Sequence

import numpy as np

WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 520, 170, 56, 26, 26
RIGHT_X, BOTTOM_Y = WIDTH - 10, HEIGHT - BOTTOM
END_PX = 60  # between a tick and the numbers of the first and the last frame
COLOURS = ("#d1495b", "#2e86c1", "#28a066", "#c98a1b", "#8e5bb5", "#7a8288")  # readable on white and on black
MOST_PER_CURVE = 1200  # frames, about two for each pixel of the width: of longer curves only the extremes of each interval are visible
TEXT = 'font-family="sans-serif" font-size="11" fill="currentColor"'

SCRIPT = """
for (const svg of document.querySelectorAll('svg.graph')) {
  const d = svg.dataset, left = +d.left, right = +d.right, top = +d.top, bottom = +d.bottom
  const plot = svg.querySelector('.plot'), cross = svg.querySelector('.cross'), read = svg.querySelector('.read')
  const ends = svg.querySelectorAll('.end'), points = [...plot.querySelectorAll('.first')].flatMap(p => [...p.points])
  let from = left, to = right, start = null
  const frame = x => Math.round(+d.first + (x - left) / (right - left) * (d.last - d.first))
  const at = e => {
    const box = svg.getBoundingClientRect(), x = (e.clientX - box.left) * svg.viewBox.baseVal.width / box.width
    return Math.min(to, Math.max(from, from + (x - left) * (to - from) / (right - left)))
  }
  const draw = () => {
    const k = (right - left) / (to - from)
    plot.setAttribute('transform', `translate(${left - from * k} 0) scale(${k} 1)`)
    for (const tick of svg.querySelectorAll('.tick')) {
      const x = left + (tick.dataset.x - from) * k
      tick.setAttribute('transform', `translate(${x - tick.dataset.x} 0)`)
      tick.setAttribute('visibility', x > left + 60 && x < right - 60 ? 'visible' : 'hidden')
    }
    ends[0].textContent = `frame ${frame(from)}`
    ends[1].textContent = frame(to)
  }
  svg.addEventListener('pointermove', e => {
    const x = at(e)
    let best = null
    for (const p of points) if (best === null || Math.abs(p.x - x) < Math.abs(best.x - x)) best = p
    if (best === null) return
    const shown = left + (best.x - from) * (right - left) / (to - from)
    const value = +d.high - (best.y - top) / (bottom - top) * (d.high - d.low)
    cross.setAttribute('x1', shown); cross.setAttribute('x2', shown); cross.setAttribute('visibility', 'visible')
    const digits = Math.min(9, Math.max(0, Math.ceil(-Math.log10((d.high - d.low) / 200))))
    read.textContent = `frame ${frame(best.x)}: ${Number(value.toFixed(digits))} ${d.unit}`
  })
  svg.addEventListener('pointerleave', () => { cross.setAttribute('visibility', 'hidden'); read.textContent = '' })
  svg.addEventListener('pointerdown', e => { start = at(e) })
  svg.addEventListener('pointerup', e => {
    const stop = at(e)
    if (start !== null && Math.abs(stop - start) > 0.02 * (to - from)) {
      [from, to] = [Math.min(start, stop), Math.max(start, stop)]
      draw()
    }
    start = null
  })
  svg.addEventListener('dblclick', () => { from = left; to = right; draw() })
}
"""


def curve_graph(
    title: str,
    unit: str,
    frames: np.ndarray,
    curves: Mapping[str, np.ndarray],
    sigma: np.ndarray | None = None,
    *,
    limits: tuple[float, float] = (-np.inf, np.inf),
    marks: Sequence[int] = (),
) -> str:
    """One graph; NaN interrupts a curve, and nothing finite gives "". `sigma` is the band of the first curve.

    `limits` are drawn where they lie within the graph, `marks` are frames with clicks.
    """
    first = next(iter(curves.values()))
    band = [] if sigma is None else [first + sigma, first - sigma]
    values = np.concatenate([*curves.values(), *band])
    values = values[np.isfinite(values)]
    if not len(values) or not len(frames):
        return ""
    axes = _Axes(frames[0], frames[-1], float(values.min()), float(values.max()))
    low, high = axes.range
    plot = [_DASHED.format(axes.x(m), axes.x(m), TOP, BOTTOM_Y, COLOURS[1]) for m in marks if frames[0] <= m <= frames[-1]]
    if sigma is not None:
        for f, c, s in _runs(*thinned(frames, first, sigma)):
            outline = _points(axes.x(np.concatenate([f, f[::-1]])), axes.y(np.concatenate([c + s, (c - s)[::-1]])))
            plot.append(f'<polygon points="{outline}" fill="{COLOURS[0]}" opacity="0.25"/>')
    for i, (curve, stroke) in enumerate(zip(curves.values(), COLOURS)):
        start = f'<polyline class="{"more" if i else "first"}" fill="none" stroke="{stroke}" stroke-width="1.6"'
        runs = _runs(*thinned(frames, curve))
        plot += [f'{start} vector-effect="non-scaling-stroke" points="{_points(axes.x(f), axes.y(c))}"/>' for f, c in runs]
    dashes = [_DASHED.format(LEFT, RIGHT_X, axes.y(v), axes.y(v), COLOURS[3]) for v in limits if low < v < high]
    clipped = f'<svg x="{LEFT}" width="{RIGHT_X - LEFT}" height="{HEIGHT}" viewBox="{LEFT} 0 {RIGHT_X - LEFT} {HEIGHT}">'
    around = axes.around(title, unit, list(curves) if len(curves) > 1 else [])
    return f'{around}{"".join(dashes)}{clipped}<g class="plot">{"".join(plot)}</g></svg></svg>'


_DASHED = '<line x1="{:.1f}" x2="{:.1f}" y1="{:.1f}" y2="{:.1f}" stroke="{}" stroke-dasharray="4 3" vector-effect="non-scaling-stroke"/>'


class _Axes:
    """The scales of a graph whose frames and values lie between these."""

    def __init__(self, first: float, last: float, low: float, high: float) -> None:
        pad = 0.08 * (high - low) or max(abs(high), 1.0) * 0.1
        self._frames = float(first), float(last)
        self.range = low - pad, high + pad

    def x(self, frame: np.ndarray | float) -> np.ndarray:
        first, last = self._frames
        return LEFT + (RIGHT_X - LEFT) * (np.asarray(frame) - first) / max(1.0, last - first)

    def y(self, value: np.ndarray | float) -> np.ndarray:
        low, high = self.range
        return TOP + (BOTTOM_Y - TOP) * (high - np.asarray(value)) / (high - low)

    def around(self, title: str, unit: str, names: Sequence[str] = ()) -> str:
        """The beginning of the graph: its title, the names of its curves, grid and labels, and what `SCRIPT` reads and writes."""
        (first, last), (low, high) = self._frames, self.range
        label = html.escape(f"{title} [{unit}]" if unit else title)
        data = dict(left=LEFT, right=RIGHT_X, top=TOP, bottom=BOTTOM_Y, first=first, last=max(first + 1, last), low=low, high=high)
        key = "".join(f'<tspan dx="8" font-size="11" fill="{c}">{html.escape(name)}</tspan>' for name, c in zip(names, COLOURS))
        attributes = " ".join(f'data-{name}="{value:.8g}"' for name, value in data.items())
        parts = [
            f'<svg class="graph" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" xmlns="http://www.w3.org/2000/svg" '
            f'role="img" aria-label="{label}" {attributes} data-unit="{html.escape(unit)}" {TEXT}>'
            f'<text x="{LEFT}" y="15" font-size="13">{label}{key}</text>'
            f'<text class="read" x="{RIGHT_X}" y="15" text-anchor="end"></text>',
        ]
        parts += [
            f'<line x1="{LEFT}" x2="{RIGHT_X}" y1="{self.y(v):.1f}" y2="{self.y(v):.1f}" stroke="currentColor" opacity="0.2"/>'
            f'<text x="{LEFT - 6}" y="{self.y(v) + 4:.1f}" text-anchor="end">{text}</text>'
            for v, text in ticks(*self.range)
        ]
        parts += self._frame_ticks()
        return "".join(parts) + (
            f'<line class="cross" visibility="hidden" y1="{TOP}" y2="{BOTTOM_Y}" stroke="currentColor" opacity="0.6"/>'
            f'<text class="end" x="{LEFT}" y="{HEIGHT - 8}">frame {first:.0f}</text>'
            f'<text class="end" x="{RIGHT_X}" y="{HEIGHT - 8}" text-anchor="end">{last:.0f}</text>'
        )

    def _frame_ticks(self) -> list[str]:
        """Round frames between the first and the last, as far from these as their numbers need."""
        first, last = self._frames
        places = [(float(self.x(v)), text) for v, text in ticks(first, last) if v == round(v)] if last > first else []
        return [
            f'<g class="tick" data-x="{x:.1f}"><path d="M{x:.1f} {BOTTOM_Y}v4" stroke="currentColor" opacity="0.5"/>'
            f'<text x="{x:.1f}" y="{HEIGHT - 8}" text-anchor="middle">{text}</text></g>'
            for x, text in places
            if LEFT + END_PX < x < RIGHT_X - END_PX
        ]


def ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Round values between two others, 1, 2 or 5 times a power of ten apart, with their labels: two to five of them."""
    least = (high - low) / 5
    power = 10.0 ** np.floor(np.log10(least))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= least * (1 - 1e-9))
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    values = step * np.arange(np.ceil(low / step), np.floor(high / step) + 1) + 0.0
    return [(v, f"{v:.{decimals}f}" if step < 1e5 else f"{v:.3g}") for v in values.tolist()]


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
        f'<svg viewBox="0 0 {WIDTH} {high}" width="{WIDTH}" height="{high}" xmlns="http://www.w3.org/2000/svg" {TEXT}>',
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
