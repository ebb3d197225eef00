"""A picture of the scene: the body shaded, next to the body over the footage. Workbench: fast, without a GPU.

The footage is undistorted with the calibrated lens, so that it fits the ideal camera that Blender renders with.
"""

import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import bpy
import cv2
import numpy as np

from ...core.cli.streams import unheard
from ...core.foundation import store
from ...core.foundation.errors import InputError
from ...core.geometry.camera import Camera, image_of, interior_of
from ...core.images.picture import decoded
from . import cloud, surroundings, trajectories
from .contents import Contents

BACKGROUND = 40  # grey level behind the body
OPACITY = 0.6  # of the body over the footage
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
    with only_body(scene):
        picture = rendered(scene)
    reference = footage.take.reference
    grey = footage.sequences[reference].read(footage.number(reference, frame))
    behind = np.repeat(undistorted(grey, footage.rig.cameras[reference])[..., None], 3, axis=2)
    alone = laid_over(np.full(picture.shape[:2] + (3,), float(BACKGROUND)), picture, 1.0)
    over = laid_over(cv2.resize(behind, picture.shape[1::-1]), picture, OPACITY)
    store.write_bytes(path, bytes(cv2.imencode(".png", np.hstack([alone, over]).clip(0, 255).astype(np.uint8))[1]))


def undistorted(grey: np.ndarray, camera: Camera) -> np.ndarray:
    """The image through Blender's camera: an ideal lens of the same principal point and focal lengths, affinity included."""
    interior = interior_of(camera)
    f, cx, cy, b1 = interior[0], *interior[1:3], interior[8]
    y, x = np.indices(grey.shape, dtype=np.float64)
    rays = np.stack([(x - cx) / (f * (1 + b1)), (y - cy) / f, np.ones(grey.shape)], axis=-1)
    places = image_of(interior, rays.reshape(-1, 3), camera.fisheye).reshape(*grey.shape, 2).astype(np.float32)
    return np.asarray(cv2.remap(grey.astype(np.float32), places, None, cv2.INTER_LINEAR))


@contextmanager
def only_body(scene: bpy.types.Scene, hidden: Collection[str] = HIDDEN, colours: str = "MATERIAL") -> Iterator[None]:
    """Render with Workbench on a transparent background, without the objects of some names; restores the scene afterwards.

    `colours`: of the surfaces, "MATERIAL" or "TEXTURE", which is that of the material where there is no texture.
    """
    render, shading = scene.render, scene.display.shading
    earlier = render.engine, render.film_transparent, shading.light, shading.color_type, shading.show_cavity
    left_out = [o for o in scene.objects if o.type in SHOWN and not o.hide_render and o.name.split(".")[0] in hidden]
    for thing in left_out:
        thing.hide_render = True
    render.engine, render.film_transparent = "BLENDER_WORKBENCH", True
    shading.light, shading.color_type, shading.show_cavity = "STUDIO", colours, True
    try:
        yield
    finally:
        render.engine, render.film_transparent, shading.light, shading.color_type, shading.show_cavity = earlier
        for thing in left_out:
            thing.hide_render = False


def rendered(scene: bpy.types.Scene) -> np.ndarray:
    """A render of the scene (h, w, 4), BGR and alpha, 0…255."""
    with tempfile.TemporaryDirectory() as folder:
        earlier = scene.render.filepath, scene.render.image_settings.file_format, scene.render.image_settings.color_mode
        scene.render.filepath = str(Path(folder) / "picture.png")
        scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
        try:
            with unheard() if bpy.app.background else nullcontext():  # graphics drivers print errors that do not matter
                bpy.ops.render.render(write_still=True)
        finally:
            scene.render.filepath, scene.render.image_settings.file_format, scene.render.image_settings.color_mode = earlier
        return decoded(Path(folder) / "picture.png").astype(np.float64)


def laid_over(behind: np.ndarray, picture: np.ndarray, opacity: float) -> np.ndarray:
    """A rendered picture (h, w, 4) over an image (h, w, 3)."""
    alpha = opacity * picture[..., 3:] / 255.0
    return (1 - alpha) * behind + alpha * picture[..., :3]
