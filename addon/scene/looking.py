"""Where the 3-D views of a file look that the command writes: at the body, not at the origin. What the timelines show: all frames."""

from itertools import chain

import bpy
import numpy as np
from mathutils import Vector

from ..alone import override

DISTANCES = 2.4  # from which the body is seen, by its size


def look_at(body: bpy.types.Object) -> None:
    """Let all 3-D views of the file look at a body where it stands now; their directions stay."""
    bones = body.pose.bones
    ends = np.array([body.matrix_world @ end for end in chain.from_iterable((bone.head, bone.tail) for bone in bones)])
    low, high = ends.min(axis=0), ends.max(axis=0)
    for space in (space for screen in bpy.data.screens for area in screen.areas for space in area.spaces if space.type == "VIEW_3D"):
        view = space.region_3d
        if view is not None:
            view.view_location, view.view_distance = Vector((low + high) / 2), DISTANCES * float((high - low).max())


def show_all_frames(context: bpy.types.Context) -> None:
    """Let the timelines of the window show the frames of the scene."""
    if context.window is None or bpy.app.background:
        return
    for area in (a for a in context.window.screen.areas if a.type == "DOPESHEET_EDITOR"):
        with override(area=area, region=next(r for r in area.regions if r.type == "WINDOW")):
            bpy.ops.action.view_all()
