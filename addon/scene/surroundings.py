"""The surroundings of the person: lights, the floor, and the reference bar of a calibration."""

import math

import bpy
import numpy as np

from . import nodes
from .cloud import write
from .trajectories import trail_group

LIGHTS = (("Key light", 3.0, (50.0, 0.0, 35.0)), ("Fill light", 1.0, (60.0, 0.0, -70.0)))  # name, W/m², direction in degrees
FLOOR_M, FLOOR_SQUARES = 6.0, 12
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


def add_floor(collection: bpy.types.Collection) -> bpy.types.Object:
    """The plane z = 0 as squares of half a metre around the origin; for rigs whose world frame lies on the floor."""
    lines = np.linspace(-FLOOR_M / 2, FLOOR_M / 2, FLOOR_SQUARES + 1)
    x, y = np.meshgrid(lines, lines, indexing="ij")
    first = np.arange(len(lines) - 1)[:, None] * len(lines) + np.arange(len(lines) - 1)
    faces = np.stack([first, first + len(lines), first + len(lines) + 1, first + 1], axis=-1).reshape(-1, 4)
    mesh = bpy.data.meshes.new("Floor")
    mesh.from_pydata(np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).tolist(), [], faces.tolist())
    mesh.materials.append(nodes.plain_material("Floor", FLOOR_COLOUR))
    floor = bpy.data.objects.new("Floor", mesh)
    floor.display_type, floor.hide_select = "WIRE", True
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
