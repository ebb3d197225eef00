"""The frame rate of a scene, which Blender divides into a whole number and a base."""

import math

import bpy


def set_rate(scene: bpy.types.Scene, fps: float) -> None:
    """Give the scene a frame rate, which need not be a whole number."""
    whole = max(1, math.ceil(fps - 1e-3))
    scene.render.fps, scene.render.fps_base = whole, whole / fps
