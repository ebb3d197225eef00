"""bpy.ops.tricap.join_points(): joins the selected points of a clip by lines."""

import bpy

from ...core.foundation.errors import InputError
from .. import clicks
from ..overlay import canvas
from ..panels import TellingOperator
from .tracks import join


class JoinPoints(TellingOperator, bpy.types.Operator):
    """Join the selected points by lines, in the order of the list of tracks; press again to separate them"""

    bl_idname = "tricap.join_points"
    bl_label = "Join"
    bl_options = {"REGISTER", "UNDO"}

    clip: bpy.props.StringProperty(name="Clip", description="Name of the clip. Empty: the one of the editor")  # type: ignore[valid-type]
    names: bpy.props.StringProperty(name="Points", description="Their names, one a line. Empty: the selected tracks")  # type: ignore[valid-type]

    def do(self, context: bpy.types.Context) -> str:
        """Join or separate."""
        clip = clip_named(context, self.clip)
        selected = [track.name for track in clip.tracking.tracks if track.select and not clicks.is_click(track.name)]
        names = self.names.splitlines() or selected
        if len(names) < 2:
            raise InputError("Select two points or more (Shift-click them), then press Join.")
        if unknown := [name for name in names if name not in clip.tracking.tracks]:
            raise InputError(f"The clip {clip.name} has no point “{unknown[0]}”.")
        done = join(clip, names)
        canvas.redraw_clips(context)
        return f"{' – '.join(names)}: {'joined' if done else 'separated'}."


def clip_named(context: bpy.types.Context, name: str) -> bpy.types.MovieClip:
    """A clip by its name, or that of the Clip Editor.

    Raises:
        InputError: there is none.
    """
    clip = bpy.data.movieclips.get(name) if name else getattr(context.space_data, "clip", None)
    if clip is None:
        raise InputError(f"There is no clip “{name}”." if name else "Open footage in the Clip Editor first.")
    return clip


CLASSES = (JoinPoints,)
