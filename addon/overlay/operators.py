"""bpy.ops.tricap.look_closer(): point at the footage and read what was measured there; bpy.ops.tricap.follow_contours(view="C")"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ...core.foundation.progress import Monitor
from ...core.run.settings import Overrides
from .. import project
from ..jobs import JobOperator
from ..panels import show_status
from ..session import get_session
from . import canvas, draw, layers, results

if TYPE_CHECKING:
    from ...core.run.outlines import Start

REACH_SCREEN_PX = 14.0  # around the pointer


class InspectPoints(bpy.types.Operator):
    """Point at the footage to see the sigma of the nearest matched point and its patches in all views (white: where matching started,
    green: where it ended), and why the nearest trajectory was removed. Click to leave it shown, Esc to end"""

    bl_idname = "tricap.look_closer"
    bl_label = "Inspect Points"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """In a view, after a run."""
        clip = canvas.clip_of(context.area) if context.area is not None else None
        return clip is not None and bool(results.view_of(clip)) and not get_session().file.inspecting

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Follow the pointer."""
        if results.current(context.scene) is None:
            self.report({"ERROR"}, f"There is nothing to inspect: {results.problem()}")
            return {"CANCELLED"}
        get_session().file.inspecting = True
        show_status(context, "Point at the footage    Click: leave it shown    Esc: end")
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Inspect what is under the pointer."""
        if event.type in ("ESC", "RIGHTMOUSE") and event.value == "PRESS":
            draw.show_inspection(-1, None)
            return self._end(context, {"CANCELLED"})
        place = pointed(context, event)
        if event.type == "MOUSEMOVE" and place is not None:
            view, xy, reach = place
            run = results.current(context.scene)
            frame = context.scene.frame_current
            draw.show_inspection(frame, layers.inspect(run, view, frame, xy, reach) if run is not None else None)
            canvas.redraw_clips(context, pictures_only=True)
        if event.type == "LEFTMOUSE" and event.value == "PRESS" and place is not None:
            return self._end(context, {"FINISHED"})
        return {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator."""
        self._end(context, {"CANCELLED"})

    def _end(self, context: bpy.types.Context, how: set[str]) -> set[str]:
        get_session().file.inspecting = False
        show_status(context, None)
        canvas.redraw_clips(context)
        return how


def pointed(context: bpy.types.Context, event: bpy.types.Event) -> tuple[str, np.ndarray, float] | None:
    """The view under the pointer, the pixel there, and how many image pixels REACH_SCREEN_PX are."""
    area = canvas.area_under(context.window, event.mouse_x, event.mouse_y)
    clip = canvas.clip_of(area) if area is not None else None
    view = results.view_of(clip) if clip is not None else ""
    if area is None or clip is None or not view:
        return None
    region = canvas.window_region(area)
    sheet = canvas.Canvas(region, tuple(clip.size))
    return view, sheet.to_image((event.mouse_x - region.x, event.mouse_y - region.y)), REACH_SCREEN_PX / max(sheet.zoom, 1e-6)


class FollowContours(JobOperator, bpy.types.Operator):
    """Track the outline of the person through the frames of a view; steps Surface and Tracks run first if need be. Step Body fits it"""

    bl_idname = "tricap.follow_contours"
    bl_label = "Track Outline"
    bl_options = {"UNDO"}
    step = "tracks"

    view: bpy.props.StringProperty(name="View", description="Name of the view; empty: all views")  # type: ignore[valid-type]
    from_body: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="From Fitted Body", description="Start from the outline of the fitted body instead of the measured surface"
    )

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], list[str]]:
        """Read folders and settings; write the project's take.toml."""
        from ...core.run.outlines import Start

        take, out, overrides = project.chosen(context.scene, "", "")
        view, start = self.view, Start(body=self.from_body)
        return lambda monitor: track_outline(take, out, overrides, view, monitor, start)

    def finish(self, context: bpy.types.Context, result: list[str]) -> set[str]:
        """Show the outline and report what was found."""
        for sentence in result:
            self.report({"INFO"}, sentence)
        results.clear()
        context.scene.tricap_overlay.contour = True
        canvas.redraw_clips(context)
        return {"FINISHED"}


def track_outline(take: Path, out: Path, overrides: Overrides, view: str, monitor: Monitor, start: "Start") -> list[str]:
    """The computation, without bpy: a sentence for each view."""
    from ...core.cli.contour import write_contours
    from ...core.run.take_run import open_run

    with open_run(take, out, overrides, for_contours=True, needs_body=start.body) as run:
        names = [view] if view else [v.name for v in run.footage.take.views]
        return [*write_contours(run, names, monitor, start), *run.notes]


CLASSES = (InspectPoints, FollowContours)
