"""bpy.ops.tricap.cameras_from_file(filepath="…"), bpy.ops.tricap.cameras_from_scene()"""

from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.io_utils import ImportHelper

from ...core.calibration.rig_files import read_any
from ...core.calibration.view_names import from_left_to_right, names_for_views
from ...core.foundation.errors import InputError
from ...core.geometry.rig import Rig, renamed, write_rig
from ...core.take.bar_file import bar_path, read_bar, write_bar
from ...core.take.footage import open_take
from .. import folders, project
from ..calibrate.cameras import rig_of_scene
from ..operators.build_scene import show_so_far
from ..scene import clips
from .simple_operator import SimpleOperator

IN_FOLDER = ("rig.toml", "camera_array.toml", "calibration.toml", "Calib.toml")  # Tricap, caliscope, Anipose, Pose2Sim


class CamerasFromFile(SimpleOperator, ImportHelper, bpy.types.Operator):
    """Import cameras from a calibration file of Tricap, Anipose, Pose2Sim, caliscope, OpenCV, EasyMocap, COLMAP, OpenPTV or Agisoft"""

    bl_idname = "tricap.cameras_from_file"
    bl_label = "Import Calibration File"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Read it and save a copy as rig.toml in the project."""
        before = [view.name for view in context.scene.tricap.views]
        said = use_file(context.scene, folders.absolute(self.filepath))
        show_cameras(self, context)
        now = [view.name for view in context.scene.tricap.views]
        return said + (f" As they stand, from left to right: {', '.join(now)}." if now != before else "")


class CamerasFromScene(SimpleOperator, bpy.types.Operator):
    """Use the cameras of this scene. Each needs the name of its view, or a movie clip of that view as its background"""

    bl_idname = "tricap.cameras_from_scene"
    bl_label = "Use Scene Cameras"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Save the scene's cameras as rig.toml in the project."""
        rig = rig_of_scene(context.scene)
        use_rig(context.scene, rig)
        return f"{len(rig.cameras)} cameras from the scene."


def use_file(scene: bpy.types.Scene, path: Path) -> str:
    """Make the cameras of a calibration file the project's; a sentence about them.

    Raises:
        InputError: the file cannot be read, or its cameras are not those of the views.
    """
    rig = read_any(path)
    bar, names = read_bar(path, rig), names_for_views(rig, [view.name for view in scene.tricap.views])
    use_rig(scene, renamed(rig, names), bar)
    matched = ", ".join(f"{camera} is view {view}" for camera, view in names.items())
    return f"{len(rig.cameras)} cameras from {path.name}.{f' Camera {matched}. Correct the names if that is wrong.' if matched else ''}"


def use_calibration_in(operator: bpy.types.Operator, context: bpy.types.Context, folder: Path) -> str:
    """Use a calibration file that is in the folder of the footage, unless the project has cameras; a sentence about it, or ""."""
    scene = context.scene
    file = next((folder / name for name in IN_FOLDER if (folder / name).is_file()), None)
    if file is None or len(scene.tricap.views) < 2 or (project.existing_folder(scene) / "rig.toml").exists():
        return ""
    try:
        said = use_file(scene, file)
        show_cameras(operator, context)
    except InputError as error:
        return f" {file.name} in that folder is not used: {error}"
    return f" {said}"


def show_cameras(operator: bpy.types.Operator, context: bpy.types.Context) -> None:
    """Put the project's cameras with their footage into the viewport, unless a body is there."""
    from ..scene.contents import Contents

    footage = open_take(project.take(context.scene))
    contents = Contents(out=folders.output_folder("", context.scene), run={"take": str(footage.take.folder)}, footage=footage)
    show_so_far(operator, context, contents)


def use_rig(scene: bpy.types.Scene, rig: Rig, bar: tuple[np.ndarray, np.ndarray] | None = None) -> None:
    """Make these the project's cameras, list the views in their order, and set the lenses of the clips.

    `bar`: frames and ends [m] of the wand, if they come from one.

    Raises:
        InputError: there are no views, one has no camera of its name, or the project's folder cannot be written to.
    """
    views = scene.tricap.views
    if not views:
        raise InputError("Add the footage first (step 1); then its cameras can be chosen.")
    found = {view.name: rig[view.name] for view in views}
    for place, name in enumerate(from_left_to_right(replace(rig, cameras=tuple(found.values())))):
        views.move(views.find(name), place)
    folder = project.write(scene)
    write_rig(folder / "rig.toml", rig)
    bar_path(folder / "rig.toml").unlink(missing_ok=True)  # of the earlier cameras
    if bar is not None:
        write_bar(folder / "rig.toml", rig, *bar)
    for view in views:
        clips.set_lens(view.clip, found[view.name])


CLASSES = (CamerasFromFile, CamerasFromScene)
