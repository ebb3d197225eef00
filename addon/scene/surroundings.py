"""The surroundings of the person: lights, the floor, and the reference bar of a calibration."""

import math

import bpy
import numpy as np

from . import nodes
from .cloud import write
from .standing import FLOOR
from .trajectories import trail_group

LIGHTS = (("Key light", 3.0, (50.0, 0.0, 35.0)), ("Fill light", 1.0, (60.0, 0.0, -70.0)))  # name, W/m², direction in degrees
SQUARE_M, MARGIN_M = 0.5, 6.0  # of the floor: its squares, and its size around a person who stays in one place
BACKGROUND = (0.32, 0.33, 0.35)  # of renders, in a scene without a world
FLOOR_COLOUR, BAR_COLOUR = (0.35, 0.36, 0.38), (0.9, 0.75, 0.1)


def add_lights(collection: bpy.types.Collection) -> None:
    """A sun from the front left above, and a weaker one from the right, so that renders are not black."""
    for name, strength, turned in LIGHTS:
        data = bpy.data.lights.new(name, "SUN")
        data.energy, data.angle = strength, math.radians(10)
        light = bpy.data.objects.new(name, data)
        light.rotation_euler = [math.radians(angle) for angle in turned]
        light.location = (0.0, 0.0, 3.0)
        collection.objects.link(light)


def add_background(scene: bpy.types.Scene) -> None:
    """A grey world that lights evenly, in a scene that has no world; another one stays as it is."""
    if scene.world is None:
        scene.world = bpy.data.worlds.get("Tricap studio") or bpy.data.worlds.new("Tricap studio")
        scene.world.color = BACKGROUND


def add_floor(collection: bpy.types.Collection, height_m: float = 0.0, path_m: np.ndarray | None = None) -> bpy.types.Object:
    """A level floor as squares of half a metre, around the origin or the path (T, 2) of a person over it."""
    path_m = np.zeros((1, 2)) if path_m is None else path_m
    middle = np.round((path_m.min(axis=0) + path_m.max(axis=0)) / 2 / SQUARE_M) * SQUARE_M
    across_m = MARGIN_M + float(np.ptp(path_m, axis=0).max())
    lines = SQUARE_M * np.arange(-np.ceil(across_m / 2 / SQUARE_M), np.ceil(across_m / 2 / SQUARE_M) + 1)
    x, y = np.meshgrid(lines + middle[0], lines + middle[1], indexing="ij")
    first = np.arange(len(lines) - 1)[:, None] * len(lines) + np.arange(len(lines) - 1)
    faces = np.stack([first, first + len(lines), first + len(lines) + 1, first + 1], axis=-1).reshape(-1, 4)
    mesh = bpy.data.meshes.new(FLOOR)
    mesh.from_pydata(np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).tolist(), [], faces.tolist())
    mesh.materials.append(nodes.plain_material(FLOOR, FLOOR_COLOUR))
    floor = bpy.data.objects.new(FLOOR, mesh)
    floor.display_type, floor.hide_select = "WIRE", True
    floor.location.z = height_m
    collection.objects.link(floor)
    return floor


def add_bar(collection: bpy.types.Collection, frames: np.ndarray, ends_m: np.ndarray) -> bpy.types.Object:
    """The reference bar in every frame (T,) of its footage from its ends (T, 2, 3); the viewport shows that of the current frame.

    One mesh of edges with the attribute `frame`; the modifier's Trail also shows earlier frames.
    """
    mesh = bpy.data.meshes.new("Reference bar")
    mesh.vertices.add(2 * len(frames))
    mesh.edges.add(len(frames))
    mesh.edges.foreach_set("vertices", np.arange(2 * len(frames), dtype=np.int32))
    write(mesh, "position", "FLOAT_VECTOR", ends_m.reshape(-1, 3))
    write(mesh, "frame", "INT", np.repeat(frames, 2))
    mesh.update()
    material = nodes.plain_material("Reference bar", BAR_COLOUR)
    mesh.materials.append(material)
    bar = bpy.data.objects.new("Reference bar", mesh)
    collection.objects.link(bar)
    bar.modifiers.new("Current frame", "NODES").node_group = trail_group(material, 0)
    return bar
