"""Calibrated cameras in the open scene, and the scene's cameras as a calibrated rig.

Blender stores lens, shift and pose in single precision. The calibrated values are therefore also stored in double precision, and used as
long as the camera is unchanged; a camera that was made or changed in Blender is read from Blender's own values.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.geometry.camera import Camera
from ...core.geometry.rig import Rig
from ..scene import axes, clips, stored
from ..scene.cameras import SIZE_KEY, add_camera, frame_render
from ..scene.surroundings import add_bar

COLLECTION = "Tricap Rig"
EXACT = "tricap_exact"
SAME = 2e-6  # relative tolerance of single precision


def build_cameras(
    scene: bpy.types.Scene,
    rig: Rig,
    files: dict[str, list[Path]],
    tracks: dict[str, np.ndarray],
    bar: tuple[np.ndarray, np.ndarray] | None = None,
    firsts: Mapping[str, int] = MappingProxyType({}),
) -> list[bpy.types.Object]:
    """Cameras in a collection of their own, with their footage as background and the measured targets as its tracks.

    `bar`: frames (T,) and ends (T, 2, 3) [m] of the wand, which is built as well. `firsts`: the image of each view at frame 0, if not its
    first one. Cameras that were built before are replaced.
    """
    old = bpy.data.collections.get(COLLECTION)
    if old is not None:
        for camera_object in list(old.objects):
            bpy.data.objects.remove(camera_object)
        bpy.data.collections.remove(old)
    collection = bpy.data.collections.new(COLLECTION)
    scene.collection.children.link(collection)
    made = []
    for camera in rig.cameras:
        camera_object = add_camera(collection, camera)
        camera_object[EXACT] = exact_values(camera)
        if files.get(camera.name):
            clip = clips.load_clip(f"Bar {camera.name}", files[camera.name][0], camera)
            first = firsts.get(camera.name, 0)
            clip.frame_start -= first
            clips.show_behind(camera_object.data, clip)
            if camera.name in tracks:
                add_tracks(clip, tracks[camera.name], camera.size_px, first)
        made.append(camera_object)
    if bar is not None:
        add_bar(collection, *bar)
    middle = made[len(made) // 2]
    scene.camera = middle
    frame_render(scene, rig[middle["tricap_view"]])
    return made


def add_tracks(clip: bpy.types.MovieClip, xy_px: np.ndarray, size_px: tuple[int, int], first: int = 0) -> None:
    """The measured targets (T, 2, 2) from image `first` on as two tracks of the clip; the clip's own frames count from 1."""
    uv = axes.uv_from_pixel(xy_px, size_px)
    for end in range(2):
        visible = np.flatnonzero(np.isfinite(uv[:, end]).all(axis=1))
        made = clip.tracking.tracks.new(name=f"Bar end {end + 1}", frame=int(visible[0]) + first + 1 if len(visible) else 1)
        for n in visible:
            made.markers.insert_frame(int(n) + first + 1, co=tuple(uv[n, end]))


def rig_of_scene(scene: bpy.types.Scene) -> Rig:
    """The scene's cameras as a rig, with the lens distortion of their background clips.

    Raises:
        InputError: there is no camera, or one is not a central projection.
    """
    found = [o for o in scene.objects if o.type == "CAMERA"]
    if not found:
        raise InputError("The scene has no camera. Add cameras, or calibrate first.")
    return Rig(cameras=tuple(camera_of(scene, camera_object) for camera_object in found))


def clip_behind(camera_object: bpy.types.Object) -> bpy.types.MovieClip | None:
    """The movie clip that a camera shows in its background, or None."""
    if clips.CLIP_KEY in camera_object.data and clips.clip_behind(camera_object.data) is None:
        return None
    return next((b.clip for b in camera_object.data.background_images if b.source == "MOVIE_CLIP" and b.clip), None)


def camera_of(scene: bpy.types.Scene, camera_object: bpy.types.Object) -> Camera:
    """One camera of the scene.

    Raises:
        InputError: it is not a perspective camera, or its clip has another lens model.
    """
    data = camera_object.data
    if data.type != "PERSP":
        raise InputError(f"{camera_object.name} is not a perspective camera. Change the lens type in its properties.")
    clip = clip_behind(camera_object)
    own = stored.numbers(camera_object, SIZE_KEY, 2)
    size = tuple(max(1, int(v)) for v in (own or (clip.size if clip else (scene.render.resolution_x, scene.render.resolution_y))))
    aspect = clip.tracking.camera.pixel_aspect if clip else scene.render.pixel_aspect_y / scene.render.pixel_aspect_x
    w, h = size
    upright = data.sensor_fit == "VERTICAL" or (data.sensor_fit == "AUTO" and h * aspect > w)
    fitted = h * aspect if upright else w  # of the image, in pixels of its rows, on the sensor's side; shifts are parts of it
    fx = data.lens * fitted / (data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width)
    cx, cy = axes.pixel_from_uv(np.array([0.5 - data.shift_x * fitted / w, 0.5 - data.shift_y * fitted / h / aspect]), (w, h))
    R, t = axes.camera_from_world(np.array(camera_object.matrix_world))
    name = str(camera_object.get("tricap_view", camera_object.name))
    matrix = np.array([[fx, 0, cx], [0, fx / aspect, cy], [0, 0, 1]])
    read = Camera(name=name, size_px=(w, h), matrix=matrix, distortions=np.zeros(5), R_cam_world=R, t_cam_world_m=t)
    values = stored.numbers(camera_object, EXACT, 28, 29)
    exact = None if values is None else _exact_camera(read, np.array(values))
    read = replace(read, distortions=_distortions(clip, exact))
    return exact if exact is not None and _unchanged(read, exact, clip is not None) else read


def _distortions(clip: bpy.types.MovieClip | None, exact: Camera | None) -> np.ndarray:
    """k1 k2 p1 p2 k3 of the clip's tracking camera, or those of the calibrated fisheye lens if the clip still has the nearest ones."""
    if clip is None:
        return np.zeros(5)
    lens = clip.tracking.camera
    if exact is not None and exact.fisheye and lens.distortion_model == "BROWN":
        nearest = axes.brown_coefficients(exact)
        if all(abs(getattr(lens, name) - value) <= SAME * max(1.0, abs(value)) for name, value in nearest.items()):
            return exact.distortions
    if lens.distortion_model == "BROWN":
        if lens.brown_k4:
            raise InputError(
                f"The lens of the clip {clip.name} has a coefficient K4, which Tricap does not support. Set it to 0 and solve again."
            )
        return np.array([lens.brown_k1, lens.brown_k2, -lens.brown_p2, lens.brown_p1, lens.brown_k3])
    if lens.distortion_model == "POLYNOMIAL":
        return np.array([lens.k1, lens.k2, 0.0, 0.0, lens.k3])
    raise InputError(f"The lens model “{lens.distortion_model}” of the clip {clip.name} is not supported. Choose Brown or Polynomial.")


def exact_values(camera: Camera) -> list[float]:
    """All numbers of a camera in double precision."""
    parts = (camera.matrix, camera.distortions, camera.affinity, camera.R_cam_world, camera.t_cam_world_m)
    return [*(float(v) for part in parts for v in part.ravel()), float(camera.fisheye)]


def _exact_camera(read: Camera, values: np.ndarray) -> Camera:
    return Camera(
        name=read.name,
        size_px=read.size_px,
        matrix=values[:9].reshape(3, 3),
        distortions=values[9:14],
        affinity=values[14:16],
        R_cam_world=values[16:25].reshape(3, 3),
        t_cam_world_m=values[25:28],
        fisheye=len(values) > 28 and bool(values[28]),
    )


def _unchanged(read: Camera, exact: Camera, has_lens: bool) -> bool:
    """Whether Blender's values still equal the calibrated ones within single precision; `has_lens`: it has a background clip."""
    fx = exact.matrix[0, 0] * (1 + exact.affinity[0])
    expected = np.array([fx, exact.matrix[1, 1], *exact.matrix[:2, 2], *exact.R_cam_world.ravel(), *exact.t_cam_world_m])
    got = np.array([read.matrix[0, 0], read.matrix[1, 1], *read.matrix[:2, 2], *read.R_cam_world.ravel(), *read.t_cam_world_m])
    pixels = SAME * max(read.size_px) * 4
    scale = np.array([fx * SAME * 4, fx * SAME * 4, pixels, pixels, *[SAME] * 9, *[SAME * (1 + np.abs(exact.t_cam_world_m).max()) * 4] * 3])
    calibrated = exact.distortions
    distorted = has_lens and np.abs(read.distortions - calibrated).max() > SAME * max(1.0, np.abs(calibrated).max())
    return bool((np.abs(expected - got) <= scale).all() and not distorted)
