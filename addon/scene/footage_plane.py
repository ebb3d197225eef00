"""The footage behind the body in renders: a distant screen before each camera, with the images as an emitting texture.

The vertices of its grid lie on rays through the ideal image that Blender's camera renders, and their texture coordinates are where the real
lens shows these rays: the texture is undistorted as it is drawn, by EEVEE and Cycles alike. Between vertices it is interpolated linearly.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import bpy
import numpy as np

from ...core.geometry.camera import Camera, image_of, interior_of
from .. import folders
from . import nodes, stored
from .standing import FLOOR

NAME = "Footage"
DISTANCE_M = 200.0
COLUMNS, ROWS = 64, 48
PLAIN = "Standard"  # the view transform that shows footage as it is
EARLIER_KEY = "tricap_view_transform"  # custom property of the scene: its view transform before


def add_screen(
    collection: bpy.types.Collection, camera_object: bpy.types.Object, camera: Camera, clip: bpy.types.MovieClip, files: Sequence[Path]
) -> None:
    """The screen of one camera, hidden until `show`; `files`: those of the clip."""
    mesh = bpy.data.meshes.new(f"{NAME} {camera.name}")
    xyz_m, faces, uv = grid(camera)
    mesh.from_pydata(xyz_m.tolist(), [], faces.tolist())
    layer = mesh.uv_layers.new(name="Footage")
    layer.uv.foreach_set("vector", uv[faces.ravel()].astype(np.float32).ravel())
    mesh.materials.append(_material(f"{NAME} {camera.name}", clip, files))
    screen = bpy.data.objects.new(mesh.name, mesh)
    screen.parent = camera_object
    screen.hide_render = screen.hide_viewport = screen.hide_select = True
    collection.objects.link(screen)


def grid(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] in the axes of a Blender camera, faces (F, 4), and texture coordinates (V, 2)."""
    w, h = camera.size_px
    interior = interior_of(camera)
    f, cx, cy, b1 = interior[0], *interior[1:3], interior[8]
    x, y = np.meshgrid(np.linspace(-0.5, w - 0.5, COLUMNS + 1), np.linspace(-0.5, h - 0.5, ROWS + 1))
    rays = np.stack([(x - cx) / (f * (1 + b1)), (y - cy) / f, np.ones(x.shape)], axis=-1).reshape(-1, 3)
    xy_px = image_of(interior, rays, camera.fisheye)
    uv = (xy_px + 0.5) / (w, h)
    uv[:, 1] = 1.0 - uv[:, 1]
    first = (np.arange(ROWS)[:, None] * (COLUMNS + 1) + np.arange(COLUMNS)).reshape(-1, 1)
    faces = first + np.array([COLUMNS + 1, COLUMNS + 2, 1, 0])
    return DISTANCE_M * rays * (1.0, -1.0, -1.0), faces, uv


def _material(name: str, clip: bpy.types.MovieClip, files: Sequence[Path]) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    tree = nodes.tree_of(material)
    tree.nodes.clear()
    texture, emission, output = (tree.nodes.new(kind) for kind in ("ShaderNodeTexImage", "ShaderNodeEmission", "ShaderNodeOutputMaterial"))
    image = bpy.data.images.load(str(files[0]))
    image.filepath = folders.for_user(files[0])
    texture.image, texture.extension = image, "CLIP"
    user, moving = texture.image_user, len(files) > 1
    if moving:
        image.source = "SEQUENCE"
    digits = files[0].stem[len(files[0].stem.rstrip("0123456789")) :]
    user.frame_start, user.frame_duration = clip.frame_start, clip.frame_duration
    user.frame_offset = int(digits) - 1 if moving and digits else 0
    user.use_auto_refresh = True
    tree.links.new(texture.outputs["Color"], emission.inputs["Color"])
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    return material


def screens(scene: bpy.types.Scene) -> Iterator[bpy.types.Object]:
    """The screens of a scene."""
    return (
        thing for thing in scene.objects if thing.name.startswith(f"{NAME} ") and thing.parent is not None and thing.parent.type == "CAMERA"
    )


def shown(scene: bpy.types.Scene) -> bool:
    """Whether renders show the footage."""
    return any(not screen.hide_render for screen in screens(scene))


def show(scene: bpy.types.Scene, visible: bool) -> None:
    """Render the footage of the scene's camera behind the body, without the floor, or the studio."""
    for screen in screens(scene):
        screen.hide_render = not (visible and screen.parent == scene.camera)
    for thing in scene.objects:
        if thing.name.split(".")[0] == FLOOR:
            thing.hide_render = visible
    view = scene.view_settings
    if visible and EARLIER_KEY not in scene:
        scene[EARLIER_KEY] = view.view_transform
        view.view_transform = PLAIN
    elif not visible and EARLIER_KEY in scene:
        earlier = stored.text(scene, EARLIER_KEY)
        with suppress(TypeError):  # no transform of this Blender's
            view.view_transform = earlier
        del scene[EARLIER_KEY]
