"""Pictures of chosen points (D'Apuzzo et al. 1999, Figs. 6–8): over the footage of every view, with their paths through all frames; and in
space, from the front and from the side of the reference view."""

from collections.abc import Sequence

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..tracking.key_points import KeyPoints
from .drawing import plain, size_of, small_text, text_width
from .pictures import colour
from .trails import both_views, framed, limits_of

COLOURS = ((80, 80, 240), (230, 150, 40), (90, 200, 90), (40, 190, 250), (220, 110, 200), (200, 200, 60))  # BGR, in turns
JOINING = (235, 235, 235)  # of lines between points
NAME_SIZE = 1.3  # of letters, in space


def paths_over_footage(
    grey: np.ndarray, names: tuple[str, ...], xy_px: np.ndarray, last: int, joined: Sequence[tuple[str, str]] = ()
) -> np.ndarray:
    """The paths (T, N, 2) of points in one view up to frame index `last`, over its image (h, w) of that frame, with crosses and names.

    `joined`: points between which there are lines, by their names.
    """
    picture = colour(grey)
    k = size_of(picture)
    for ends in joined:
        line = xy_px[last, [names.index(name) for name in ends]]
        if np.isfinite(line).all():
            cv2.polylines(picture, [np.rint(line * 8).astype(np.int32)], False, JOINING, max(1, round(k)), cv2.LINE_AA, 3)
    for n, name in enumerate(names):
        tint, path = COLOURS[n % len(COLOURS)], xy_px[: last + 1, n]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], np.isfinite(path).all(axis=1), [0]])))
        runs = [np.rint(path[a:b] * 8).astype(np.int32) for a, b in zip(edges[::2], edges[1::2])]
        cv2.polylines(picture, runs, False, tint, max(1, round(k)), cv2.LINE_AA, 3)
        if np.isfinite(path[-1]).all():
            x, y = np.rint(path[-1]).astype(int).tolist()
            cv2.drawMarker(picture, (x, y), tint, cv2.MARKER_CROSS, round(11 * k), max(1, round(k)), cv2.LINE_AA)
            _write_name(picture, name, path, tint, k)
    return picture


def paths_in_space(names: tuple[str, ...], tracked: KeyPoints, camera: Camera) -> np.ndarray | None:
    """The paths of all points with their names from the front and from the right side; None if no point has a position."""
    place = camera.to_camera(tracked.xyz_m.reshape(-1, 3)).reshape(tracked.xyz_m.shape)
    seen = np.isfinite(place).all(axis=2)
    if not seen.any():
        return None
    tints = np.array([COLOURS[n % len(COLOURS)] for n in range(tracked.status.shape[1])])
    middle, half = limits = limits_of(place[seen])
    pair = both_views(place, seen, np.broadcast_to(tints, place.shape), limits)
    for picture, axes, sign in zip(pair, ([0, 1], [2, 1]), (1, -1)):
        for n in np.flatnonzero(seen.any(axis=0)):
            path = picture.shape[0] / 2 * (1 + (place[seen[:, n], n][:, axes] - middle[axes]) * [sign, 1] / half)
            _write_name(picture, names[n], path, COLOURS[n % len(COLOURS)], NAME_SIZE)
    return framed(pair, half)


def _write_name(picture: np.ndarray, name: str, path: np.ndarray, tint: tuple[int, int, int], size: float) -> None:
    """A name at the end of its path (M, 2), on the side from which the path does not come, or where there is room."""
    x, y = np.rint(path[-1]).astype(int).tolist()
    gap, wide = round(7 * size), text_width(plain(name), size)
    right, left = x + gap, x - gap - wide
    ahead = float(np.nanmean(path[:, 0])) > x  # it comes from the right
    at = left if (ahead and left >= 0) or right + wide >= picture.shape[1] else right
    small_text(picture, plain(name), (max(0, at), y - round(5 * size)), tint, size)
