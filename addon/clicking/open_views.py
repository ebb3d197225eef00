"""bpy.ops.tricap.open_views(show="points"), .back_to_steps(): a workspace of its own with a Clip Editor per view; the user's own stay."""

from collections.abc import Callable, Iterator, Sequence

import bpy

from ...core.foundation.errors import InputError
from .. import clicks, project
from ..alone import override
from ..overlay import canvas
from ..scene import stored
from ..session import get_session

NAME, REVIEW = "Tricap Clicks", "Tricap Review"
OURS = (NAME, REVIEW)
NO_WINDOW = "Views can only be opened in Blender's window, not in background mode."
FROM_KEY = "tricap_from"  # custom property of the workspace: the one from which it was opened
SHOWN = (
    ("nothing", "Nothing", "The footage alone"),
    ("points", "Points", "The measured points, coloured by sigma"),
    ("tracks", "Trajectories", "The trajectories, and those that the filters removed"),
    ("body", "Body", "The outline of the fitted body"),
)
MOST_VIEWS = 9
SOON_S, TRIES = 0.05, 40  # a workspace is shown only after the event that asked for it
CLOSED = ("OUTLINER", "PROPERTIES")


class OpenViews(bpy.types.Operator):
    """Show all views side by side in the workspace “Tricap Clicks”. Your other workspaces do not change. As long as nothing is clicked, the
    scene goes to the click frame"""

    bl_idname = "tricap.open_views"
    bl_label = "Open Views"
    bl_options = {"UNDO"}

    show: bpy.props.EnumProperty(name="Show", items=SHOWN, description="What to show over the footage")  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with footage."""
        return len(context.scene.tricap.views) > 0

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Go to the workspace, created if needed, and lay out the views once Blender shows it."""
        try:
            project.check_rates(context.scene)
            clips = list(project.clips_of(context.scene).values())[:MOST_VIEWS]
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        window = context.window
        if window is None:
            self.report({"ERROR"}, NO_WINDOW)
            return {"CANCELLED"}
        go_to(window, NAME)
        if self.show != "nothing":
            setattr(context.scene.tricap_overlay, self.show, True)
        if not any(clicks.clicked_frames(clip) for clip in clips):
            canvas.go_to_frame(context.scene, context.scene.tricap.seed_frame)
        names, switches = [clip.name for clip in clips], self.show != "nothing"

        def layout() -> Iterator[str]:
            return lay_out(window, [bpy.data.movieclips[name] for name in names if name in bpy.data.movieclips], switches=switches)

        lay_out_soon(window, NAME, layout)
        return {"FINISHED"}


def go_to(window: bpy.types.Window, name: str) -> None:
    """Show the workspace `name` in a window, made as a copy of the one that is shown if it does not exist."""
    ours = bpy.data.workspaces.get(name)
    if ours is None:
        before = set(bpy.data.workspaces)
        bpy.ops.workspace.duplicate()
        (ours,) = set(bpy.data.workspaces) - before
        ours.name = name
    if window.workspace != ours:
        ours[FROM_KEY] = window.workspace.name
        window.workspace = ours


class BackToSteps(bpy.types.Operator):
    """Go back to the workspace from which the views were opened"""

    bl_idname = "tricap.back_to_steps"
    bl_label = "Back to Steps"

    run: bpy.props.BoolProperty(name="Run", options={"SKIP_SAVE"}, description="Also run the remaining steps")  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only in the views' workspace."""
        return context.workspace is not None and context.workspace.name in OURS

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Show that workspace; if it was deleted, any other with a 3-D view."""
        others = [w for w in bpy.data.workspaces if w.name not in OURS]
        spatial = [w for w in others if any(a.type == "VIEW_3D" for screen in w.screens for a in screen.areas)]
        origin = bpy.data.workspaces.get(stored.text(context.workspace, FROM_KEY))
        back = origin if origin in others else next(iter([*spatial, *others]), None)
        if back is None:
            self.report({"ERROR"}, "There is no other workspace. Add one with the + at the top of the window.")
            return {"CANCELLED"}
        context.window.workspace = back
        if self.run:
            bpy.ops.tricap.run("INVOKE_DEFAULT")
        return {"FINISHED"}


def draw_back(header: bpy.types.Header, context: bpy.types.Context) -> None:
    """The buttons Back to Steps and Run Remaining Steps in the header of the first view."""
    mine = canvas.clip_areas(context.window)
    if not BackToSteps.poll(context) or not mine or context.area != min(mine, key=lambda a: (-a.y, a.x)):
        return
    header.layout.operator("tricap.back_to_steps", icon="LOOP_BACK")
    now = get_session().file.step_states.get(context.scene.name_full)
    if now is not None and now.can_run and not context.window_manager.tricap.blocks:  # a check gives way
        header.layout.operator("tricap.back_to_steps", icon="FF", text="Run Remaining Steps").run = True


def lay_out_soon(window: bpy.types.Window, workspace: str, layout: Callable[[], Iterator[str]]) -> None:
    """Lay out a workspace as soon as the window shows it, step by step."""
    left, steps = [TRIES], list[Iterator[str]]()

    def wait() -> float | None:
        left[0] -= 1
        if left[0] <= 0 or window not in bpy.context.window_manager.windows[:]:
            return None
        if window.workspace.name != workspace:
            return SOON_S
        if not steps:
            steps.append(layout())
        return SOON_S if next(steps[0], None) else None

    bpy.app.timers.register(wait, first_interval=SOON_S)


def lay_out(window: bpy.types.Window, clips: Sequence[bpy.types.MovieClip], *, switches: bool = False) -> Iterator[str]:
    """Replace the largest area by a Clip Editor for each clip, in rows; with `switches`, the last one's sidebar is open at Tricap.

    Between the steps Blender gives the new areas their sizes.
    """
    editors = [a for a in window.screen.areas if a.type == "CLIP_EDITOR"]
    if not editors:
        if not bpy.app.background:  # closing an area without a window ends Blender
            close_others(window)
            yield "others closed"
        largest = max(window.screen.areas, key=lambda a: a.width * a.height)
        rows = 1 if len(clips) <= 3 else 2 if len(clips) <= 6 else 3
        editors = _split(window, largest, rows, "HORIZONTAL")
        yield "rows"
    down = sorted(editors, key=lambda a: -a.y)
    for i, editor in enumerate(down if len(editors) < len(clips) else []):
        _split(window, editor, len(clips) // len(editors) + (i < len(clips) % len(editors)), "VERTICAL")
    yield "columns"
    editors = sorted((a for a in window.screen.areas if a.type == "CLIP_EDITOR"), key=lambda a: (-a.y, a.x))
    for editor, clip in zip(editors, clips):
        show_clip(editor, clip)
    if switches:
        editors[-1].spaces.active.show_region_ui = True
    yield "shown"
    if switches and not bpy.app.background:
        next(r for r in editors[-1].regions if r.type == "UI").active_panel_category = "Tricap"
    for area in canvas.clip_areas(window):
        with override(window=window, area=area, region=canvas.window_region(area)):
            bpy.ops.clip.view_all(fit_view=True)


def _split(window: bpy.types.Window, area: bpy.types.Area, parts: int, direction: str) -> list[bpy.types.Area]:
    """Split an area into equal parts, all of them Clip Editors."""
    area.type = "CLIP_EDITOR"
    before = set(window.screen.areas) - {area}
    for left in range(parts, 1, -1):  # the area itself is split each time: a new one has no size yet
        with override(window=window, area=area, region=canvas.window_region(area)):
            bpy.ops.screen.area_split(direction=direction, factor=1 / left)
    return [a for a in window.screen.areas if a not in before]


def show_clip(area: bpy.types.Area, clip: bpy.types.MovieClip) -> None:
    """Let an area show a clip as footage to click in."""
    area.type = "CLIP_EDITOR"
    space = area.spaces.active
    space.mode, space.view = "TRACKING", "CLIP"
    space.clip = clip
    space.show_disabled = False  # removed clicks
    space.show_region_toolbar = False
    space.show_region_ui = False
    space.clip_user.use_render_undistorted = False


def close_others(window: bpy.types.Window) -> None:
    for area in [a for a in window.screen.areas if a.type in CLOSED]:
        with override(window=window, area=area):
            bpy.ops.screen.area_close()


CLASSES = (OpenViews, BackToSteps)
