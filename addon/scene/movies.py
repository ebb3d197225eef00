"""Movies of the scene, from a camera of their own: the body in its colours in motion, or one frame of it on a turntable. Workbench.

    place = centre + distance (cos e · u(a), sin e) ,   distance = MARGIN · radius / sin(half the angle of view)               (1)

a is the angle around the vertical from the side of the scene's camera, e the elevation. Centre and radius are those of the joints in all
frames that the movie shows, so that the person stays in the picture and the camera shows how the person moves in space.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import cv2
import numpy as np
from mathutils import Matrix, Vector

from ...core.foundation import store
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from . import cloud, trajectories
from .preview import BACKGROUND, HIDDEN, laid_over, only_body, rendered

CODEC = "mp4v"
TURN_FRAMES, TURN_SIZE_PX, TURN_FPS = 48, (480, 640), 24.0  # of a turntable
TURN_ELEVATION_DEG = 8.6
FILM_SIZE_PX = (960, 720)
LENS_MM, SENSOR_MM = 50.0, 36.0
MARGIN = 1.05
BEYOND_JOINTS_M = 0.1  # of the skin
MOST_LOOKED_AT = 100  # frames, of which centre and radius are found
WITHOUT = (cloud.NAME, trajectories.NAME, trajectories.ARROWS_NAME)  # of a film; it shows the floor

Place = Callable[[float, float], None]  # puts the camera at an angle and an elevation, degrees


def turntable(path: Path, frame: int | None = None, monitor: Monitor | None = None) -> None:
    """Write a movie (.mp4) of a turn around the body in one frame (default the middle one).

    Raises:
        InputError: there is no body, or the movie cannot be written.
        Cancelled: the monitor was cancelled; no movie is written.
    """
    scene, monitor = bpy.context.scene, monitor or Monitor()
    scene.frame_set((scene.frame_start + scene.frame_end) // 2 if frame is None else frame)

    def pictures(place: Place) -> Iterator[np.ndarray]:
        for i in range(TURN_FRAMES):
            monitor.step("turntable", i, TURN_FRAMES)
            place(360 * i / TURN_FRAMES, TURN_ELEVATION_DEG)
            yield _picture(scene)

    with only_body(scene, HIDDEN, "TEXTURE"), _own_camera(scene, [scene.frame_current], TURN_SIZE_PX) as place:
        _write_movie(path, pictures(place), TURN_FRAMES, TURN_FPS)


def film(
    path: Path,
    monitor: Monitor | None = None,
    *,
    start_deg: float,
    turn_deg: float,
    elevation_deg: float,
) -> None:
    """Write a movie (.mp4) of every frame of the scene. The camera begins `start_deg` around the person from the side of the scene's camera
    (positive: to its right), and circles by `turn_deg` until the last frame.  (1)

    Raises:
        InputError: there is no body, or the movie cannot be written.
        Cancelled: the monitor was cancelled; no movie is written.
    """
    scene, monitor = bpy.context.scene, monitor or Monitor()
    frames, before = range(scene.frame_start, scene.frame_end + 1), scene.frame_current

    def pictures(place: Place) -> Iterator[np.ndarray]:
        for i, frame in enumerate(frames):
            monitor.step("film of the scene", i, len(frames))
            scene.frame_set(frame)
            place(start_deg + turn_deg * i / max(1, len(frames) - 1), elevation_deg)
            yield _picture(scene)

    try:
        with only_body(scene, WITHOUT, "TEXTURE"), _own_camera(scene, frames, FILM_SIZE_PX) as place:
            _write_movie(path, pictures(place), len(frames), scene.render.fps / scene.render.fps_base)
    finally:
        scene.frame_set(before)


@contextmanager
def _own_camera(scene: bpy.types.Scene, frames: Iterable[int], size_px: tuple[int, int]) -> Iterator[Place]:
    """A camera for the person in some frames, while the picture has this size; restores the scene afterwards."""
    centre, radius = _extent(scene, frames)
    towards = scene.camera.matrix_world.translation - centre if scene.camera is not None else Vector((0.0, -1.0, 0.0))
    zero = math.atan2(towards.y, towards.x)
    data = bpy.data.cameras.new("Movie")
    camera = bpy.data.objects.new("Movie", data)
    scene.collection.objects.link(camera)
    data.lens, data.sensor_height = LENS_MM, SENSOR_MM
    data.sensor_fit = "VERTICAL"
    distance = MARGIN * radius / math.sin(math.atan(0.5 * SENSOR_MM * min(1.0, size_px[0] / size_px[1]) / LENS_MM))
    render = scene.render
    earlier = scene.camera, render.resolution_x, render.resolution_y, render.pixel_aspect_x, render.pixel_aspect_y
    percentage, scene.camera, render.resolution_percentage = render.resolution_percentage, camera, 100
    render.resolution_x, render.resolution_y = size_px
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0

    def place(angle_deg: float, elevation_deg: float) -> None:
        a, e = zero + math.radians(angle_deg), math.radians(elevation_deg)
        at = centre + distance * Vector((math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)))  # (1)
        camera.matrix_world = Matrix.Translation(at) @ (centre - at).to_track_quat("-Z", "Y").to_matrix().to_4x4()

    try:
        yield place
    finally:
        scene.camera, render.resolution_x, render.resolution_y, render.pixel_aspect_x, render.pixel_aspect_y = earlier
        render.resolution_percentage = percentage
        bpy.data.cameras.remove(data)


def _extent(scene: bpy.types.Scene, frames: Iterable[int]) -> tuple[Vector, float]:
    """Centre and radius of the posed armatures in some frames. Raises InputError without a body."""
    every = list(frames)
    ends = []
    for frame in every[:: max(1, len(every) // MOST_LOOKED_AT)]:
        scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        ends += [
            o.matrix_world @ end
            for o in scene.objects
            if o.type == "ARMATURE"
            for bone in o.evaluated_get(graph).pose.bones
            if bone.bone.use_deform
            for end in (bone.head, bone.tail)
        ]
    if not ends:
        raise InputError("A movie of the scene needs a body; run the fit first.")
    centre = (np.min(ends, axis=0) + np.max(ends, axis=0)) / 2
    return Vector(centre), float(np.linalg.norm(np.array(ends) - centre, axis=1).max()) + BEYOND_JOINTS_M


def _picture(scene: bpy.types.Scene) -> np.ndarray:
    """The scene through its camera (h, w, 3)."""
    picture = rendered(scene)
    behind = np.full(picture.shape[:2] + (3,), float(BACKGROUND))
    return np.asarray(laid_over(behind, picture, 1.0).clip(0, 255).astype(np.uint8))


def _write_movie(path: Path, pictures: Iterable[np.ndarray], count: int, fps: float) -> None:
    """Write the movie, whole or not at all; the pictures are made one after the other."""
    part, movie = store.part_of(path), None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for picture in pictures:
            movie = movie or cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*CODEC), fps, picture.shape[1::-1])
            movie.write(picture)
        if movie is not None:
            movie.release()
        if cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT) != count:  # the writer does not report a full disk
            raise InputError(f"The movie {path} could not be written whole; check that the disk has room.")
        part.replace(path)
    except OSError as error:
        raise InputError(f"Cannot write {path}: {error.strerror or error}. Choose another folder or free some space.") from error
    finally:
        if movie is not None:
            movie.release()
        part.unlink(missing_ok=True)
