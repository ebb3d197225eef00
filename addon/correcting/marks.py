"""Draws the corrections over the footage: removed trajectories as crosses, regions as red outlines, and the region being clicked."""

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np

from ..overlay import canvas, recording
from ..overlay.canvas import Canvas, Colour

MARK: Colour = (1.0, 0.25, 0.2, 1.0)
CHOSEN: Colour = (1.0, 0.85, 0.3, 1.0)

_handle: list[Any] = []
_open: dict[str, Any] = {"view": "", "corners": []}


def begin() -> None:
    """Draw from now on."""
    _handle.append(bpy.types.SpaceClipEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def end() -> None:
    """Draw nothing more."""
    while _handle:
        bpy.types.SpaceClipEditor.draw_handler_remove(_handle.pop(), "WINDOW")


def show_open(view: str, corners: Sequence[tuple[float, float]]) -> None:
    """The corners clicked so far."""
    _open.update(view=view, corners=list(corners))


def _draw() -> None:
    context = bpy.context
    clip, said = canvas.clip_of(context.area), context.scene.tricap_correcting
    if clip is not None and (said.corrections or _open["corners"]):
        draw_marks(said, recording.view_of(clip), context.scene.frame_current, Canvas(context.region, tuple(clip.size)))


def draw_marks(said: Any, view: str, frame: int, sheet: Canvas) -> None:
    """The corrections of a view that concern a frame."""
    for i, correction in enumerate(said.corrections):
        if correction.view != view or not correction.first <= frame <= max(correction.first, correction.last):
            continue
        corners = sheet.to_region(np.array([(c.x, c.y) for c in correction.corners]))
        segments = canvas.chain(corners, closed=True) if correction.kind == "region" else canvas.cross(corners[0], 8.0)
        canvas.draw_lines(canvas.line_batch(segments), 2.0, CHOSEN if i == said.active else MARK)
    if _open["view"] == view and _open["corners"]:
        corners = sheet.to_region(np.array(_open["corners"]))
        dots = [canvas.ring(corner, 4.0, 8) for corner in corners]
        canvas.draw_lines(canvas.line_batch(np.concatenate([canvas.chain(corners), *dots])), 2.0, CHOSEN)
