"""bpy.ops.tricap.review(): a workspace of its own with the body and the footage side by side, to look for what is wrong and to mend it."""

from collections.abc import Iterator

import bpy
from mathutils import Vector

from ...core.foundation.errors import InputError
from ...core.geometry.view_angles import default_reference
from .. import project
from ..alone import override
from ..clicking.open_views import NO_WINDOW, REVIEW, close_others, go_to, lay_out_soon, show_clip
from ..overlay import canvas
from ..scene.standing import all_bodies

DISTANCE = 1.5  # of the view from the body, by the body's diagonal


class Review(bpy.types.Operator):
    """Show the body and the footage side by side in the workspace “Tricap Review”. Pull Joint, in the sidebar of the footage, drags a joint
    to its right place; Fit Again then fits the body to it. The markers in the timeline are doubtful stretches"""

    bl_idname = "tricap.review"
    bl_label = "Review"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with footage and a body."""
        return len(context.scene.tricap.views) > 0 and next(all_bodies(context.scene), None) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Go to the workspace, and lay it out once Blender shows it."""
        window = context.window
        try:
            clips = project.clips_of(context.scene)
            default = default_reference([*clips], project.rig_of(context.scene))
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if window is None:
            self.report({"ERROR"}, NO_WINDOW)
            return {"CANCELLED"}
        go_to(window, REVIEW)
        context.scene.tricap_overlay.body = True
        chosen = context.scene.tricap.reference_view
        name = clips[chosen if chosen in clips else default].name
        lay_out_soon(window, REVIEW, lambda: lay_out(window, name))
        return {"FINISHED"}


def lay_out(window: bpy.types.Window, clip_name: str) -> Iterator[str]:
    """The largest area becomes two: the 3-D view, and right of it a Clip Editor with the clip, its sidebar open at Tricap. A workspace that
    has a Clip Editor already stays as it is.

    Between the steps Blender gives the new areas their sizes.
    """
    areas = window.screen.areas
    if any(area.type == "CLIP_EDITOR" for area in areas) or clip_name not in bpy.data.movieclips:
        return
    if not bpy.app.background:  # closing an area without a window ends Blender
        close_others(window)
        yield "others closed"
    largest, before = max(areas, key=lambda area: area.width * area.height), set(areas)
    largest.type = "VIEW_3D"
    with override(window=window, area=largest, region=canvas.window_region(largest)):
        bpy.ops.screen.area_split(direction="VERTICAL", factor=0.5)
    yield "split"
    (new,) = set(areas) - before
    spatial, footage = sorted((largest, new), key=lambda area: area.x)
    show_clip(footage, bpy.data.movieclips[clip_name])
    footage.spaces.active.show_region_ui = True
    spatial.spaces.active.show_region_ui = False
    yield "shown"
    if not bpy.app.background:
        next(region for region in footage.regions if region.type == "UI").active_panel_category = "Tricap"
    with override(window=window, area=footage, region=canvas.window_region(footage)):
        bpy.ops.clip.view_all(fit_view=True)
    for body in all_bodies(window.scene):
        frame(spatial.spaces.active.region_3d, body)


def frame(view: bpy.types.RegionView3D, thing: bpy.types.Object) -> None:
    """Let a 3-D view show an object as a whole, from its present direction."""
    corners = [thing.matrix_world @ Vector(corner) for corner in thing.bound_box]
    view.view_perspective = "PERSP"
    view.view_location = (corners[0] + corners[6]) / 2
    view.view_distance = DISTANCE * (corners[6] - corners[0]).length


CLASSES = (Review,)
