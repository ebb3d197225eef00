"""Draws the overlays in the Clip Editors. Arrays and batches are made once per frame, view and setting, and kept."""

from typing import Any

import bpy
import numpy as np

from ...core.frame_table import FrameTable
from . import canvas, layers, recording
from .canvas import Canvas, Colour
from .layers import Looked
from .recording import Recording

POINT_PX, LINE_PX = 3.0, 1.2
BODY: Colour = (1.0, 0.6, 0.1, 1.0)
CONTOUR: Colour = (0.95, 0.3, 0.95, 1.0)
NO_EDGE: Colour = (0.95, 0.3, 0.95, 0.35)
START: Colour = (0.9, 0.9, 0.9, 0.8)
FOUND: Colour = (0.3, 1.0, 0.45, 1.0)
PAPER: Colour = (0.05, 0.05, 0.05, 0.65)
WHITE: Colour = (1.0, 1.0, 1.0, 1.0)
NOW: Colour = (0.3, 0.6, 1.0, 1.0)
BAD: Colour = (1.0, 0.25, 0.2, 1.0)
GRAPH_PX = 90.0
CURVES: tuple[tuple[str, str, Colour], ...] = (
    ("residual_px", "rays miss [px]", (1.0, 0.8, 0.3, 1.0)),
    ("sigma_mm", "sigma of points [mm]", (0.4, 0.85, 1.0, 1.0)),
    ("track_sigma_mm", "sigma of tracks [mm]", (0.5, 1.0, 0.55, 1.0)),
    ("fit_sigma0", "sigma0 of the fit", (1.0, 0.55, 0.9, 1.0)),
)

_handle: list[Any] = []
_looked: dict[str, Any] = {"frame": -1, "found": None}


def show_looked(frame: int, found: Looked | None) -> None:
    """What the pointer or a click chose in a frame; it stays on show while that frame is."""
    _looked.update(frame=frame, found=found)


def looked(frame: int) -> Looked | None:
    """What was chosen in a frame."""
    found: Looked | None = _looked["found"]
    return found if _looked["frame"] == frame else None


def begin() -> None:
    """Draw from now on."""
    _handle.append(bpy.types.SpaceClipEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def end() -> None:
    """Draw nothing more."""
    while _handle:
        bpy.types.SpaceClipEditor.draw_handler_remove(_handle.pop(), "WINDOW")


def _draw() -> None:
    context = bpy.context
    shown, clip = context.scene.tricap_overlay, canvas.clip_of(context.area)
    frame = context.scene.frame_current
    wanted = shown.points or shown.tracks or shown.contour or shown.body or shown.graph or looked(frame) is not None
    view = recording.view_of(clip) if clip is not None and wanted else ""
    run = recording.current(context.scene) if view else None
    if run is not None and view in run.cameras:
        playing = context.screen.is_animation_playing
        draw_overlays(run, shown, view, frame, Canvas(context.region, tuple(clip.size)), playing=playing)


def draw_overlays(run: Recording, shown: Any, view: str, frame: int, sheet: Canvas, *, playing: bool = False) -> None:
    """Everything that is switched on."""
    legend: list[tuple[str, Colour]] = []
    with sheet.image_space():
        if shown.points:
            legend += _draw_points(run, view, frame, shown, sheet)
        if shown.tracks:
            legend += _draw_tracks(run, view, frame, shown)
        if shown.contour:
            legend += _draw_contour(run, view, frame)
        if shown.body and (not playing or run.has(("outline", view, frame))):  # it takes a tenth of a second
            legend += _draw_body(run, view, frame)
        chosen = looked(frame)
        if chosen is not None:
            _draw_looked(chosen, view, sheet)
    if shown.points:
        _draw_ramp(run, view, frame, shown.most_sigma_mm, sheet)
    if shown.graph and _is_first(bpy.context.area):
        _draw_graph(run, frame, sheet)
    _draw_legend(legend, chosen.words if chosen is not None else (), sheet)


def _is_first(area: bpy.types.Area | None) -> bool:
    """Whether an area is the lowest, leftmost of the window's Clip Editors: one graph is enough."""
    window = bpy.context.window
    return area is None or window is None or area == min(canvas.clip_areas(window), key=lambda a: (a.y, a.x), default=area)


def _draw_points(run: Recording, view: str, frame: int, shown: Any, sheet: Canvas) -> list[tuple[str, Colour]]:
    """The points that are there, by sigma, and those that the filters took out: of the other colours, or red."""
    which, by, legend = shown.which_points, shown.point_filter, []
    if which != "removed":
        legend += _draw_sigmas(run, view, frame, shown.most_sigma_mm, sheet)
    if which != "kept":
        xy, counts = run.kept(("removed points", view, frame, by), lambda: layers.removed_points(run, view, frame, by))
        colour = (*(layers.KEPT if which == "before" else layers.REMOVED), 1.0)
        if len(xy):
            make = lambda: canvas.point_batch(xy, np.tile(colour, (len(xy), 1)))  # noqa: E731
            canvas.draw_points(run.kept(("removed batch", view, frame, by, which), make), _point_px(sheet))
        said = ", ".join(f"{words} {count}" for words, count in counts) or "none in this frame"
        legend.append((f"{'before the filters also' if which == 'before' else 'removed'}: {said}", colour))
    return legend


def _point_px(sheet: Canvas) -> float:
    return float(np.clip(1.2 * sheet.zoom, POINT_PX, 9.0))


def _draw_sigmas(run: Recording, view: str, frame: int, most_mm: float, sheet: Canvas) -> list[tuple[str, Colour]]:
    found = run.kept(("sigmas", view, frame, most_mm), lambda: layers.sigmas(run, view, frame, most_mm))
    if found is None:
        return [("no points in this frame", BAD)]
    batch = run.kept(("points batch", view, frame, most_mm), lambda: canvas.point_batch(found.xy_px, found.colours))
    canvas.draw_points(batch, _point_px(sheet))
    return [(f"{len(found.xy_px)} points", WHITE)]


def _draw_tracks(run: Recording, view: str, frame: int, shown: Any) -> list[tuple[str, Colour]]:
    history, which, by = run.tracks(), shown.which, shown.track_filter
    if history is None:
        return [("no trajectories yet", BAD)]
    key = ("tails", view, frame, shown.tail, which, by)
    segments, colours = run.kept(key, lambda: layers.tails(run, view, frame, shown.tail, which, by))
    if not len(segments) and len(history.frames) and frame == history.frames[0]:
        return [("trajectories begin in this frame; go on to see them", WHITE)]
    if len(segments):
        canvas.draw_lines(run.kept((*key, "batch"), lambda: canvas.line_batch(segments, colours)), LINE_PX)
    if which in ("before", "kept"):
        return [({"before": "trajectories before filters", "kept": "kept trajectories"}[which], (*layers.KEPT, 1.0))]
    reasons = ", ".join(f"{words} {count}" for words, count in layers.removed_here(history, frame, by)[:4])
    kept = [("kept trajectories", (*layers.KEPT, 1.0))] if which == "both" else []
    return [*kept, (f"removed: {reasons or 'none in this frame'}", (*layers.REMOVED, 1.0))]


def _draw_contour(run: Recording, view: str, frame: int) -> list[tuple[str, Colour]]:
    found = run.contour(view, frame)
    if found is None:
        return [("no contour here", BAD)]
    segments = canvas.chain(found.xy_px, closed=True)
    for mine, colour in ((found.seen, CONTOUR), (~found.seen, NO_EDGE)):
        if mine.any():
            batch = run.kept(("contour batch", view, frame, bool(colour is CONTOUR)), lambda mine=mine: canvas.line_batch(segments[mine]))
            canvas.draw_lines(batch, 1.5, colour)
    return [("contour", CONTOUR)]


def _draw_body(run: Recording, view: str, frame: int) -> list[tuple[str, Colour]]:
    loops = run.outline(view, frame)
    if not loops:
        return [("no fitted body in this frame", BAD)]
    make = lambda: canvas.line_batch(np.concatenate([canvas.chain(loop, closed=True) for loop in loops]))  # noqa: E731
    canvas.draw_lines(run.kept(("outline batch", view, frame), make), 2.0, BODY)
    return [("fitted body", BODY)]


def _draw_looked(found: Looked, view: str, sheet: Canvas) -> None:
    for boxes, colour in ((found.start, START), (found.found, FOUND)):
        if view in boxes and np.isfinite(boxes[view]).all():
            canvas.draw_lines(canvas.line_batch(canvas.chain(boxes[view], closed=True)), 1.5 if colour is START else 2.0, colour)
    if view in found.xy_px and np.isfinite(found.xy_px[view]).all():
        canvas.draw_lines(canvas.line_batch(canvas.cross(found.xy_px[view], 6.0 / sheet.zoom, 2.0 / sheet.zoom)), 1.5, WHITE)


def _draw_ramp(run: Recording, view: str, frame: int, most_mm: float, sheet: Canvas) -> None:
    """The colours' scale, in the upper right."""
    found = run.kept(("sigmas", view, frame, most_mm), lambda: layers.sigmas(run, view, frame, most_mm))
    if found is None:
        return
    scale = bpy.context.preferences.system.ui_scale
    width, height = 120 * scale, 10 * scale
    x, y = sheet.region.width - width - 60 * scale, sheet.region.height - 60 * scale
    canvas.fill(canvas.rectangle(x - 10 * scale, y - 20 * scale, width + 30 * scale, height + 28 * scale), PAPER)
    for i in range(24):
        colour = layers.ramp(np.array([(i + 0.5) / 24]))[0]
        canvas.fill(canvas.rectangle(x + i * width / 24, y, width / 24 + 0.5, height), tuple(colour))
    canvas.text("0", x, y - 15 * scale, size=11)
    canvas.text(f"{found.most_mm:.2g} mm", x + width - 30 * scale, y - 15 * scale, size=11)


def _draw_legend(lines: list[tuple[str, Colour]], words: tuple[str, ...], sheet: Canvas) -> None:
    scale = bpy.context.preferences.system.ui_scale
    x, y = 14 * scale, sheet.region.height - 120 * scale
    for line, colour in [*lines, *((w, FOUND) for w in words)]:
        canvas.text(line, x, y, colour, size=12)
        y -= 18 * scale


def _draw_graph(run: Recording, frame: int, sheet: Canvas) -> None:
    """A strip at the bottom: each curve in units of what is usual (half the height), bad frames as red ticks, the present one blue."""
    table = run.table()
    scale = bpy.context.preferences.system.ui_scale
    left, bottom, width, height = 14 * scale, 34 * scale, sheet.region.width - 28 * scale, GRAPH_PX * scale
    canvas.fill(canvas.rectangle(left - 6 * scale, bottom - 16 * scale, width + 12 * scale, height + 36 * scale), PAPER)
    if table is None or not len(table.frames):
        canvas.text("No frames.csv beside the results: run again to see the graph.", left, bottom + height / 2, BAD, size=12)
        return
    first, last = int(table.frames[0]), max(int(table.frames[-1]), int(table.frames[0]) + 1)
    x = left + (table.frames - first) / (last - first) * width
    _draw_curves(table, x, left, bottom, height)
    much, why = table.badness()
    bad = [i for i, word in enumerate(why) if word]
    if bad:
        ticks = np.array([[(x[i], bottom), (x[i], bottom + 0.25 * height)] for i in bad])
        canvas.draw_lines(canvas.line_batch(ticks), 2.0, BAD)
    at = left + (frame - first) / (last - first) * width
    if left - 1 <= at <= left + width + 1:
        canvas.draw_lines(canvas.line_batch(np.array([[(at, bottom), (at, bottom + height)]])), 2.0, NOW)
    canvas.text(str(first), left, bottom - 14 * scale, size=10)
    canvas.text(str(last), left + width - canvas.text_width(str(last), size=10), bottom - 14 * scale, size=10)


def _draw_curves(table: FrameTable, x: np.ndarray, left: float, bottom: float, height: float) -> None:
    scale, label = bpy.context.preferences.system.ui_scale, left
    middle = np.array([[(x[0], bottom + height / 2), (x[-1], bottom + height / 2)]])
    canvas.draw_lines(canvas.line_batch(middle), 1.0, (1.0, 1.0, 1.0, 0.2))
    for name, words, colour in CURVES:
        height_of, usual = layers.curve(table.values[name])
        segments = canvas.chain(np.stack([x, bottom + height * height_of], axis=1))
        segments = segments[np.isfinite(segments).all(axis=(1, 2))]
        said = f"{words} {usual:.2g}"
        width = canvas.text_width(said, size=11)
        if len(segments):
            canvas.draw_lines(canvas.line_batch(segments), 1.5, colour)
            if label + width < x[-1]:
                canvas.text(said, label, bottom + height + 6 * scale, colour, size=11)
                label += width + 16 * scale
