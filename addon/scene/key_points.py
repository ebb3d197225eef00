"""Chosen points in space: an animated empty for each, its path as a trail, and its velocity as arrows (D'Apuzzo et al. 1999, Fig. 8)."""

from typing import TYPE_CHECKING

import bpy
import numpy as np

from .action import key
from .trajectories import add_arrows, add_trajectories

if TYPE_CHECKING:
    from ...core.tracking.point_tables import KeyPointTable

COLLECTION = "Points"
COLLECTION_KEY = "tricap_points"  # custom property by which the collection is found again, whatever its name
POINT_M = 0.008  # radius of an empty
TUBE_M = 0.0015  # radius of a path
HIDDEN = ("hide_viewport", "hide_render")


def add_key_points(scene: bpy.types.Scene, table: "KeyPointTable", fps: float) -> bpy.types.Collection:
    """A collection with the points of a table, in place of the one before."""
    from ...core.tracking.trajectories import differences

    for old in [c for c in scene.collection.children_recursive if COLLECTION_KEY in c]:
        for thing in list(old.all_objects):
            bpy.data.objects.remove(thing)
        bpy.data.collections.remove(old)
    collection = bpy.data.collections.new(COLLECTION)
    collection[COLLECTION_KEY] = True
    scene.collection.children.link(collection)
    sigma = np.where(np.isfinite(table.xyz_m[..., 0]), table.sigma_m, np.nan)
    velocity = differences(table.xyz_m, sigma, 1 / fps).velocity_m_s
    arrays = dict(frames=table.frames, xyz_m=table.xyz_m, velocity_m_s=velocity, sigma_m=sigma, segment=np.zeros(sigma.shape, dtype=int))
    paths, arrows = add_trajectories(collection, arrays, len(table.frames), TUBE_M), add_arrows(collection, arrays)
    paths.name, arrows.name = "Paths of Points", "Velocities of Points"
    for n, name in enumerate(table.names):
        _point(collection, name, table.frames, table.xyz_m[:, n])
    return collection


def _point(collection: bpy.types.Collection, name: str, frames: np.ndarray, xyz_m: np.ndarray) -> None:
    point = bpy.data.objects.new(name, None)
    point.empty_display_type, point.empty_display_size, point.show_name = "SPHERE", POINT_M, True
    collection.objects.link(point)
    action = bpy.data.actions.new(name)
    point.animation_data_create().action = action
    for axis in range(3):
        key(action, point, "location", axis, frames, xyz_m[:, axis])
    tracked = np.isfinite(xyz_m).all(axis=1)
    changes = np.flatnonzero(np.diff(tracked, prepend=~tracked[:1]))
    for path in HIDDEN:
        key(action, point, path, 0, frames[changes], (~tracked[changes]).astype(np.float64), "CONSTANT")
