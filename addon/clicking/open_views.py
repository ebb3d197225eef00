"""bpy.ops.tricap.open_views(): a workspace of its own with a Clip Editor per view, so that the user's own screens stay as they are."""

from collections.abc import Callable, Iterator, Sequence

import bpy

from ...core.errors import InputError
from .. import project, seeds
from ..overlay import canvas

NAME = "Tricap Clicks"
MOST_VIEWS = 9
SOON_S, TRIES = 0.05, 40  # a workspace is shown only after the event that asked for it
CLOSED = ("OUTLINER", "PROPERTIES")


class OpenViews(bpy.types.Operator):
    """Show all views beside each other in a workspace of its own, “Tricap Clicks”; your other workspaces stay as they are. Before the first
    click it goes to the seed frame"""

    bl_idname = "tricap.open_views"
    bl_label = "Open the Views"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with footage."""
        return len(context.scene.tricap.views) > 0

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Go to the workspace, made if it is not there, and lay out the views once Blender shows it."""
        try:
            clips = list(project.clips_of(context.scene).values())[:MOST_VIEWS]
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        window, known = context.window, bpy.data.workspaces.get(NAME)
        if window is None:
            self.report({"ERROR"}, "The views can only be opened in Blender's window.")
            return {"CANCELLED"}
        if known is None:
            before = set(bpy.data.workspaces)
            bpy.ops.workspace.duplicate()
            (known,) = set(bpy.data.workspaces) - before
            known.name = NAME
        if window.workspace != known:
            window.workspace = known
        if not any(seeds.frames_of(clip) for clip in clips):
            context.scene.frame_set(context.scene.tricap.seed_frame)
        names = [clip.name for clip in clips]
        bpy.app.timers.register(_waiter(window, names), first_interval=SOON_S)
        return {"FINISHED"}


def _waiter(window: bpy.types.Window, clip_names: Sequence[str]) -> Callable[[], float | None]:
    """A timer that lays out the views once the window shows the workspace, step by step."""
    left, steps = [TRIES], []

    def wait() -> float | None:
        left[0] -= 1
        if left[0] <= 0 or window not in bpy.context.window_manager.windows[:]:
            return None
        if window.workspace.name != NAME:
            return SOON_S
        if not steps:
            steps.append(lay_out(window, [bpy.data.movieclips[name] for name in clip_names if name in bpy.data.movieclips]))
        return SOON_S if next(steps[0], None) else None

    return wait


def lay_out(window: bpy.types.Window, clips: Sequence[bpy.types.MovieClip]) -> Iterator[str]:
    """A Clip Editor for each clip, in rows, in the place of the largest area. Between the steps Blender gives the new areas their sizes."""
    editors = [a for a in window.screen.areas if a.type == "CLIP_EDITOR"]
    if not editors:
        if not bpy.app.background:  # closing an area without a window ends Blender
            _close_others(window)
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
        _show(editor, clip)
    yield "shown"
    for area in canvas.clip_areas(window):
        with bpy.context.temp_override(window=window, area=area, region=canvas.window_region(area)):
            bpy.ops.clip.view_all(fit_view=True)


def _split(window: bpy.types.Window, area: bpy.types.Area, parts: int, direction: str) -> list[bpy.types.Area]:
    """Cut an area into equal parts, all of them Clip Editors."""
    area.type = "CLIP_EDITOR"
    before = set(window.screen.areas) - {area}
    for left in range(parts, 1, -1):  # the area itself is cut each time: a new one has no size yet
        with bpy.context.temp_override(window=window, area=area, region=canvas.window_region(area)):
            bpy.ops.screen.area_split(direction=direction, factor=1 / left)
    return [a for a in window.screen.areas if a not in before]


def _show(area: bpy.types.Area, clip: bpy.types.MovieClip) -> None:
    area.type = "CLIP_EDITOR"
    space = area.spaces.active
    space.mode, space.view = "TRACKING", "CLIP"
    space.clip = clip
    space.show_disabled = False  # clicks that were taken back
    space.show_region_toolbar = False
    space.show_region_ui = False
    space.clip_user.use_render_undistorted = False


def _close_others(window: bpy.types.Window) -> None:
    for area in [a for a in window.screen.areas if a.type in CLOSED]:
        with bpy.context.temp_override(window=window, area=area):
            bpy.ops.screen.area_close()


CLASSES = (OpenViews,)
