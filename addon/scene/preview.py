"""Pictures of the scene: the body shaded, next to the body over the footage; and a turntable movie. Workbench: fast, without a GPU.

The footage is undistorted with the calibrated lens, so that it fits the ideal camera that Blender renders with.
"""

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import cv2
import numpy as np
from mathutils import Matrix, Vector

from ...core.foundation import store
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.geometry.camera import Camera, image_of, interior_of
from ...core.images.sequence import decoded
from . import cloud, surroundings, trajectories
from .contents import Contents

BACKGROUND = 40  # grey level behind the body
OPACITY = 0.6  # of the body over the footage
TURN_FRAMES, TURN_SIZE_PX, TURN_FPS = 48, (480, 640), 24.0
TURN_LENS_MM = 50.0
SHOWN = ("MESH", "META")
HIDDEN = (cloud.NAME, trajectories.NAME, trajectories.ARROWS_NAME, surroundings.FLOOR)


def preview(contents: Contents, path: Path, frame: int | None = None) -> None:
    """Write a picture of one frame (default the middle one): the body shaded, and next to it the body over the reference view's footage.

    Raises:
        InputError: there is no body or no footage to show, or the file cannot be written.
    """
    footage = contents.footage
    if contents.shape is None or footage is None:
        raise InputError(f"A preview of {contents.out} needs a fitted body and the footage; run the take first.")
    scene = bpy.context.scene
    frame = (scene.frame_start + scene.frame_end) // 2 if frame is None else frame
    scene.frame_set(frame)
    with _only_body(scene):
        picture = _rendered(scene)
    reference = footage.take.reference
    grey = footage.sequences[reference].read(footage.number(reference, frame))
    behind = np.repeat(undistorted(grey, footage.rig.cameras[reference])[..., None], 3, axis=2)
    alone = _over(np.full(picture.shape[:2] + (3,), float(BACKGROUND)), picture, 1.0)
    over = _over(cv2.resize(behind, picture.shape[1::-1]), picture, OPACITY)
    store.write_bytes(path, bytes(cv2.imencode(".png", np.hstack([alone, over]).clip(0, 255).astype(np.uint8))[1]))


def turntable(path: Path, frame: int | None = None, monitor: Monitor | None = None) -> None:
    """Write a movie (.mp4) of a turn around the body in one frame (default the middle one).

    Raises:
        InputError: the movie cannot be written.
        Cancelled: the monitor was cancelled; no movie is written.
    """
    scene, monitor = bpy.context.scene, monitor or Monitor()
    scene.frame_set((scene.frame_start + scene.frame_end) // 2 if frame is None else frame)
    pictures = []
    with _only_body(scene), _turning_camera(scene) as turn:
        for i in range(TURN_FRAMES):
            monitor.step("turntable", i, TURN_FRAMES)
            turn(2 * math.pi * i / TURN_FRAMES)
            picture = _rendered(scene)
            pictures.append(_over(np.full(picture.shape[:2] + (3,), float(BACKGROUND)), picture, 1.0).clip(0, 255).astype(np.uint8))
    _write_movie(path, pictures)


def undistorted(grey: np.ndarray, camera: Camera) -> np.ndarray:
    """The image through Blender's camera: an ideal lens of the same principal point and focal lengths, affinity included."""
    interior = interior_of(camera)
    f, cx, cy, b1 = interior[0], *interior[1:3], interior[8]
    y, x = np.indices(grey.shape, dtype=np.float64)
    rays = np.stack([(x - cx) / (f * (1 + b1)), (y - cy) / f, np.ones(grey.shape)], axis=-1)
    places = image_of(interior, rays.reshape(-1, 3), camera.fisheye).reshape(*grey.shape, 2).astype(np.float32)
    return np.asarray(cv2.remap(grey.astype(np.float32), places, None, cv2.INTER_LINEAR))


@contextmanager
def _only_body(scene: bpy.types.Scene) -> Iterator[None]:
    """Render with Workbench on a transparent background, without cloud and trails; restores the scene afterwards."""
    render, shading = scene.render, scene.display.shading
    earlier = render.engine, render.film_transparent, shading.light, shading.color_type, shading.show_cavity
    hidden = [o for o in scene.objects if o.type in SHOWN and not o.hide_render and o.name.split(".")[0] in HIDDEN]
    for thing in hidden:
        thing.hide_render = True
    render.engine, render.film_transparent = "BLENDER_WORKBENCH", True
    shading.light, shading.color_type, shading.show_cavity = "STUDIO", "MATERIAL", True
    try:
        yield
    finally:
        render.engine, render.film_transparent, shading.light, shading.color_type, shading.show_cavity = earlier
        for thing in hidden:
            thing.hide_render = False


@contextmanager
def _turning_camera(scene: bpy.types.Scene) -> Iterator:
    centre, radius = _extent(scene)
    data = bpy.data.cameras.new("Turntable")
    camera = bpy.data.objects.new("Turntable", data)
    scene.collection.objects.link(camera)
    data.lens, data.sensor_fit = TURN_LENS_MM, "VERTICAL"
    data.sensor_height = 36.0
    distance = 1.15 * radius / math.sin(math.atan(0.5 * data.sensor_height / data.lens))
    render = scene.render
    earlier = scene.camera, render.resolution_x, render.resolution_y, render.pixel_aspect_x, render.pixel_aspect_y
    scene.camera = camera
    render.resolution_x, render.resolution_y = TURN_SIZE_PX
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0

    def turn(angle: float) -> None:
        place = centre + distance * Vector((math.sin(angle), -math.cos(angle), 0.15))
        camera.matrix_world = Matrix.Translation(place) @ (centre - place).to_track_quat("-Z", "Y").to_matrix().to_4x4()

    try:
        yield turn
    finally:
        scene.camera, render.resolution_x, render.resolution_y, render.pixel_aspect_x, render.pixel_aspect_y = earlier
        bpy.data.cameras.remove(data)


def _extent(scene: bpy.types.Scene) -> tuple[Vector, float]:
    """Centre and radius of the posed armatures."""
    graph = bpy.context.evaluated_depsgraph_get()
    ends = [
        o.matrix_world @ end
        for o in scene.objects
        if o.type == "ARMATURE"
        for bone in o.evaluated_get(graph).pose.bones
        if bone.bone.use_deform
        for end in (bone.head, bone.tail)
    ]
    if not ends:
        raise InputError("A turntable needs a body; run the fit first.")
    low, high = (Vector(pick(p[i] for p in ends) for i in range(3)) for pick in (min, max))
    return (low + high) / 2, (high - low).length / 2 + 0.1


def _rendered(scene: bpy.types.Scene) -> np.ndarray:
    """A render of the scene (h, w, 4), BGR and alpha, 0…255."""
    with tempfile.TemporaryDirectory() as folder:
        earlier = scene.render.filepath, scene.render.image_settings.file_format, scene.render.image_settings.color_mode
        scene.render.filepath = str(Path(folder) / "picture.png")
        scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
        try:
            bpy.ops.render.render(write_still=True)
        finally:
            scene.render.filepath, scene.render.image_settings.file_format, scene.render.image_settings.color_mode = earlier
        return decoded(Path(folder) / "picture.png").astype(np.float64)


def _over(behind: np.ndarray, picture: np.ndarray, opacity: float) -> np.ndarray:
    alpha = opacity * picture[..., 3:] / 255.0
    return (1 - alpha) * behind + alpha * picture[..., :3]


def _write_movie(path: Path, pictures: list[np.ndarray]) -> None:
    part = store.part_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        movie = cv2.VideoWriter(str(part), cv2.VideoWriter_fourcc(*"mp4v"), TURN_FPS, pictures[0].shape[1::-1])
        for picture in pictures:
            movie.write(picture)
        movie.release()
        part.replace(path)
    except OSError as error:
        raise InputError(f"Cannot write {path}: {error.strerror or error}. Choose another folder or free some space.") from error
    finally:
        part.unlink(missing_ok=True)
