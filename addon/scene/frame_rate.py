"""The frame rate of a scene, which Blender divides into a whole number and a base."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import bpy


def set_rate(scene: bpy.types.Scene, fps: float) -> None:
    """Give the scene a frame rate, which need not be a whole number."""
    whole = max(1, math.ceil(fps - 1e-3))
    scene.render.fps, scene.render.fps_base = whole, whole / fps


@contextmanager
def rate_of_gltf(scene: bpy.types.Scene) -> Iterator[None]:
    """The rate by which Blender's importer and exporter of glTF compute times: they multiply by the base by which a rate is divided."""
    render = scene.render
    base = render.fps_base
    render.fps_base = 1 / base
    try:
        yield
    finally:
        render.fps_base = base
