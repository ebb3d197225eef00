"""bpy.ops.tricap.remove_trajectory(view="C", frame=12, x=402, y=251), .remove_region(view="C", polygon="[[10, 10], …]"), .list_dofs()"""

import json
from typing import Any

import bpy
import numpy as np

from ...core.errors import InputError
from ...core.take_file import take_of_table
from .. import project, status
from ..overlay import canvas, draw, layers, recording
from ..overlay.operators import pointed
from . import marks, tables


class Correct:
    """Common to both corrections: a pointer in a view, and one step of undo."""

    hint = ""
    running = False

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """With footage, and one at a time."""
        return len(context.scene.tricap.views) > 0 and not Correct.running

    def begin(self, context: bpy.types.Context) -> set[str]:
        """Go modal."""
        area = context.area
        if area is None or canvas.clip_of(area) is None:
            self.report({"ERROR"}, "Press this in the sidebar of a Clip Editor that shows a view: Open the Views makes them.")  # type: ignore[attr-defined]
            return {"CANCELLED"}
        Correct.running = True
        status.tell(context, self.hint)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def end(self, context: bpy.types.Context, how: set[str]) -> set[str]:
        """Nothing is watched any more."""
        Correct.running = False
        marks.show_open("", [])
        draw.show_looked(-1, None)
        status.tell(context, None)
        canvas.redraw_clips(context)
        return how

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator."""
        self.end(context, {"CANCELLED"})

    def put(self, context: bpy.types.Context, kind: str, view: str, frames: tuple[int, int], corners: Any) -> bool:
        """Add a correction if take.toml can hold it; else say why."""
        try:
            if view not in project.clips_of(context.scene):
                raise InputError(f"There is no view “{view}”.")
            tables.add(context.scene, kind, view, *frames, corners)
            try:
                take_of_table(project.folder_of(context.scene), project.table(context.scene))
            except InputError:
                said = context.scene.tricap_correcting.corrections
                said.remove(len(said) - 1)
                raise
        except InputError as error:
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return False
        canvas.redraw_clips(context)
        return True


class RemoveTrajectory(Correct, bpy.types.Operator):
    """Click trajectories that are wrong: the nearest one is taken out, in all frames, when the tracks are made again"""

    bl_idname = "tricap.remove_trajectory"
    bl_label = "Remove Trajectories"
    bl_options = {"REGISTER", "UNDO"}
    hint = "Click: take out the nearest trajectory    Backspace: not the last one    Esc: done"

    view: bpy.props.StringProperty(name="View", description="Name of the view")  # type: ignore[valid-type]
    frame: bpy.props.IntProperty(name="Frame", default=-1, min=-1, description="−1: the present frame")  # type: ignore[valid-type]
    x: bpy.props.FloatProperty(name="X", description="Pixels from the middle of the left column")  # type: ignore[valid-type]
    y: bpy.props.FloatProperty(name="Y", description="Pixels from the middle of the top row, downwards")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add one correction."""
        frame = context.scene.frame_current if self.frame < 0 else self.frame
        return {"FINISHED"} if self.put(context, "trajectory", self.view, (frame, frame), [(self.x, self.y)]) else {"CANCELLED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Click one after the other."""
        run = recording.current(context.scene)
        if run is None or run.tracks() is None:
            self.report({"ERROR"}, f"There are no trajectories yet. {recording.problem()}".strip())
            return {"CANCELLED"}
        self.added = 0
        return self.begin(context)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show what is nearest; take it out by a click."""
        if event.type in ("ESC", "RET", "NUMPAD_ENTER") and event.value == "PRESS":
            return self.end(context, {"FINISHED"} if self.added else {"CANCELLED"})
        run, place = recording.current(context.scene), pointed(context, event)
        if run is None or place is None:
            return {"PASS_THROUGH"}
        view, xy, reach = place
        frame, said = context.scene.frame_current, context.scene.tricap_correcting.corrections
        if event.type == "MOUSEMOVE":
            draw.show_looked(frame, layers.look(run, view, frame, xy, reach))
            canvas.redraw_clips(context, pictures_only=True)
        elif event.type == "BACK_SPACE" and event.value == "PRESS" and self.added:
            said.remove(len(said) - 1)
            self.added -= 1
            canvas.redraw_clips(context)
        elif event.type == "LEFTMOUSE" and event.value == "PRESS":
            at = layers.track_place(run, view, frame, xy, reach)
            if at is None:
                self.report({"WARNING"}, "There is no trajectory near the click; zoom in and click on it.")
            elif self.put(context, "trajectory", view, (frame, frame), [np.round(at, 2)]):
                self.added += 1
            return {"RUNNING_MODAL"}
        return {"PASS_THROUGH"}


class RemoveRegion(Correct, bpy.types.Operator):
    """Click the corners of a region in a view: what is measured inside it is left out, from clouds, tracks and body"""

    bl_idname = "tricap.remove_region"
    bl_label = "Leave Out a Region"
    bl_options = {"REGISTER", "UNDO"}
    hint = "Click: a corner    Return / right click: close the region    Backspace: not the last corner    Esc: no region"

    view: bpy.props.StringProperty(name="View", description="Name of the view")  # type: ignore[valid-type]
    first: bpy.props.IntProperty(name="From", default=-1, min=-1, description="First frame; −1: of the recording")  # type: ignore[valid-type]
    last: bpy.props.IntProperty(name="To", default=-1, min=-1, description="Last frame; −1: of the recording")  # type: ignore[valid-type]
    polygon: bpy.props.StringProperty(name="Polygon", description="Corners in pixels, as [[x, y], …]")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add one correction."""
        try:
            corners = [(float(x), float(y)) for x, y in json.loads(self.polygon)]
        except (ValueError, TypeError):
            self.report({"ERROR"}, f"The polygon {self.polygon!r} is no list of corners; write it as [[x, y], [x, y], [x, y]].")
            return {"CANCELLED"}
        low, high = footage_frames(context.scene)
        frames = (low if self.first < 0 else self.first, high if self.last < 0 else self.last)
        if frames[1] < frames[0]:
            self.report({"ERROR"}, f"The region goes from frame {frames[0]} to {frames[1]}; the first must not be later than the last.")
            return {"CANCELLED"}
        return {"FINISHED"} if self.put(context, "region", self.view, frames, corners) else {"CANCELLED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Click corner after corner."""
        self.corners: list[tuple[float, float]] = []
        self.mine = ""
        return self.begin(context)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Collect corners; close the region."""
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
        marks.show_open(self.mine, self.corners)
        canvas.redraw_clips(context)
        return {"RUNNING_MODAL"}

    def _close(self, context: bpy.types.Context) -> set[str]:
        if len(self.corners) < 3:
            self.report({"WARNING"}, "A region needs three corners at least.")
            return {"RUNNING_MODAL"}
        frame = context.scene.frame_current
        one = context.scene.tricap_correcting.region_frames == "one"
        done = self.put(context, "region", self.mine, (frame, frame) if one else footage_frames(context.scene), self.corners)
        return self.end(context, {"FINISHED"} if done else {"CANCELLED"})


class RemoveCorrection(bpy.types.Operator):
    """Take this correction back"""

    bl_idname = "tricap.remove_correction"
    bl_label = "Take Back"
    bl_options = {"REGISTER", "UNDO"}

    index: bpy.props.IntProperty(name="Index", default=-1, description="Place in the list; −1: the chosen one")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove it from the list."""
        said = context.scene.tricap_correcting
        index = said.active if self.index < 0 else self.index
        if not 0 <= index < len(said.corrections):
            self.report({"ERROR"}, f"There is no correction number {index}.")
            return {"CANCELLED"}
        said.corrections.remove(index)
        said.active = min(said.active, max(len(said.corrections) - 1, 0))
        canvas.redraw_clips(context)
        return {"FINISHED"}


class ListDofs(bpy.types.Operator):
    """List the body model's degrees of freedom, to lock some at rest or to change their limits; the values begin as the model has them"""

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
    """First and last frame that any view has."""
    clips = list(project.clips_of(scene).values())
    return max(0, min(c.frame_start for c in clips)), max(c.frame_start + c.frame_duration - 1 for c in clips)


def stop_correcting() -> None:
    """A correction under way ends with its class."""
    Correct.running = False


CLASSES = (RemoveTrajectory, RemoveRegion, RemoveCorrection, ListDofs)
