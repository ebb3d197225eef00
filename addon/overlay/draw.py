"""Draws the overlays in the Clip Editors: a run's results, and the user's corrections. Arrays and batches are cached per frame, view and
setting."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ..session import get_session
from . import canvas, layers, results
from .canvas import Canvas, Colour
from .layers import Inspection, Pulled
from .results import RunResults

if TYPE_CHECKING:
    from ...core.run.record import FrameTable

POINT_PX, LINE_PX = 3.0, 2.2
BODY: Colour = (1.0, 0.6, 0.1, 1.0)
CONTOUR: Colour = (0.95, 0.3, 0.95, 1.0)
NO_EDGE: Colour = (0.95, 0.3, 0.95, 0.35)
START_BOX: Colour = (0.9, 0.9, 0.9, 0.8)
MATCHED: Colour = (0.3, 1.0, 0.45, 1.0)
WHITE: Colour = (1.0, 1.0, 1.0, 1.0)
CURRENT_FRAME: Colour = (0.3, 0.6, 1.0, 1.0)
PROBLEM: Colour = (1.0, 0.25, 0.2, 1.0)
CORRECTION: Colour = (1.0, 0.25, 0.2, 1.0)
ACTIVE_CORRECTION: Colour = (1.0, 0.85, 0.3, 1.0)
PULLED: Colour = (0.3, 1.0, 0.45, 1.0)
PULLED_BONES: Colour = (0.3, 1.0, 0.45, 0.6)
GRAPH_PX = 90.0  # height
CURVES: tuple[tuple[str, str, Colour], ...] = (
    ("residual_px", "residual [px]", (1.0, 0.8, 0.3, 1.0)),
    ("sigma_mm", "point sigma [mm]", (0.4, 0.85, 1.0, 1.0)),
    ("track_sigma_mm", "track sigma [mm]", (0.5, 1.0, 0.55, 1.0)),
    ("fit_sigma0", "fit sigma0", (1.0, 0.55, 0.9, 1.0)),
)


def show_inspection(frame: int, found: Inspection | None) -> None:
    """Show what is under the pointer, for as long as the scene stays in this frame."""
    get_session().file.inspection = (frame, found)


def shown_inspection(frame: int) -> Inspection | None:
    """What is inspected in a frame, if anything."""
    inspected, found = get_session().file.inspection
    return found if inspected == frame else None


def show_region(view: str, corners: Sequence[tuple[float, float]]) -> None:
    """Show the corners of the region that is being clicked in a view."""
    get_session().file.region_corners = (view, list(corners))


def show_pulled(pulled: Pulled | None) -> None:
    """Show a limb whose joint is being dragged, in all views."""
    get_session().file.pulled = pulled


def begin() -> None:
    """Add the draw handler."""
    get_session().overlay_handle = bpy.types.SpaceClipEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")


def end() -> None:
    """Remove the draw handler."""
    bpy.types.SpaceClipEditor.draw_handler_remove(get_session().overlay_handle, "WINDOW")


def _draw() -> None:
    context = bpy.context
    clip = canvas.clip_of(context.area)
    view = results.view_of(clip) if clip is not None else ""
    if not view:
        return
    sheet, scene = Canvas(context.region, tuple(clip.size)), context.scene
    if is_anything_shown(scene.tricap_overlay, scene.frame_current):
        run = results.current(scene)
        if run is not None and view in run.cameras:
            draw_overlays(run, scene.tricap_overlay, view, scene.frame_current, sheet, playing=context.screen.is_animation_playing)
    draw_corrections(scene.tricap_correcting, view, scene.frame_current, sheet)
    draw_pulled(get_session().file.pulled, view, scene.frame_current, sheet)


def is_anything_shown(shown: Any, frame: int) -> bool:
    """Whether an overlay is switched on, or something is inspected in this frame."""
    return (
        bool(shown.points or shown.tracks or shown.contour or shown.body or shown.chosen or shown.graph)
        or shown_inspection(frame) is not None
    )


def draw_overlays(run: RunResults, shown: Any, view: str, frame: int, sheet: Canvas, *, playing: bool = False) -> None:
    """Draw what is switched on."""
    legend: list[tuple[str, Colour]] = []
    with sheet.image_space():
        if shown.points:
            legend += _draw_points(run, view, frame, shown, sheet)
        if shown.tracks:
            legend += _draw_tracks(run, view, frame, shown)
        if shown.chosen:
            legend += _draw_chosen(run, view, frame, sheet)
        if shown.contour:
            legend += _draw_contour(run, view, frame)
        if shown.body and (not playing or run.has(("outline", view, frame))):  # it takes a tenth of a second
            legend += _draw_body(run, view, frame)
        inspected = shown_inspection(frame)
        if inspected is not None:
            _draw_inspection(inspected, view, sheet)
    if shown.points:
        _draw_colour_scale(run, view, frame, shown.most_sigma_mm, sheet)
    if shown.graph and _is_first(bpy.context.area):
        _draw_graph(run, frame, sheet)
    _draw_legend(legend, inspected.lines if inspected is not None else (), sheet)


def _is_first(area: bpy.types.Area | None) -> bool:
    """Whether an area is the lowest, leftmost Clip Editor of the window: only that one shows the graph."""
    window = bpy.context.window
    return area is None or window is None or area == min(canvas.clip_areas(window), key=lambda a: (a.y, a.x), default=area)


def _draw_points(run: RunResults, view: str, frame: int, shown: Any, sheet: Canvas) -> list[tuple[str, Colour]]:
    """The points that were kept, coloured by sigma, and those that the filters removed."""
    which, by, legend = shown.which_points, shown.point_filter, []
    if which != "removed":
        legend += _draw_coloured_points(run, view, frame, shown.most_sigma_mm, sheet)
    if which != "kept":
        xy, counts = run.cached(("removed points", view, frame, by), lambda: layers.removed_points(run, view, frame, by))
        colour = (*(layers.KEPT if which == "before" else layers.REMOVED), 1.0)
        if len(xy):
            make = lambda: canvas.point_batch(xy, np.tile(colour, (len(xy), 1)))  # noqa: E731
            canvas.draw_points(run.cached(("removed batch", view, frame, by, which), make), _point_px(sheet))
        removed = ", ".join(f"{reason} {count}" for reason, count in counts) or "none in this frame"
        legend.append((f"{'before filtering also' if which == 'before' else 'removed'}: {removed}", colour))
    return legend


def _point_px(sheet: Canvas) -> float:
    return float(np.clip(1.2 * sheet.zoom, POINT_PX, 9.0))


def _draw_coloured_points(run: RunResults, view: str, frame: int, red_mm: float, sheet: Canvas) -> list[tuple[str, Colour]]:
    found = run.cached(("coloured points", view, frame, red_mm), lambda: layers.coloured_points(run, view, frame, red_mm))
    if found is None:
        return [("no points in this frame", PROBLEM)]
    batch = run.cached(("coloured points batch", view, frame, red_mm), lambda: canvas.point_batch(found.xy_px, found.colours))
    canvas.draw_points(batch, _point_px(sheet))
    return [(f"{len(found.xy_px)} points", WHITE)]


def _draw_tracks(run: RunResults, view: str, frame: int, shown: Any) -> list[tuple[str, Colour]]:
    history, which, by = run.tracks(), shown.which, shown.track_filter
    if history is None:
        return [("no trajectories yet", PROBLEM)]
    key = ("tails", view, frame, shown.tail, which, by)
    segments, colours = run.cached(key, lambda: layers.tails(run, view, frame, shown.tail, which, by))
    if not len(segments) and len(history.frames) and frame == history.frames[0]:
        return [("trajectories begin in this frame; step forward to see them", WHITE)]
    if len(segments):
        canvas.draw_lines(run.cached((*key, "batch"), lambda: canvas.line_batch(segments, colours)), LINE_PX)
    if which in ("before", "kept"):
        return [({"before": "trajectories before filtering", "kept": "kept trajectories"}[which], (*layers.KEPT, 1.0))]
    reasons = ", ".join(f"{words} {count}" for words, count in layers.removal_counts(history, frame, by)[:4])
    kept = [("kept trajectories", (*layers.KEPT, 1.0))] if which == "both" else []
    return [*kept, (f"removed: {reasons or 'none in this frame'}", (*layers.REMOVED, 1.0))]


def _draw_chosen(run: RunResults, view: str, frame: int, sheet: Canvas) -> list[tuple[str, Colour]]:
    """The paths of single points, and crosses where they are."""
    segments, colours, at = run.cached(("chosen paths", view, frame), lambda: layers.chosen_paths(run, view, frame))
    if len(segments):
        canvas.draw_lines(run.cached(("chosen batch", view, frame), lambda: canvas.line_batch(segments, colours)), LINE_PX)
    if not at:
        return [("no followed points in this frame", PROBLEM)]
    crosses = np.concatenate([canvas.cross(xy, 7.0 / sheet.zoom, 2.0 / sheet.zoom) for xy in at.values()])
    canvas.draw_lines(canvas.line_batch(crosses), 1.5, WHITE)
    return [(f"followed points: {', '.join(at)}", WHITE)]


def _draw_contour(run: RunResults, view: str, frame: int) -> list[tuple[str, Colour]]:
    found = run.contour(view, frame)
    if found is None:
        return [("no outline in this frame", PROBLEM)]
    segments = canvas.chain(found.xy_px, closed=True)
    for mine, colour in ((found.on_edge, CONTOUR), (~found.on_edge, NO_EDGE)):
        if mine.any():
            batch = run.cached(("contour batch", view, frame, bool(colour is CONTOUR)), lambda mine=mine: canvas.line_batch(segments[mine]))
            canvas.draw_lines(batch, 1.5, colour)
    return [("outline", CONTOUR)]


def _draw_body(run: RunResults, view: str, frame: int) -> list[tuple[str, Colour]]:
    loops = run.outline(view, frame)
    if not loops:
        return [("no fitted body in this frame", PROBLEM)]
    make = lambda: canvas.line_batch(np.concatenate([canvas.chain(loop, closed=True) for loop in loops]))  # noqa: E731
    canvas.draw_lines(run.cached(("outline batch", view, frame), make), 2.0, BODY)
    return [("fitted body", BODY)]


def _draw_inspection(found: Inspection, view: str, sheet: Canvas) -> None:
    for boxes, colour in ((found.start_boxes, START_BOX), (found.matched_boxes, MATCHED)):
        if view in boxes and np.isfinite(boxes[view]).all():
            canvas.draw_lines(canvas.line_batch(canvas.chain(boxes[view], closed=True)), 1.5 if colour is START_BOX else 2.0, colour)
    if view in found.xy_px and np.isfinite(found.xy_px[view]).all():
        canvas.draw_lines(canvas.line_batch(canvas.cross(found.xy_px[view], 6.0 / sheet.zoom, 2.0 / sheet.zoom)), 1.5, WHITE)


def _draw_colour_scale(run: RunResults, view: str, frame: int, red_mm: float, sheet: Canvas) -> None:
    """The colour scale of the points' sigmas, in the upper right corner."""
    found = run.cached(("coloured points", view, frame, red_mm), lambda: layers.coloured_points(run, view, frame, red_mm))
    if found is None:
        return
    scale = bpy.context.preferences.system.ui_scale
    width = 120 * scale
    x, y = sheet.region.width - width - 60 * scale, sheet.region.height - 80 * scale
    shades = layers.heat_colours(np.linspace(0, 1, 24))[:, :3]
    canvas.colour_bar(shades, ["0", f"{found.red_mm:.2g} mm"], "Sigma of the points", x, y, width)


def _draw_legend(lines: list[tuple[str, Colour]], details: tuple[str, ...], sheet: Canvas) -> None:
    scale = bpy.context.preferences.system.ui_scale
    x, y = 14 * scale, sheet.region.height - 120 * scale
    for line, colour in [*lines, *((line, MATCHED) for line in details)]:
        canvas.text(line, x, y, colour, size=12)
        y -= 18 * scale


def _draw_graph(run: RunResults, frame: int, sheet: Canvas) -> None:
    """A graph at the bottom: each curve relative to its median (half the height), doubtful frames as red ticks, the current frame blue."""
    table = run.table()
    scale = bpy.context.preferences.system.ui_scale
    left, bottom, width, height = 14 * scale, 34 * scale, sheet.region.width - 28 * scale, GRAPH_PX * scale
    canvas.fill(canvas.rectangle(left - 6 * scale, bottom - 16 * scale, width + 12 * scale, height + 36 * scale), canvas.BACKING)
    if table is None or not len(table.frames):
        canvas.text("The results have no table of frames; run again to see the graph.", left, bottom + height / 2, PROBLEM, size=12)
        return
    first, last = int(table.frames[0]), max(int(table.frames[-1]), int(table.frames[0]) + 1)
    x = left + (table.frames - first) / (last - first) * width
    _draw_curves(table, x, left, bottom, height)
    _, why = run.doubt()
    doubtful = [i for i, reason in enumerate(why) if reason]
    if doubtful:
        ticks = np.array([[(x[i], bottom), (x[i], bottom + 0.25 * height)] for i in doubtful])
        canvas.draw_lines(canvas.line_batch(ticks), 2.0, PROBLEM)
    at = left + (frame - first) / (last - first) * width
    if left - 1 <= at <= left + width + 1:
        canvas.draw_lines(canvas.line_batch(np.array([[(at, bottom), (at, bottom + height)]])), 2.0, CURRENT_FRAME)
    canvas.text(str(first), left, bottom - 14 * scale, size=10)
    canvas.text(str(last), left + width - canvas.text_width(str(last), size=10), bottom - 14 * scale, size=10)


def _draw_curves(table: "FrameTable", x: np.ndarray, left: float, bottom: float, height: float) -> None:
    scale, label_x = bpy.context.preferences.system.ui_scale, left
    middle = np.array([[(x[0], bottom + height / 2), (x[-1], bottom + height / 2)]])
    canvas.draw_lines(canvas.line_batch(middle), 1.0, (1.0, 1.0, 1.0, 0.2))
    for name, title, colour in CURVES:
        height_of, usual = layers.graph_curve(table.values[name])
        segments = canvas.chain(np.stack([x, bottom + height * height_of], axis=1))
        segments = segments[np.isfinite(segments).all(axis=(1, 2))]
        label = f"{title} {usual:.2g}"
        width = canvas.text_width(label, size=11)
        if len(segments):
            canvas.draw_lines(canvas.line_batch(segments), 1.5, colour)
            if label_x + width < x[-1]:
                canvas.text(label, label_x, bottom + height + 6 * scale, colour, size=11)
                label_x += width + 16 * scale


def draw_corrections(correcting: Any, view: str, frame: int, sheet: Canvas) -> None:
    """Draw the corrections of a view in a frame: removed trajectories as crosses, regions as outlines; also the region being clicked."""
    for i, correction in enumerate(correcting.corrections):
        if correction.view != view or not correction.first <= frame <= max(correction.first, correction.last):
            continue
        corners = sheet.to_region(np.array([(c.x, c.y) for c in correction.corners]))
        segments = canvas.chain(corners, closed=True) if correction.kind == "region" else canvas.cross(corners[0], 8.0)
        canvas.draw_lines(canvas.line_batch(segments), 2.0, ACTIVE_CORRECTION if i == correcting.active else CORRECTION)
    region_view, clicked = get_session().file.region_corners
    if region_view == view and clicked:
        corners = sheet.to_region(np.array(clicked))
        dots = [canvas.ring(corner, 4.0, 8) for corner in corners]
        canvas.draw_lines(canvas.line_batch(np.concatenate([canvas.chain(corners), *dots])), 2.0, ACTIVE_CORRECTION)


def draw_pulled(pulled: Pulled | None, view: str, frame: int, sheet: Canvas) -> None:
    """Draw the limb whose joint is being dragged as it would be: its bones, the outline of its skin, and a line to where it was fitted."""
    if pulled is None or pulled.frame != frame or view not in pulled.joint_px:
        return
    with sheet.image_space():
        for segments, width, colour in ((pulled.bones_px, 1.5, PULLED_BONES), (pulled.outline_px, 2.0, PULLED)):
            if len(segments[view]):
                canvas.draw_lines(canvas.line_batch(segments[view]), width, colour)
    fitted, now = sheet.to_region(pulled.joint_px[view])
    canvas.draw_lines(canvas.line_batch(np.concatenate([[(fitted, now)], canvas.ring(now, 5.0, 12)])), 2.0, ACTIVE_CORRECTION)
    canvas.text(pulled.name, now[0] + 9.0, now[1] + 6.0, ACTIVE_CORRECTION, size=12)
