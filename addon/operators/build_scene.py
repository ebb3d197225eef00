"""bpy.ops.tricap.build_scene(out="…", blend="…", rest_pose="A", detail=1, exact_skin=False, simplify=0.0, colour="intensity", …)"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from mathutils import Matrix, Quaternion, Vector

from ...core.body.fields import POTENTIALS
from ...core.foundation.progress import Monitor
from .. import folders
from ..alone import override
from ..jobs import JobOperator
from ..scene import armature
from ..scene.cloud import COLOURS
from ..scene.looking import show_all_frames
from ..scene.options import DEFAULTS, SceneOptions
from ..scene.rest_pose import POSES

if TYPE_CHECKING:
    from ..scene.build import SceneReport
    from ..scene.contents import Contents

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}

DEFAULT_LIGHT_M = (4.07625, 1.00545, 5.90386)  # where the light of Blender's startup file is
DEFAULT_CAMERA_M = (7.35889, -6.92579, 4.95831)  # and its camera
FRONT = Quaternion((1.0, 0.0, 0.0), math.pi / 2)  # of a view along +y


class BuildScene(JobOperator, bpy.types.Operator):
    """Build the results of a run in this scene: cameras with footage, point cloud, trajectories, armature, action and skin. The bones
    shoulder.L and shoulder.R are the clavicles, as in Rigify"""

    bl_idname = "tricap.build_scene"
    bl_label = "Build Scene"
    bl_options = {"REGISTER", "UNDO"}
    step = "rig"

    out: bpy.props.StringProperty(
        name="Results",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder of a run. Empty: the output folder of the panel",
    )
    blend: bpy.props.StringProperty(
        name="Save As",
        subtype="FILE_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Also save a copy of the file under this name. Empty: do not save",
    )

    rest_pose: bpy.props.EnumProperty(
        name="Rest Pose",
        items=[(pose, f"{pose}-pose", "") for pose in POSES],  # type: ignore[valid-type]
        description="Rest pose of the armature. In A-pose the channels equal the columns of motion.csv",
    )
    detail: bpy.props.IntProperty(
        name="Skin Detail",
        default=DEFAULTS.detail,
        min=1,
        max=8,  # type: ignore[valid-type]
        description="Level of detail of the skin: subdivisions of each edge",
    )
    exact_skin: bpy.props.BoolProperty(
        name="Exact Skin",
        default=False,  # type: ignore[valid-type]
        description="Also play the skin that was computed for every frame, from a .pc2 file next to the saved file",
    )
    implicit: bpy.props.BoolProperty(
        name="Implicit Surface",
        default=False,  # type: ignore[valid-type]
        description="Also build the exact implicit surface in the middle frame, to compare skins with",
    )
    field: bpy.props.EnumProperty(
        name="Field",
        items=[(name, name.capitalize(), "") for name in POTENTIALS],  # type: ignore[valid-type]
        description="Field function of the metaballs of the implicit surface. The fit uses the exponential one",
    )
    simplify: bpy.props.FloatProperty(
        name="Simplify",
        default=0.0,
        min=0.0,
        max=math.radians(10),
        subtype="ANGLE",  # type: ignore[valid-type]
        description="Play an action with fewer keyframes, within this angle of the measured one, which is kept. 0: play the measured one",
    )
    colour: bpy.props.EnumProperty(name="Cloud Colour", items=[(c, c.capitalize(), "") for c in COLOURS])  # type: ignore[valid-type]
    arrows: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Velocity Arrows",
        default=False,
        description="Show the velocity (per 0.1 s) and the acceleration of every tracked point as arrows",
    )
    removed: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Removed Trajectories",
        default=False,
        description="Also show what the filters removed from the trajectories, coloured by reason",
    )

    def snapshot(self, context: bpy.types.Context) -> "Callable[[Monitor], Contents]":
        """The folder with the results."""
        from ..scene.contents import read_contents

        out, skins, removed = folders.output_folder(self.out, context.scene), self.exact_skin, self.removed
        return lambda monitor: read_contents(out, monitor, skins=skins, removed=removed)

    def finish(self, context: bpy.types.Context, result: "Contents") -> set[str]:
        """Build the scene from what was read."""
        options = SceneOptions(
            rest_pose=self.rest_pose,
            detail=self.detail,
            exact_skin=self.exact_skin,
            colour=self.colour,
            simplify_deg=math.degrees(self.simplify),
            arrows=self.arrows,
            implicit=self.implicit,
            field=self.field,
        )
        put_into_scene(self, context, result, folders.to_write(self.blend) if self.blend else None, options)
        return {"FINISHED"}


def put_into_scene(
    operator: bpy.types.Operator,
    context: bpy.types.Context,
    contents: "Contents",
    blend: Path | None = None,
    options: SceneOptions = DEFAULTS,
) -> None:
    """Build the scene and report its contents; the first time, frame the body in the 3-D views. Else those that look through the camera
    still do, though it is another one, and what was done with the earlier body is done with the new one (`kept_work`)."""
    from ..editing.kept_work import Work
    from ..scene.build import write_scene

    first, work = armature.NAME not in bpy.data.objects, Work.of(context.scene)
    through = [view for view in _views(context) if view.view_perspective == "CAMERA"]

    def replaced(edited: Sequence[bpy.types.Action]) -> None:
        for kind, sentence in work.again(context.scene, edited) if work is not None else ():
            operator.report({kind}, sentence)

    report_scene(operator, write_scene(contents, blend, options, replaced=replaced))
    body = bpy.data.objects.get(armature.NAME)
    chosen = context.scene.tricap_retarget
    if body is not None:
        chosen.source, chosen.export = chosen.source or body, chosen.export or body
    if first and body is not None:
        frame_in_views(operator, context, body)
    else:
        look_through_camera(context, through)


def look_through_camera(context: bpy.types.Context, views: list[bpy.types.RegionView3D]) -> None:
    """Let 3-D views look through the scene's camera: that of an earlier build is gone, and their view with it."""
    for view in views if context.scene.camera is not None else ():
        view.view_perspective = "CAMERA"


def show_so_far(operator: bpy.types.Operator, context: bpy.types.Context, contents: "Contents") -> None:
    """Show the results that there are over the footage: cameras, then the cloud, then trajectories.

    A scene with a body stays as it is, with its edits, and so does one whose cameras were calibrated or imported in it: they would be there
    twice. The first time, the 3-D views look through the scene's camera.
    """
    from ..scene.build import write_scene
    from ..scene.earlier import built_collections

    collections = built_collections(context.scene)
    built = {thing for collection in collections for thing in collection.all_objects}
    own_cameras = any(thing.type == "CAMERA" and "tricap_view" in thing and thing not in built for thing in context.scene.objects)
    if own_cameras or any(thing.type == "ARMATURE" for thing in built):
        return
    first, views = not collections, _views(context)
    through = [view for view in views if first or view.view_perspective == "CAMERA"]
    write_scene(replace(contents, warnings=(), shape=None, motion=None), options=replace(DEFAULTS, studio=False))
    if first and views:
        hide_default_objects(operator, context)
    look_through_camera(context, through)


def _views(context: bpy.types.Context) -> list[bpy.types.RegionView3D]:
    """The 3-D views of the window; none in the background."""
    areas = context.window.screen.areas if context.window is not None and not bpy.app.background else ()
    return [area.spaces.active.region_3d for area in areas if area.type == "VIEW_3D"]


def frame_in_views(operator: bpy.types.Operator, context: bpy.types.Context, *things: bpy.types.Object, front: bool = False) -> None:
    """Frame bodies or a picture in the 3-D views, without the objects of Blender's startup file, and its frames in the timelines. With
    `front`, it is seen from the front."""
    if context.window is None or bpy.app.background:
        return
    hide_default_objects(operator, context)
    for item in context.selected_objects:
        item.select_set(False)
    for thing in things:
        thing.select_set(True)
    for area in (a for a in context.window.screen.areas if a.type == "VIEW_3D"):
        region, shading = next(r for r in area.regions if r.type == "WINDOW"), area.spaces.active.shading
        if shading.color_type == "MATERIAL":  # Blender's own choice
            shading.color_type = "TEXTURE"  # the person's clothes; where there is none, the material's colour
        with override(area=area, region=region):
            if front:  # at once: the next operator would stop a view that is still turning
                view = area.spaces.active.region_3d
                view.view_rotation, view.view_perspective = FRONT, "ORTHO"
            bpy.ops.view3d.view_selected()
    show_all_frames(context)


def hide_default_objects(operator: bpy.types.Operator, context: bpy.types.Context) -> None:
    """Hide the cube of Blender's startup file, in which the body would stand up to the chest, its light and its camera, if unchanged."""
    wanted = {"Cube": _is_default_cube, "Light": _is_default_light, "Camera": _is_default_camera}
    hidden = [thing for name, unchanged in wanted.items() if (thing := context.scene.objects.get(name)) is not None and unchanged(thing)]
    for thing in hidden:
        thing.hide_set(True)
        thing.hide_render = True
    if hidden:
        lower = [thing.name.lower() for thing in hidden]
        names, were = " and ".join(filter(None, [", ".join(lower[:-1]), lower[-1]])), "were" if len(hidden) > 1 else "was"
        operator.report({"INFO"}, f"Blender's default {names} {were} hidden to make room.")


def _is_default_cube(cube: bpy.types.Object) -> bool:
    if cube.type != "MESH" or cube.matrix_world != Matrix() or cube.modifiers or cube.animation_data or cube.hide_get():
        return False
    return sorted(tuple(round(x) for x in v.co) for v in cube.data.vertices) == sorted(product((-1, 1), repeat=3))


def _is_default_light(light: bpy.types.Object) -> bool:
    there = (light.location - Vector(DEFAULT_LIGHT_M)).length < 1e-3
    return light.type == "LIGHT" and light.data.type == "POINT" and there and not light.animation_data and not light.hide_get()


def _is_default_camera(camera: bpy.types.Object) -> bool:
    there = (camera.location - Vector(DEFAULT_CAMERA_M)).length < 1e-3
    used = camera == bpy.context.scene.camera  # where the footage has no cameras yet
    return camera.type == "CAMERA" and there and not used and not camera.animation_data and not camera.hide_get()


def report_scene(operator: bpy.types.Operator, report: "SceneReport") -> None:
    """Report what was built, and what is missing."""
    for warning in report.warnings:
        operator.report({"WARNING"}, warning)
    operator.report({"INFO"}, f"The scene has {report}.")
