"""Draws over the footage while clicking: the name at the mouse, the figure, epipolar lines, and proposals."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import bpy
import numpy as np

from ...core.body.model_file import read_model
from ...core.body.skeleton import joint_positions
from ..overlay import canvas
from ..overlay.canvas import Canvas, Colour
from ..session import get_session
from .click_session import ClickSession

CURRENT: Colour = (1.0, 0.75, 0.1, 1.0)
OFFER: Colour = (0.3, 1.0, 0.45, 1.0)
LINES: tuple[Colour, ...] = ((0.35, 0.8, 1.0, 0.9), (1.0, 0.5, 0.9, 0.9), (1.0, 0.9, 0.4, 0.9), (0.6, 0.6, 1.0, 0.9))
BACKING: Colour = (0.05, 0.05, 0.05, 0.65)
BODY: Colour = (0.75, 0.75, 0.78, 1.0)
DONE: Colour = (0.3, 0.9, 0.4, 1.0)
MISSING: Colour = (0.25, 0.25, 0.28, 1.0)
FIGURE_PX, MARGIN_PX, TIMELINE_PX = 190.0, 12.0, 22.0
OFFER_PX = 11.0
NAME_PX, UNDER_MOUSE_PX = 11.0, 12.0
MARK = 6.0  # half the size of a mark, in pixels of the region
GAP = 3.0  # between a name and its neighbours
CORNERS = 16


@dataclass(eq=False, kw_only=True)
class Drawing:
    """What is drawn: the clicks of a session, with the name at the mouse (in window pixels)."""

    clicks: ClickSession
    handle: Any = None  # Blender's
    mouse: tuple[int, int] = (-1, -1)


def begin(clicks: ClickSession) -> None:
    """Draw these clicks from now on."""
    end()
    drawing = get_session().click_drawing = Drawing(clicks=clicks)
    drawing.handle = bpy.types.SpaceClipEditor.draw_handler_add(_draw, (drawing,), "WINDOW", "POST_PIXEL")


def end() -> None:
    """Draw nothing more."""
    session = get_session()
    if session.click_drawing is not None:
        bpy.types.SpaceClipEditor.draw_handler_remove(session.click_drawing.handle, "WINDOW")
    session.click_drawing = None


def move_mouse(x: int, y: int) -> None:
    """Draw the name at the mouse, in window pixels."""
    drawing = get_session().click_drawing
    if drawing is not None:
        drawing.mouse = (x, y)


def _draw(drawing: Drawing) -> None:
    clicks, context = drawing.clicks, bpy.context
    clip = canvas.clip_of(context.area)
    view = clicks.view_of(clip) if clicks.has_all_clips else None
    if view is not None and clip is not None:
        draw_session(clicks, view, Canvas(context.region, tuple(clip.size)), drawing.mouse)


def draw_session(session: ClickSession, view: str, sheet: Canvas, mouse: tuple[int, int]) -> None:
    """Draw a session in one region."""
    for other, curve in session.curves(view).items():
        colour = LINES[session.views.index(other) % len(LINES)]
        canvas.draw_lines(canvas.line_batch(canvas.chain(sheet.to_region(curve))), 1.5, colour)
    x, y = mouse[0] - sheet.region.x, mouse[1] - sheet.region.y
    _draw_others(session, view, sheet, np.array([x, y]))
    at = session.clicks().get(view)
    if at is not None:
        canvas.draw_lines(canvas.line_batch(canvas.cross(sheet.to_region(at), 12.0, 3.0)), 2.0, CURRENT)
    offer = session.proposals.get(view)
    if offer is not None:
        centre = sheet.to_region(offer.xy_px)
        parts = np.concatenate([canvas.ring(centre, OFFER_PX), canvas.cross(centre, OFFER_PX + 5, OFFER_PX - 4)])
        canvas.draw_lines(canvas.line_batch(parts), 2.0, OFFER)
        canvas.text(f"{session.name}? ±{max(offer.sigma_px, 0.1):.1f} px", centre[0] + OFFER_PX + 6, centre[1] - 20, OFFER, size=11)
    _draw_headline(session, view, sheet)
    here = [at, offer.xy_px if offer is not None else None]
    draw_figure(session, sheet, [np.array([x, y]), *(sheet.to_region(xy) for xy in here if xy is not None)])
    if session.name and 0 <= x < sheet.region.width and 0 <= y < sheet.region.height:
        canvas.text(session.name, x + 16, y + 10, CURRENT, size=15)


def _draw_others(session: ClickSession, view: str, sheet: Canvas, mouse: np.ndarray) -> None:
    """The other clicks of this frame. (Blender's own markers are also shown in frames without clicks.)

    With names, as far as there is room for them; the name under the mouse is always drawn.
    """
    names = session.names[: session.index + 1] if session.endless else session.names
    clicked = {name: at for name in names if name != session.name and (at := session.clicks(name).get(view)) is not None}
    if not clicked:
        return
    marks = sheet.to_region(np.array([*clicked.values()]))
    widths = np.array([canvas.text_width(name, size=NAME_PX) for name in clicked])
    height, region = canvas.text_height(size=NAME_PX), (sheet.region.width, sheet.region.height)
    corners = place_labels(marks, widths, height, region)
    near = int(np.linalg.norm(marks - mouse, axis=1).argmin())
    for i, name in enumerate(clicked):
        canvas.draw_lines(canvas.line_batch(canvas.cross(marks[i], MARK)), 1.5, DONE)
        if np.isfinite(corners[i]).all():
            canvas.text(name, *corners[i], DONE, size=NAME_PX)
        elif i == near and np.linalg.norm(marks[i] - mouse) < UNDER_MOUSE_PX:
            x, y = marks[i] + (-10.0, -3 * height)
            canvas.fill(canvas.rectangle(x - 3, y - 4, widths[i] + 6, height + 8), BACKING)
            canvas.text(name, x, y, DONE, size=NAME_PX)


def headline(session: ClickSession, view: str) -> str:
    """What to do in a view."""
    if not session.name:
        return "All joints are clicked"
    what = session.name if session.endless else f"{session.name} ({session.index + 1}/{len(session.names)})"
    if view in session.clicks():
        return f"{what}: clicked"
    if view in session.proposals:
        return f"{what}: Return accepts the ring"
    if session.asking:
        return f"{what}: searching…"
    if session.clicks():
        return f"{what}: click on the line" if session.curves(view) else f"{what}: click in this view too"
    return f"{what}: click"


def _draw_headline(session: ClickSession, view: str, sheet: Canvas) -> None:
    scale = bpy.context.preferences.system.ui_scale
    top = sheet.region.height - 60 * scale
    canvas.text(f"View {view}   frame {session.frame}", 14 * scale + _left(sheet), top, (0.85, 0.85, 0.85, 1.0), size=12)
    canvas.text(headline(session, view), 14 * scale + _left(sheet), top - 20 * scale, CURRENT, size=14)
    if session.problem:
        canvas.text(session.problem, 14 * scale + _left(sheet), top - 40 * scale, (1.0, 0.5, 0.4, 1.0), size=11)


def _left(sheet: Canvas) -> float:
    """Width of the toolbar, which covers the left of the region."""
    tools = [r for r in bpy.context.area.regions if r.type == "TOOLS" and r.width > 1] if bpy.context.area else []
    return float(sum(r.width for r in tools if r.x < sheet.region.x + r.width))


def _right(sheet: Canvas) -> float:
    """Width of the sidebar, which covers the right of the region."""
    sides = [r for r in bpy.context.area.regions if r.type == "UI" and r.width > 1] if bpy.context.area else []
    return float(sum(r.width for r in sides if r.x < sheet.region.x + sheet.region.width))


def draw_figure(session: ClickSession, sheet: Canvas, places: Sequence[np.ndarray] = ()) -> None:
    """The figure in the lower left corner, or in the right one while it would cover one of these places (2,): the current joint has a
    ring, clicked ones are green."""
    shape, scale = figure(), bpy.context.preferences.system.ui_scale
    size = min(FIGURE_PX * scale, 0.4 * sheet.region.height)
    drawn = [name for name in session.names if name in shape.joints]
    if not drawn or size < 60:
        return
    width, foot = shape.width * size + 24 * scale, 18 * scale
    extent, y = np.array([width, size + foot + 12 * scale]), (MARGIN_PX + TIMELINE_PX) * scale
    left, right = MARGIN_PX * scale + _left(sheet), sheet.region.width - MARGIN_PX * scale - _right(sheet) - width
    corner = clear_corner(left, right, y, extent, places)
    canvas.fill(canvas.rectangle(*corner, *extent), BACKING)
    base = corner + (12 * scale, foot + 4 * scale)
    canvas.fill(base + size * shape.triangles, BODY)
    for name in drawn:
        clicked = len(session.clicks(name))
        colour = CURRENT if name == session.name else DONE if clicked > 1 else MISSING
        canvas.fill(_dot(base + size * shape.joints[name], (4.5 if name == session.name else 3.0) * scale), colour)
    if session.name in shape.joints:
        at = base + size * shape.joints[session.name]
        canvas.draw_lines(canvas.line_batch(canvas.ring(at, 9 * scale)), 2.5, CURRENT)
    canvas.text("R", base[0], corner[1] + 6 * scale, (0.8, 0.8, 0.8, 1.0), size=11)
    canvas.text("L", base[0] + shape.width * size - 8 * scale, corner[1] + 6 * scale, (0.8, 0.8, 0.8, 1.0), size=11)


def clear_corner(left: float, right: float, y: float, extent: np.ndarray, places: Sequence[np.ndarray]) -> np.ndarray:
    """The lower left corner (2,) of a box of this extent (2,) at the left, or at the right if one of the places (2,) is under the left one
    and none under the right one."""
    corners = [np.array([x, y]) for x in (left, right)]
    free = [not any(((place >= corner) & (place <= corner + extent)).all() for place in places) for corner in corners]
    return corners[1] if free == [False, True] else corners[0]


def _dot(centre: np.ndarray, radius: float, corners: int = 12) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, corners + 1)
    rim = centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.stack([np.broadcast_to(centre, rim[1:].shape), rim[:-1], rim[1:]], axis=1)


def place_labels(marks: np.ndarray, widths: np.ndarray, height: float, region: tuple[float, float]) -> np.ndarray:
    """Lower left corners (N, 2) for names of these widths (N,) next to their marks (N, 2), so that none overlaps another name or a mark;
    NaN for a name without room.

    Earlier names take precedence. All in pixels of a region of this width and height.
    """
    found, taken = np.full((len(marks), 2), np.nan), np.concatenate([marks - MARK, marks + MARK], axis=1)
    for i, (mark, width) in enumerate(zip(marks, widths)):
        corners = mark + _around(width, height)
        boxes = np.concatenate([corners - GAP / 2, corners + (width + GAP / 2, height + GAP / 2)], axis=1)
        inside = (boxes[:, :2] >= 0).all(axis=1) & (boxes[:, 2:] <= region).all(axis=1)
        apart = (boxes[:, None, 2:] <= taken[:, :2]) | (boxes[:, None, :2] >= taken[:, 2:])
        free = np.flatnonzero(inside & apart.any(axis=2).all(axis=1))
        if len(free):
            found[i], taken = corners[free[0]], np.concatenate([taken, boxes[free[:1]]])
    return found


def _around(width: float, height: float) -> np.ndarray:
    """Corners (K, 2) of a name around a mark: above it first, clear of Blender's marker and its handle, then at its sides, then below."""
    near, high = MARK + GAP, 18.0
    return np.array([(-10.0, high), (near, -height / 2), (-near - width, -height / 2), (near - width, high), (-width / 2, -near - height),
                     (near, near), (-near - width, near), (near, -near - height), (-near - width, -near - height)])  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Figure:
    """The figure, of height 1, seen from the front; x to the right, y up, the origin at its lower left."""

    triangles: np.ndarray  # (N, 3, 2)
    joints: dict[str, np.ndarray]  # (2,) by name
    width: float


@cache
def figure() -> Figure:
    """The whole-body model in its rest pose. The person faces −y of the world and is drawn from there, so its right side is on the left."""
    model = read_model("full")
    skeleton = model.skeleton
    lengths = np.array([bone.nominal_length_m for bone in skeleton.bones])
    places = {name: X[[0, 2]] for name, X in joint_positions(skeleton, lengths, np.zeros(len(skeleton.dof_names))).items()}
    limbs = [(places[b.head_joint], places[b.tail_joint], radii[:, 0]) for b, radii in zip(skeleton.bones, model.visible_radii_m)]
    outline = np.concatenate([_limb(a, b, r) for a, b, r in limbs if np.isfinite(r).all()])
    low, high = outline.reshape(-1, 2).min(axis=0), outline.reshape(-1, 2).max(axis=0)
    size = high[1] - low[1]
    return Figure(
        triangles=(outline - low) / size,
        joints={name: (p - low) / size for name, p in places.items()},
        width=float((high[0] - low[0]) / size),
    )


def _limb(a: np.ndarray, b: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """A bone's silhouette as triangles (N, 3, 2): discs at 1/6, 1/2 and 5/6 of its length, and the area between them."""
    centres = [a + share * (b - a) for share in (0.0, 1 / 6, 0.5, 5 / 6, 1.0)]
    widths = [0.8 * radii[0], *radii, 0.8 * radii[2]]
    along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    across = np.array([-along[1], along[0]])
    parts = [_disc(c, w) for c, w in zip(centres, widths)]
    for (c, w), (d, v) in zip(zip(centres, widths), zip(centres[1:], widths[1:])):
        p, q, r, s = c - w * across, c + w * across, d + v * across, d - v * across
        parts.append(np.array([[p, q, r], [p, r, s]]))
    return np.concatenate(parts)


def _disc(centre: np.ndarray, radius: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, CORNERS + 1)
    rim = centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.stack([np.broadcast_to(centre, rim[1:].shape), rim[:-1], rim[1:]], axis=1)
