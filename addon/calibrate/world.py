"""bpy.ops.tricap.set_world(): the world coordinate system from three points that were clicked in the cameras' footage."""

import bpy
import numpy as np
from mathutils import Matrix

from ...core.calibration.world_frame import frame_of_clicks
from ...core.foundation.errors import InputError
from ...core.geometry.rig import Rig
from .. import clicks, project
from ..scene import axes
from ..steps.cameras import use_rig
from ..steps.simple_operator import SimpleOperator
from .cameras import COLLECTION, EXACT, clip_behind, exact_values, rig_of_scene

TRACKS = {"origin": "World origin", "x": "World X", "y": "World Y"}


class SetWorld(SimpleOperator, bpy.types.Operator):
    """Set the world's origin, X axis and floor from the tracks “World origin”, “World X” and “World Y”, each in two or more clips"""

    bl_idname = "tricap.set_world"
    bl_label = "Set World from Tracks"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Move the cameras and what was built with them; update the project's rig.toml."""
        scene = context.scene
        rig = rig_of_scene(scene)
        frame = frame_of_clicks(rig.cameras, world_clicks(scene))
        before = project.rig_of(scene) if project.bound(scene) else None
        metadata = {**(before.metadata if before else {}), "unit": "m", "floor": True}
        moved = Rig(cameras=tuple(frame.camera(camera) for camera in rig.cameras), metadata=metadata)
        if project.bound(scene):
            use_rig(scene, moved)
        place(scene, moved, Matrix(np.block([[frame.R, frame.shift_m[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])))
        return f"The world was set from the tracks; {len(rig.cameras)} cameras moved."


def world_clicks(scene: bpy.types.Scene) -> dict[str, dict[str, list[float]]]:
    """Pixels of the clicked points by view; of a track with several markers, the last one up to the scene's frame.

    Raises:
        InputError: no camera has a background clip.
    """
    found: dict[str, dict[str, list[float]]] = {point: {} for point in TRACKS}
    clips = {o: clip for o in scene.objects if o.type == "CAMERA" and (clip := clip_behind(o)) is not None}
    if not clips:
        raise InputError(
            "No camera of the scene has a movie clip as its background. Calibrate first, or import cameras and add their footage."
        )
    for camera_object, clip in clips.items():
        for point, name in TRACKS.items():
            track = clip.tracking.tracks.get(name)
            marker = track.markers.find_frame(clicks.clip_frame(clip, scene.frame_current), exact=False) if track else None
            if marker is not None and not marker.mute:
                found[point][str(camera_object.get("tricap_view", camera_object.name))] = clicks.pixel_of(marker.co, tuple(clip.size))
    for point, name in TRACKS.items():
        if len(found[point]) < 2:
            raise InputError(f"The track “{name}” must be in the clips of at least two cameras; it is in {len(found[point])}.")
    return found


def place(scene: bpy.types.Scene, rig: Rig, change: Matrix) -> None:
    """Move the scene's cameras to those of the rig, and what was built with them by `change` (4, 4), from the old world to the new."""
    cameras = {str(o.get("tricap_view", o.name)): o for o in scene.objects if o.type == "CAMERA"}
    for camera in rig.cameras:
        cameras[camera.name].matrix_world = Matrix(axes.camera_to_world(camera))
        if EXACT in cameras[camera.name]:
            cameras[camera.name][EXACT] = exact_values(camera)
    collection = bpy.data.collections.get(COLLECTION)
    for other in collection.objects if collection is not None else ():
        if other.type != "CAMERA" and other.parent is None:
            other.matrix_world = change @ other.matrix_world


CLASSES = (SetWorld,)
