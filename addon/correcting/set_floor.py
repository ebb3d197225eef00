"""bpy.ops.tricap.set_floor(clicks='[["L", 402, 551], ["R", 388, 560]]'): the floor is where a place on it was clicked in two views."""

import json

import bpy
import numpy as np

from ...core.foundation import bounded
from ...core.foundation.errors import InputError
from ...core.geometry.intersection import clicks_contradict, intersect_clicks
from ..overlay import canvas, draw
from ..overlay.operators import pointed
from ..scene import standing
from .operators import Correct
from .pull_joint import cameras_of


class SetFloor(Correct, bpy.types.Operator):
    """Click a place on the floor in two views of one frame, such as the corner of a tile: the floor of the scene is put to its height"""

    bl_idname = "tricap.set_floor"
    bl_label = "Set Floor"
    bl_options = {"REGISTER", "UNDO"}
    hint = "Click a place on the floor, then the same place in another view    Esc: cancel"

    clicks: bpy.props.StringProperty(name="Clicks", description="Pixels of one place, as [[view, x, y], …]")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put the floor where the rays of the clicks meet."""
        try:
            height = height_of(context.scene, self.clicks)
            standing.stand_on(context.scene, height)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"The floor is at {height:.3f} m.")
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start clicking."""
        self.clicked: dict[str, tuple[float, float]] = {}
        return self.begin(context)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """The first click, then that in another view."""
        if event.type == "ESC" and event.value == "PRESS":
            return self.end(context, {"CANCELLED"})
        place = pointed(context, event)
        if place is None or event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"PASS_THROUGH"}
        self.clicked[place[0]] = (float(place[1][0]), float(place[1][1]))
        draw.show_region(place[0], [self.clicked[place[0]]])
        canvas.redraw_clips(context)
        if len(self.clicked) < 2:
            return {"RUNNING_MODAL"}
        self.clicks = json.dumps([[view, *xy] for view, xy in self.clicked.items()])
        return self.end(context, self.execute(context))


def height_of(scene: bpy.types.Scene, clicks: str) -> float:
    """The height [m] of a place from its clicks.

    Raises:
        InputError: they are no list of clicks in two views, there is no such view, or their rays miss each other.
    """
    try:
        at = {str(view): (float(x), float(y)) for view, x, y in bounded.json_of(clicks)}
    except (ValueError, TypeError) as error:
        raise InputError(f"The clicks {clicks!r} are not a list; write them as [[view, x, y], [view, x, y]].") from error
    cameras = cameras_of(scene)
    unknown = [view for view in at if view not in cameras]
    if unknown or len(at) < 2:
        raise InputError(f"There is no view “{unknown[0]}”." if unknown else "Click the place in two views.")
    point = intersect_clicks([cameras[view] for view in at], np.array([list(at.values())]))
    if clicks_contradict(point)[0]:
        raise InputError(
            "The two clicks are not on the same place: their rays miss each other. Click a sharper spot on the floor in both views."
        )
    return float(point.xyz_m[0, 2])


CLASSES = (SetFloor,)
