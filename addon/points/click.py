"""bpy.ops.tricap.click_points() in the window: points “point 1”, “point 2”, … in all views, or in one clip (2-D).

Scripts set native tracks, or use bpy.ops.tricap.click_point(name="nose", clip="C", x=430, y=260).
"""

import bpy

from ...core.foundation.errors import InputError
from .. import clicks, project, properties
from ..clicking import operators
from ..clicking.click_session import ClickSession
from ..overlay import canvas
from ..panels import TellingOperator
from .join import clip_named

MOST = 1000  # points with names of their own
KEYS_2D = "Click: set the next point    Backspace: undo    Esc: finish"


class ClickPoints(operators.ClickOperator, bpy.types.Operator):
    """Click points to follow in space, each in two or more views. After a click in one view the others show its epipolar line and its
    probable position"""

    bl_idname = "tricap.click_points"
    bl_label = "Click Points"
    bl_options = {"REGISTER", "UNDO"}

    flat: bpy.props.BoolProperty(name="2-D", description="Click in this view alone, to follow the points in its image")  # type: ignore[valid-type]

    def begin(self, context: bpy.types.Context) -> tuple[ClickSession, str]:
        """The session, and a warning or ""."""
        if not self.flat:
            return operators.begin_session(context.scene, self.names, seeds=False)
        clip = clip_named(context, "")
        clips = {clip.name: clip}
        return ClickSession(clips, self.names(context, clips), context.scene.frame_current, None), ""

    @property
    def keys(self) -> str:  # type: ignore[override]
        """In 2-D there are neither proposals nor other views."""
        return KEYS_2D if self.flat else operators.KEYS

    def result(self, done: int) -> str:
        """How many points are new, and what to press next."""
        points = f"Frame {self.session.frame}: {done} new {'point' if done == 1 else 'points'}"
        if self.flat:
            return f"{points}. Press Follow in This View (2-D); Join Selected Points draws lines between them."
        return f"{points}, clicked in two or more views. Press Follow Points."

    def names(self, context: bpy.types.Context, clips: dict[str, bpy.types.MovieClip]) -> list[str]:
        """Any number of points, in the current frame."""
        return free_names(clips, context.scene.frame_current)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Clicking needs a window."""
        self.report({"ERROR"}, "Clicking needs Blender's window. Scripts use bpy.ops.tricap.click_point(name=…, clip=…, x=…, y=…).")
        return {"CANCELLED"}


def free_names(clips: dict[str, bpy.types.MovieClip], frame: int) -> list[str]:
    """Names for points: those that are clicked in one of several views only, then new ones."""
    least, every = min(2, len(clips)), [f"point {i}" for i in range(1, MOST)]
    return [n for n in every if sum(clicks.get_click(clip, n, frame) is not None for clip in clips.values()) < least]


class ClickPoint(TellingOperator, bpy.types.Operator):
    """Set the click of a point at a pixel of a view, or of any clip"""

    bl_idname = "tricap.click_point"
    bl_label = "Set a Point"
    bl_options = {"REGISTER", "UNDO"}

    name: bpy.props.StringProperty(name="Name", description="Any name that is no joint and no surface seed")  # type: ignore[valid-type]
    clip: bpy.props.StringProperty(name="Clip", description="Name of a view or of a clip")  # type: ignore[valid-type]
    x: bpy.props.FloatProperty(name="X", description="Pixels from the centre of the left column")  # type: ignore[valid-type]
    y: bpy.props.FloatProperty(name="Y", description="Pixels from the centre of the top row, downwards")  # type: ignore[valid-type]

    def do(self, context: bpy.types.Context) -> str:
        """Set it in the current frame."""
        clip = project.clips_of(context.scene).get(self.clip) or clip_named(context, self.clip)
        if not self.name or clicks.is_click(self.name):
            raise InputError(f"“{self.name}” is the name of a joint or a seed; give the point another name.")
        if not (-0.5 <= self.x <= clip.size[0] - 0.5 and -0.5 <= self.y <= clip.size[1] - 0.5):
            raise InputError(f"({self.x:g}, {self.y:g}) is outside the image of {clip.size[0]}×{clip.size[1]} pixels.")
        clicks.set_click(clip, self.name, context.scene.frame_current, (properties.exact(self.x), properties.exact(self.y)))
        canvas.redraw_clips(context)
        return f"{self.name} in {clip.name}."


CLASSES = (ClickPoints, ClickPoint)
