"""bpy.ops.tricap.cameras_from_file(filepath="…"), bpy.ops.tricap.cameras_from_scene()"""

from pathlib import Path

import bpy
import numpy as np
from bpy_extras.io_utils import ImportHelper

from ...core.calibration.rig_files import read_any
from ...core.geometry.rig import Rig, write_rig
from ...core.take.bar_file import bar_path, read_bar, write_bar
from .. import folders, project
from ..calibrate.cameras import rig_of_scene
from ..scene import clips
from .footage import Told


class CamerasFromFile(Told, ImportHelper, bpy.types.Operator):
    """Read the cameras from a calibration: ours, Anipose, Pose2Sim, caliscope, OpenCV, EasyMocap, COLMAP, OpenPTV or Agisoft"""

    bl_idname = "tricap.cameras_from_file"
    bl_label = "From File"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Read it and keep a copy as rig.toml in the project."""
        path = folders.absolute(self.filepath)
        rig = read_any(path)
        use_rig(context.scene, rig, read_bar(path, rig))
        return f"{len(rig.cameras)} cameras from {Path(self.filepath).name}. Whether they fit the footage, Check tells (step 2)."


class CamerasFromScene(Told, bpy.types.Operator):
    """Take the cameras of this scene; each needs the name of its view, or a movie clip of it behind"""

    bl_idname = "tricap.cameras_from_scene"
    bl_label = "From Scene"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Read the scene's cameras and keep them as rig.toml in the project."""
        rig = rig_of_scene(context.scene)
        use_rig(context.scene, rig)
        return f"{len(rig.cameras)} cameras of the scene."


def use_rig(scene: bpy.types.Scene, rig: Rig, bar: tuple[np.ndarray, np.ndarray] | None = None) -> None:
    """Make these the project's cameras, and give the clips their lenses. `bar`: frames and ends [m] of the bar that gave them.

    Raises:
        InputError: a view has no camera of its name, or the project's folder cannot be written to.
    """
    found = {view.name: rig[view.name] for view in scene.tricap.views}
    folder = project.write(scene)
    write_rig(folder / "rig.toml", rig)
    bar_path(folder / "rig.toml").unlink(missing_ok=True)  # that of the cameras before
    if bar is not None:
        write_bar(folder / "rig.toml", rig, *bar)
    for view in scene.tricap.views:
        clips.set_lens(view.clip, found[view.name])


CLASSES = (CamerasFromFile, CamerasFromScene)
