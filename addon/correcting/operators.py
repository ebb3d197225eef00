"""bpy.ops.tricap.remove_trajectory(view="C", frame=12, x=402, y=251), .remove_region(view="C", polygon="[[10, 10], …]"), .list_dofs()"""

import json
from typing import Any

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.take.writing import take_of_table
from .. import project
from ..overlay import canvas, draw, layers, results
from ..overlay.operators import pointed
from ..panels import show_status
from ..session import get_session
from . import tables


class Correct:
    """Common to both corrections: clicks in a view, and one undo step."""

    hint = ""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """With footage, and while no other correction runs."""
        return len(context.scene.tricap.views) > 0 and not get_session().file.correcting

    def begin(self, context: bpy.types.Context) -> set[str]:
        """Go modal."""
        area = context.area
        if area is None or canvas.clip_of(area) is None:
            self.report({"ERROR"}, "Press this in the sidebar of a Clip Editor that shows a view; Open Views opens one for each view.")  # type: ignore[attr-defined]
            return {"CANCELLED"}
        get_session().file.correcting = True
        show_status(context, self.hint)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def end(self, context: bpy.types.Context, how: set[str]) -> set[str]:
        """Leave the modal state."""
        get_session().file.correcting = False
        draw.show_region("", [])
        draw.show_inspection(-1, None)
        show_status(context, None)
        canvas.redraw_clips(context)
        return how

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator."""
        self.end(context, {"CANCELLED"})

    def add(self, context: bpy.types.Context, kind: str, view: str, frames: tuple[int, int], corners: Any) -> bool:
        """Add a correction if it is valid in take.toml; otherwise report why not."""
        try:
            if view not in project.clips_of(context.scene):
                raise InputError(f"There is no view “{view}”.")
            tables.add(context.scene, kind, view, *frames, corners)
            try:
                take_of_table(project.folder_of(context.scene), project.table(context.scene))
            except InputError:
                corrections = context.scene.tricap_correcting.corrections
                corrections.remove(len(corrections) - 1)
                raise
        except InputError as error:
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return False
        canvas.redraw_clips(context)
        return True


class CorrectAtPixel(Correct):
    """Mix-in: a correction that concerns one pixel of a view in one frame."""

    view: bpy.props.StringProperty(name="View", description="Name of the view")  # type: ignore[valid-type]
    frame: bpy.props.IntProperty(name="Frame", default=-1, min=-1, description="−1: the current frame")  # type: ignore[valid-type]
    x: bpy.props.FloatProperty(name="X", description="In pixels, 0 at the centre of the left column")  # type: ignore[valid-type]
    y: bpy.props.FloatProperty(name="Y", description="In pixels, 0 at the centre of the top row, downwards")  # type: ignore[valid-type]

    def frame_of(self, context: bpy.types.Context) -> int:
        """The frame that is meant."""
        frame: int = context.scene.frame_current if self.frame < 0 else self.frame
        return frame


class RemoveTrajectory(CorrectAtPixel, bpy.types.Operator):
    """Click wrong trajectories: the nearest one is removed in all frames when step Tracks runs again"""

    bl_idname = "tricap.remove_trajectory"
    bl_label = "Remove Trajectories"
    bl_options = {"REGISTER", "UNDO"}
    hint = "Click: remove the nearest trajectory    Backspace: undo the last one    Esc: finish"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add one correction."""
        frame = self.frame_of(context)
        return {"FINISHED"} if self.add(context, "trajectory", self.view, (frame, frame), [(self.x, self.y)]) else {"CANCELLED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start clicking."""
        run = results.current(context.scene)
        if run is None or run.tracks() is None:
            self.report({"ERROR"}, f"There are no trajectories yet. {results.problem()}".strip())
            return {"CANCELLED"}
        self.added = 0
        return self.begin(context)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the nearest trajectory; remove it on a click."""
        if event.type in ("ESC", "RET", "NUMPAD_ENTER") and event.value == "PRESS":
            return self.end(context, {"FINISHED"} if self.added else {"CANCELLED"})
        run, place = results.current(context.scene), pointed(context, event)
        if run is None or place is None:
            return {"PASS_THROUGH"}
        view, xy, reach = place
        frame, corrections = context.scene.frame_current, context.scene.tricap_correcting.corrections
        if event.type == "MOUSEMOVE":
            draw.show_inspection(frame, layers.inspect(run, view, frame, xy, reach))
            canvas.redraw_clips(context, pictures_only=True)
        elif event.type == "BACK_SPACE" and event.value == "PRESS" and self.added:
            corrections.remove(len(corrections) - 1)
            self.added -= 1
            canvas.redraw_clips(context)
        elif event.type == "LEFTMOUSE" and event.value == "PRESS":
            at = layers.track_place(run, view, frame, xy, reach)
            if at is None:
                self.report({"WARNING"}, "There is no trajectory near the click; zoom in and click on one.")
            elif self.add(context, "trajectory", view, (frame, frame), [np.round(at, 2)]):
                self.added += 1
            return {"RUNNING_MODAL"}
        return {"PASS_THROUGH"}


class RemoveRegion(Correct, bpy.types.Operator):
    """Click the corners of a region in a view: everything measured inside it is excluded from clouds, tracks and body"""

    bl_idname = "tricap.remove_region"
    bl_label = "Exclude Region"
    bl_options = {"REGISTER", "UNDO"}
    hint = "Click: add a corner    Return / right click: close the region    Backspace: undo the last corner    Esc: cancel"

    view: bpy.props.StringProperty(name="View", description="Name of the view")  # type: ignore[valid-type]
    first: bpy.props.IntProperty(name="From", default=-1, min=-1, description="First frame; −1: the first of the footage")  # type: ignore[valid-type]
    last: bpy.props.IntProperty(name="To", default=-1, min=-1, description="Last frame; −1: the last of the footage")  # type: ignore[valid-type]
    polygon: bpy.props.StringProperty(name="Polygon", description="Corners in pixels, as [[x, y], …]")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add one correction."""
        try:
            corners = [(float(x), float(y)) for x, y in json.loads(self.polygon)]
        except (ValueError, TypeError):
            self.report({"ERROR"}, f"The polygon {self.polygon!r} is not a list of corners; write it as [[x, y], [x, y], [x, y]].")
            return {"CANCELLED"}
        low, high = footage_frames(context.scene)
        first, last = (low if self.first < 0 else self.first, high if self.last < 0 else self.last)
        if last < first:
            self.report({"ERROR"}, f"The region starts in frame {first} and ends in frame {last}; it must not end before it starts.")
            return {"CANCELLED"}
        return {"FINISHED"} if self.add(context, "region", self.view, (first, last), corners) else {"CANCELLED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start clicking corners."""
        self.corners: list[tuple[float, float]] = []
        self.mine = ""
        return self.begin(context)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Add corners; close the region."""
        if event.value != "PRESS":
            return {"PASS_THROUGH"}
        if event.type == "ESC":
            return self.end(context, {"CANCELLED"})
        place = pointed(context, event)
        if place is None or (self.mine and place[0] != self.mine):
            return {"PASS_THROUGH"}
        if event.type in ("RET", "NUMPAD_ENTER", "RIGHTMOUSE"):
            return self._close(context)
        if event.type == "BACK_SPACE" and self.corners:
            self.corners.pop()
        elif event.type == "LEFTMOUSE":
            self.mine = place[0]
            self.corners.append((round(float(place[1][0]), 2), round(float(place[1][1]), 2)))
        else:
            return {"PASS_THROUGH"}
        draw.show_region(self.mine, self.corners)
        canvas.redraw_clips(context)
        return {"RUNNING_MODAL"}

    def _close(self, context: bpy.types.Context) -> set[str]:
        if len(self.corners) < 3:
            self.report({"WARNING"}, "A region needs at least three corners.")
            return {"RUNNING_MODAL"}
        frame = context.scene.frame_current
        one = context.scene.tricap_correcting.region_frames == "one"
        done = self.add(context, "region", self.mine, (frame, frame) if one else footage_frames(context.scene), self.corners)
        return self.end(context, {"FINISHED"} if done else {"CANCELLED"})


class RemoveCorrection(bpy.types.Operator):
    """Remove this correction"""

    bl_idname = "tricap.remove_correction"
    bl_label = "Remove Correction"
    bl_options = {"REGISTER", "UNDO"}

    index: bpy.props.IntProperty(name="Index", default=-1, description="Place in the list; −1: the active one")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove it from the list."""
        correcting = context.scene.tricap_correcting
        index = correcting.active if self.index < 0 else self.index
        if not 0 <= index < len(correcting.corrections):
            self.report({"ERROR"}, f"There is no correction number {index}.")
            return {"CANCELLED"}
        correcting.corrections.remove(index)
        correcting.active = min(correcting.active, max(len(correcting.corrections) - 1, 0))
        canvas.redraw_clips(context)
        return {"FINISHED"}


class ListDofs(bpy.types.Operator):
    """List the degrees of freedom of the body model, to lock them at rest or to change their limits"""

    bl_idname = "tricap.list_dofs"
    bl_label = "Locks and Limits"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Fill the list."""
        try:
            tables.list_dofs(context.scene)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


def footage_frames(scene: bpy.types.Scene) -> tuple[int, int]:
    """First and last frame of the footage of any view."""
    clips = list(project.clips_of(scene).values())
    return max(0, min(c.frame_start for c in clips)), max(c.frame_start + c.frame_duration - 1 for c in clips)


CLASSES = (RemoveTrajectory, RemoveRegion, RemoveCorrection, ListDofs)
