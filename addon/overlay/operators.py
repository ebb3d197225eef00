"""bpy.ops.tricap.look_closer(): point at something over the footage and read what is known of it."""

import bpy
import numpy as np

from .. import status
from . import canvas, draw, layers, recording

PIXELS = 14.0  # of the screen, around the pointer


class LookCloser(bpy.types.Operator):
    """Point at the footage: the nearest matched point tells its sigma and shows its patches in all views (white: where matching starts,
    green: as it was matched), the nearest trajectory why it was removed. Click keeps that on show, Esc ends"""

    bl_idname = "tricap.look_closer"
    bl_label = "Look Closer"

    running = False

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """In a view, after a run."""
        clip = canvas.clip_of(context.area) if context.area is not None else None
        return clip is not None and bool(recording.view_of(clip)) and not cls.running

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Follow the pointer."""
        if recording.current(context.scene) is None:
            self.report({"ERROR"}, f"There is nothing to look at: {recording.problem()}")
            return {"CANCELLED"}
        LookCloser.running = True
        status.tell(context, "Point at the footage    Click: keep it on show    Esc: end")
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Look where the pointer is."""
        if event.type in ("ESC", "RIGHTMOUSE") and event.value == "PRESS":
            draw.show_looked(-1, None)
            return self._end(context, {"CANCELLED"})
        place = pointed(context, event)
        if event.type == "MOUSEMOVE" and place is not None:
            view, xy, reach = place
            run = recording.current(context.scene)
            frame = context.scene.frame_current
            draw.show_looked(frame, layers.look(run, view, frame, xy, reach) if run is not None else None)
            canvas.redraw_clips(context, pictures_only=True)
        if event.type == "LEFTMOUSE" and event.value == "PRESS" and place is not None:
            return self._end(context, {"FINISHED"})
        return {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator."""
        self._end(context, {"CANCELLED"})

    def _end(self, context: bpy.types.Context, how: set[str]) -> set[str]:
        LookCloser.running = False
        status.tell(context, None)
        canvas.redraw_clips(context)
        return how


def pointed(context: bpy.types.Context, event: bpy.types.Event) -> tuple[str, np.ndarray, float] | None:
    """The view under the pointer, the pixel there, and how many image pixels PIXELS of the screen are."""
    area = canvas.area_under(context.window, event.mouse_x, event.mouse_y)
    clip = canvas.clip_of(area) if area is not None else None
    view = recording.view_of(clip) if clip is not None else ""
    if area is None or clip is None or not view:
        return None
    region = canvas.window_region(area)
    sheet = canvas.Canvas(region, tuple(clip.size))
    return view, sheet.to_image((event.mouse_x - region.x, event.mouse_y - region.y)), PIXELS / max(sheet.zoom, 1e-6)


CLASSES = (LookCloser,)
