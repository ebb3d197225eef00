"""bpy.ops.tricap.click_joints() and .click_seeds() in the window; .click(name="elbow.R", view="C", x=430, y=260) from scripts."""

from dataclasses import replace
from functools import cache
from typing import Any

import bpy

from ...core.body.model_file import BodyModel, joint_depths_m, read_model
from ...core.foundation.errors import InputError
from ...core.run.settings import settings_of
from ...core.take.footage import open_take
from ...core.take.take import JOINTS, FrameClicks
from .. import clicks, project, properties
from ..overlay import canvas
from ..panels import show_status
from ..session import get_session
from . import draw
from .click_session import ClickSession, free_seed_names, joints_of, needed_first
from .finder import Finder

TICK_S, SNAP_PX = 0.05, 6.0
LAST_FRAME = 1_048_574  # of a scene; Blender crashes at some numbers beyond
NUMBERS = ("ONE", "TWO", "THREE", "FOUR", "FIVE", "SIX", "SEVEN", "EIGHT", "NINE")
KEYS = "Click: set    Return: accept proposals    S / right click: skip    Backspace: undo    Tab, 1…9: view    Esc: finish"


class ClickOperator:
    """A modal operator around a `ClickSession`: maps events to its methods; all others pass through (zoom, pan, G, timeline)."""

    session: ClickSession
    timer: Any = None
    visible = False  # whether a view is shown
    keys = KEYS  # in the status bar

    def names(self, context: bpy.types.Context, clips: dict[str, bpy.types.MovieClip]) -> list[str]:
        """The names to click, in order."""
        raise NotImplementedError

    def begin(self, context: bpy.types.Context) -> tuple[ClickSession, str]:
        """The session, and a warning or "".

        Raises:
            InputError: there is no footage, or nothing to click.
        """
        return begin_session(context.scene, self.names)

    def follow(self, context: bpy.types.Context) -> None:
        """React to a change of the scene's frame."""
        self.session.show_frame(context.scene.frame_current)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Begin; opens the views if no Clip Editor shows one."""
        if get_session().click_operator is not None:
            self.report({"WARNING"}, "Clicking is already active. Press Esc in a view to finish it.")  # type: ignore[attr-defined]
            return {"CANCELLED"}
        try:
            self.session, warning = self.begin(context)
        except InputError as error:
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return {"CANCELLED"}
        if warning:
            self.report({"WARNING"}, warning)  # type: ignore[attr-defined]
        if not [area for area in canvas.clip_areas(context.window) if self._view(area) is not None]:
            bpy.ops.tricap.open_views()
        draw.begin(self.session)
        draw.move_mouse(event.mouse_x, event.mouse_y)
        get_session().click_operator = self
        self.timer = context.window_manager.event_timer_add(TICK_S, window=context.window)
        context.window_manager.modal_handler_add(self)
        self._show(context)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """One event."""
        try:
            if event.type == "TIMER":
                here = any(self._view(area) is not None for area in canvas.clip_areas(context.window))
                if self.visible and not here:  # the user went to another workspace
                    return self._end(context)
                self.follow(context)
                if self.session.poll() or here != self.visible:  # splitting areas clears the status bar
                    self._show(context)
                self.visible = here
                return {"PASS_THROUGH"}
            if event.type == "MOUSEMOVE":
                draw.move_mouse(event.mouse_x, event.mouse_y)
                canvas.redraw_clips(context, pictures_only=True)
                return {"PASS_THROUGH"}
            return self._act(context, event)
        except InputError as error:
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return self._end(context)

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator (another file, quitting)."""
        self.clear(context)

    def clear(self, context: bpy.types.Context) -> None:
        """End the timer, the drawing and the finder."""
        draw.end()
        get_session().click_operator = None
        if self.session.finder is not None:
            self.session.finder.close()
        if self.timer is not None:
            context.window_manager.event_timer_remove(self.timer)
            self.timer = None
        show_status(context, None)
        canvas.redraw_clips(context)

    def _act(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        area = canvas.area_under(context.window, event.mouse_x, event.mouse_y)
        view = self._view(area) if area is not None else None
        undo = event.type == "Z" and (event.ctrl or event.oskey)
        if undo and event.value == "PRESS":
            self.session.back()
        elif event.type == "ESC" and event.value == "PRESS":
            return self._end(context)
        elif view is None or area is None:
            return {"PASS_THROUGH"}
        elif not self._act_in(area, view, event):
            return {"PASS_THROUGH"}
        if not self.session.name:
            return self._end(context)
        self._show(context)
        return {"RUNNING_MODAL"}

    def _act_in(self, area: bpy.types.Area, view: str, event: bpy.types.Event) -> bool:
        """Handle an event over a view; False if it is none of ours."""
        key, session = event.type, self.session
        ours = key in ("LEFTMOUSE", "RIGHTMOUSE", "RET", "NUMPAD_ENTER", "BACK_SPACE", "S", "TAB", *NUMBERS[: len(session.views)])
        if not ours or event.ctrl or event.alt or event.shift or event.oskey:
            return False
        if event.value != "PRESS":
            return True
        if key == "LEFTMOUSE":
            region = canvas.window_region(area)
            sheet = canvas.Canvas(region, tuple(session.clips[view].size))
            session.click(view, sheet.to_image((event.mouse_x - region.x, event.mouse_y - region.y)), SNAP_PX / max(sheet.zoom, 1e-6))
            self._turn_to_next(area, bpy.context.window)
        elif key in ("RET", "NUMPAD_ENTER"):
            session.accept()
            self._turn_to_next(area, bpy.context.window)
        elif key == "BACK_SPACE":
            session.back()
        elif key in ("S", "RIGHTMOUSE"):
            session.skip()
        else:
            shown = session.views.index(view)
            step = (shown + 1) % len(session.views) if key == "TAB" else NUMBERS.index(key)
            show_view(area, session.clips[session.views[step]])
        return True

    def _turn_to_next(self, area: bpy.types.Area, window: bpy.types.Window) -> None:
        """With a single Clip Editor, show the next view in which the joint is not clicked yet."""
        mine, wanted = [a for a in canvas.clip_areas(window) if self._view(a) is not None], self.session.next_view()
        if len(mine) == 1 and wanted is not None:
            show_view(area, self.session.clips[wanted])

    def _view(self, area: bpy.types.Area) -> str | None:
        return self.session.view_of(canvas.clip_of(area))

    def _show(self, context: bpy.types.Context) -> None:
        needed = getattr(self, "needed", "")  # of ClickJoints alone
        optional = " (optional: the buttons above the first view go on)" if needed not in ("", self.session.name) else ""
        show_status(context, f"{self.session.name}{optional}    {self.keys}")
        canvas.redraw_clips(context)

    def _end(self, context: bpy.types.Context) -> set[str]:
        self.clear(context)
        session = self.session
        if not session.changed or not session.has_all_clips:
            return {"FINISHED" if session.changed else "CANCELLED"}
        self.report({"INFO"}, self.result(len(session.names) - len(session.missing(skipped=True))))  # type: ignore[attr-defined]
        return {"FINISHED"}

    def result(self, done: int) -> str:
        """What is reported in the end; `done`: the number of names that are clicked in as many views as are needed."""
        session = self.session
        missing = "" if getattr(self, "needed", "") else _what_is_missing(session)
        clicked = f"Frame {session.frame}: {done} of {len(session.names)} clicked in two or more views."
        return f"{clicked}{missing} Go on with the buttons above the first view."


def _what_is_missing(session: ClickSession) -> str:
    """A sentence about the joints that are not clicked in two views, "" if all are."""
    missing = {} if session.endless else session.missing(skipped=True)
    named = [name if not count else f"{name} (one view only)" for name, count in missing.items()]
    return f" Missing: {', '.join(named)}." if named else ""


class ClickJoints(ClickOperator, bpy.types.Operator):
    """Click the joints of the body, one after the other, in each view. After a click in one view the others show the epipolar line of the
    joint and its probable position. In any frame other than the click frame, clicks are a keyframe for the fit"""

    bl_idname = "tricap.click_joints"
    bl_label = "Click Joints"
    bl_options = {"REGISTER", "UNDO"}

    only: bpy.props.StringProperty(name="Only", description="Click only this joint. Empty: all joints of the body")  # type: ignore[valid-type]
    needed: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Needed", options={"SKIP_SAVE"}, description="Begin with this joint; all others are optional, those of the trunk first"
    )
    frame: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Frame", default=-1, min=-1, options={"SKIP_SAVE"}, description="In this frame, as a keyframe. −1: the scene's current one"
    )
    hidden: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Include Hidden Joints", description="Also click chest, spine and collarbones, which are hard to locate from outside"
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Begin, in the frame that is asked for."""
        if self.frame < 0:
            return super().invoke(context, event)
        before, first = context.scene.frame_current, context.scene.tricap.seed_frame
        canvas.go_to_frame(context.scene, self.frame)
        begun = super().invoke(context, event)
        context.scene.tricap.seed_frame = first  # so that the surface, which depends on the click frame, need not be measured again
        canvas.go_to_frame(context.scene, self.frame if begun == {"RUNNING_MODAL"} else before)  # opened views show the click frame
        return begun

    def names(self, context: bpy.types.Context, clips: dict[str, bpy.types.MovieClip]) -> list[str]:
        """The joints of the chosen model."""
        if self.only:
            return [self.only]
        names = joints_of(model_joints(context.scene), hidden=self.hidden)
        return needed_first(names, self.needed) if self.needed else names

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Clicking needs a window."""
        self.report({"ERROR"}, "Clicking needs Blender's window. Scripts use bpy.ops.tricap.click(name=…, view=…, x=…, y=…).")
        return {"CANCELLED"}


class GoToFrame(bpy.types.Operator):
    """Show this frame"""

    bl_idname = "tricap.go_to_frame"
    bl_label = "Go to Frame"
    bl_options = {"REGISTER", "UNDO"}

    frame: bpy.props.IntProperty(name="Frame", min=0, max=LAST_FRAME, description="Number of the frame")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Move the scene there."""
        canvas.go_to_frame(context.scene, self.frame)
        return {"FINISHED"}


class ClickSeeds(ClickOperator, bpy.types.Operator):
    """Click points of the surface, each in two or more views. Usually they are found automatically; clicks help if something is in front of
    the person, or if there is little texture"""

    bl_idname = "tricap.click_seeds"
    bl_label = "Click Surface Seeds"
    bl_options = {"REGISTER", "UNDO"}

    def names(self, context: bpy.types.Context, clips: dict[str, bpy.types.MovieClip]) -> list[str]:
        """Any number of seeds, in the click frame."""
        if any(clicks.clicked_frames(clip) for clip in clips.values()):
            canvas.go_to_frame(context.scene, context.scene.tricap.seed_frame)
        return free_seed_names(clips, context.scene.frame_current)

    def follow(self, context: bpy.types.Context) -> None:
        """Seeds belong to one frame.

        Raises:
            InputError: the scene shows another one.
        """
        if context.scene.frame_current != self.session.frame:
            raise InputError(f"Surface seeds belong to the click frame. Go back to frame {self.session.frame} to click more.")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Clicking needs a window."""
        self.report({"ERROR"}, 'Clicking needs Blender\'s window. Scripts use bpy.ops.tricap.click(name="seed 1", view=…, x=…, y=…).')
        return {"CANCELLED"}


class Click(bpy.types.Operator):
    """Set the click of a joint or a surface seed at a pixel of a view"""

    bl_idname = "tricap.click"
    bl_label = "Set a Click"
    bl_options = {"REGISTER", "UNDO"}

    name: bpy.props.StringProperty(name="Name", description="A joint, such as elbow.R, or “seed 1”, “seed 2”, …")  # type: ignore[valid-type]
    view: bpy.props.StringProperty(name="View", description="Name of the view")  # type: ignore[valid-type]
    x: bpy.props.FloatProperty(name="X", description="Pixels from the centre of the left column")  # type: ignore[valid-type]
    y: bpy.props.FloatProperty(name="Y", description="Pixels from the centre of the top row, downwards")  # type: ignore[valid-type]
    frame: bpy.props.IntProperty(name="Frame", default=-1, min=-1, description="−1: the scene's current frame")  # type: ignore[valid-type]
    remove: bpy.props.BoolProperty(name="Remove", description="Remove the click instead")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set or remove one click."""
        try:
            clips = project.clips_of(context.scene)
            if not clicks.is_click(self.name):
                raise InputError(f"“{self.name}” is not a joint. Use {', '.join(JOINTS)}, or “seed 1”, “seed 2”, …")
            if self.view not in clips:
                raise InputError(f"There is no view “{self.view}”. The views are: {', '.join(clips) or 'none, add footage first'}.")
            clip, frame = clips[self.view], context.scene.frame_current if self.frame < 0 else self.frame
            if not (-0.5 <= self.x <= clip.size[0] - 0.5 and -0.5 <= self.y <= clip.size[1] - 0.5):
                raise InputError(f"({self.x:g}, {self.y:g}) is outside the image of {clip.size[0]}×{clip.size[1]} pixels.")
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if self.remove:
            return {"FINISHED"} if clicks.remove_click(clip, self.name, frame) else {"CANCELLED"}
        set_click_frame(context.scene, clips, frame)
        exact = properties.exact
        clicks.set_click(clip, self.name, frame, (exact(self.x), exact(self.y)))
        return {"FINISHED"}


def begin_session(scene: bpy.types.Scene, names: Any, *, seeds: bool = True) -> tuple[ClickSession, str]:
    """A session for the scene's current frame, and a warning or "". Clicks of `seeds` belong to the take, those of single points do not.

    Raises:
        InputError: there is no footage, or no model to click joints of.
    """
    clips = project.clips_of(scene)
    if not clips:
        raise InputError("Add footage first: there is no view to click in.")
    wanted = names(bpy.context, clips)
    finder, warning = make_finder(scene)
    if seeds:
        set_click_frame(scene, clips, scene.frame_current)
    session = ClickSession(clips, wanted, scene.frame_current, finder, _depths(scene))
    if not session.name:  # all are clicked: begin with the first, to check or correct them
        session.go_to(session.names[0])
    if finder is not None:
        finder.prepare(session.frame)
    return session, warning


def make_finder(scene: bpy.types.Scene) -> tuple[Finder | None, str]:
    """The finder of proposals; None and the reason if cameras or images are missing."""
    try:
        take = project.take(scene)
        settings = settings_of(take.settings, properties.overrides(scene), "take.toml")
        bare = replace(take, clicks=FrameClicks(), keyframes=(), corrections=(), frames=None)
        footage = open_take(bare, click_sigma_px=settings["fitting"].click_sigma_px)
    except InputError as error:
        return None, f"Epipolar lines and proposals are not available: {error}"
    return Finder(footage, settings["matching"]), ""


def model_joints(scene: bpy.types.Scene) -> tuple[str, ...]:
    """The joints of the scene's body model.

    Raises:
        InputError: none is chosen, or its file is invalid.
    """
    if project.joints_model(scene) is None:
        raise InputError("Choose a body in step 3 first: it determines the joints to click.")
    return _model(scene).skeleton.joint_names


def _depths(scene: bpy.types.Scene) -> dict[str, float]:
    return joint_depths_m(_model(scene)) if project.joints_model(scene) else {}


def _model(scene: bpy.types.Scene) -> BodyModel:
    name = str(project.joints_model(scene))
    return read_model(name) if name.endswith(".toml") else _builtin_model(name)


@cache
def _builtin_model(name: str) -> BodyModel:
    """A built-in model, cached because a panel needs it whenever it is drawn."""
    return read_model(name)


def set_click_frame(scene: bpy.types.Scene, clips: dict[str, bpy.types.MovieClip], frame: int) -> None:
    """The very first click sets the click frame."""
    if not any(clicks.clicked_frames(clip) for clip in clips.values()):
        scene.tricap.seed_frame = frame


def show_view(area: bpy.types.Area, clip: bpy.types.MovieClip) -> None:
    """Show another view in a Clip Editor."""
    area.spaces.active.clip = clip
    area.tag_redraw()


def stop_clicking() -> None:
    """End a running session (its class is unregistered)."""
    operator = get_session().click_operator
    if operator is not None:
        operator.clear(bpy.context)


CLASSES = (ClickJoints, ClickSeeds, Click, GoToFrame)
