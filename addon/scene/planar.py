"""2-D tracks of one camera as Blender data: the footage as an image empty, an animated empty in front of it for every point, and curves
between joined points.

The image stands upright in the xz plane, its longer side is one metre, and it is the parent of everything: it can be moved, rotated and
scaled. The ends of a curve are hooked to their empties (Hook modifiers), so that they follow an empty that is moved by hand.
"""

import re
from collections.abc import Sequence
from math import pi
from pathlib import Path

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.images.sequence import ImageSequence
from ...core.tracking.point_tables import PlanarTable
from .action import key

COLLECTION, PICTURE = "2-D Tracks", "Footage"
POINT_M = 0.006  # radius of a point
LINE_M = 0.0012  # radius of a curve
IN_FRONT_M = 0.002  # distance of points and curves from the image
HIDDEN = ("hide_viewport", "hide_render")


def add_planar(
    scene: bpy.types.Scene, table: PlanarTable, joined: Sequence[tuple[str, str]], footage: ImageSequence | None, first: int = 0
) -> bpy.types.Collection:
    """A new collection with the points of a table, the curves that join them by name, and the footage where there is one, whose image 0 is
    shown in frame `first`.

    A point is hidden in frames where it was not tracked, and a curve where one of its points is hidden.

    Raises:
        InputError: Blender cannot read the footage.
    """
    size = np.nanmax(table.xy_px, axis=(0, 1)) + 1 if footage is None else np.array(footage.read(0).shape[::-1], dtype=np.float64)
    images = None if footage is None else _images(footage)
    picture = bpy.data.objects.new(PICTURE, None)
    collection = bpy.data.collections.new(COLLECTION)
    scene.collection.children.link(collection)
    collection.objects.link(picture)
    picture.rotation_euler.x = pi / 2
    if footage is not None:
        _show(picture, footage, images, first)
    tracked = np.isfinite(table.xy_px).all(axis=2)
    positions = on_picture(table.xy_px, size)
    points = [_point(collection, picture, name, table.frames, positions[:, n], tracked[:, n]) for n, name in enumerate(table.names)]
    index = {name: n for n, name in enumerate(table.names)}
    for a, b in joined:
        both = tracked[:, index[a]] & tracked[:, index[b]]
        _line(collection, picture, points[index[a]], points[index[b]], table.frames, both)
    scene.frame_start, scene.frame_end = min(scene.frame_start, int(table.frames[0])), max(scene.frame_end, int(table.frames[-1]))
    return collection


def on_picture(xy_px: np.ndarray, size_px: np.ndarray) -> np.ndarray:
    """Positions (…, 3) in the image empty's axes [m] of pixels (…, 2)."""
    longer = size_px.max()
    x, y = (xy_px[..., 0] + 0.5 - size_px[0] / 2) / longer, (size_px[1] / 2 - xy_px[..., 1] - 0.5) / longer
    return np.stack([x, y, np.full_like(x, IN_FRONT_M)], axis=-1)


def _images(footage: ImageSequence) -> bpy.types.Image:
    first = footage.files()[0]
    try:
        images = bpy.data.images.load(str(first))
    except RuntimeError as error:
        raise InputError(f"Blender cannot read the footage {first} ({str(error).strip()}); convert it to H.264 or PNG.") from error
    images.source = "SEQUENCE" if images.source == "FILE" else images.source
    return images


def _show(picture: bpy.types.Object, footage: ImageSequence, images: bpy.types.Image, first: int) -> None:
    """Image n of the footage in frame n + `first` of the scene."""
    picture.empty_display_type, picture.empty_display_size = "IMAGE", 1.0
    picture.data = images
    user, number = picture.image_user, re.search(r"(\d+)\D*$", Path(footage.files()[0]).stem)
    user.frame_start, user.frame_duration = first, footage.count
    user.frame_offset = int(number[1]) - 1 if picture.data.source == "SEQUENCE" and number else 0
    user.use_auto_refresh = True


def _point(
    collection: bpy.types.Collection, picture: bpy.types.Object, name: str, frames: np.ndarray, positions: np.ndarray, tracked: np.ndarray
) -> bpy.types.Object:
    point = bpy.data.objects.new(name, None)
    point.empty_display_type, point.empty_display_size, point.parent = "SPHERE", POINT_M, picture
    collection.objects.link(point)
    action = bpy.data.actions.new(name)
    point.animation_data_create().action = action
    for axis in range(3):
        key(action, point, "location", axis, frames, np.where(tracked, positions[:, axis], np.nan))
    _hide(point, action, frames, tracked)
    return point


def _line(
    collection: bpy.types.Collection,
    picture: bpy.types.Object,
    a: bpy.types.Object,
    b: bpy.types.Object,
    frames: np.ndarray,
    tracked: np.ndarray,
) -> None:
    data = bpy.data.curves.new(f"{a.name} – {b.name}", "CURVE")
    data.dimensions, data.bevel_depth = "3D", LINE_M
    data.splines.new("POLY").points.add(1)  # it begins with one; both at the origin, which the hooks take to their empties
    line = bpy.data.objects.new(data.name, data)
    line.parent = picture
    collection.objects.link(line)
    for end, point in enumerate((a, b)):
        hook = line.modifiers.new(point.name, "HOOK")
        hook.object = point
        hook.vertex_indices_set([end])
    action = bpy.data.actions.new(data.name)
    line.animation_data_create().action = action
    _hide(line, action, frames, tracked)


def _hide(shown: bpy.types.Object, action: bpy.types.Action, frames: np.ndarray, tracked: np.ndarray) -> None:
    changes = np.flatnonzero(np.diff(tracked, prepend=~tracked[:1]))
    for path in HIDDEN:
        key(action, shown, path, 0, frames[changes], (~tracked[changes]).astype(np.float64), "CONSTANT")
