"""Pictures of chosen points (D'Apuzzo et al. 1999, Figs. 6–8): over the footage of every view, with their paths through all frames; and in
space, from the front and from the side of the reference view."""

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..tracking.key_points import KeyPoints
from .drawing import size_of, small_text
from .pictures import colour
from .trails import both_views, framed, limits_of

COLOURS = ((80, 80, 240), (230, 150, 40), (90, 200, 90), (40, 190, 250), (220, 110, 200), (200, 200, 60))  # BGR, in turns


def paths_over_footage(grey: np.ndarray, names: tuple[str, ...], xy_px: np.ndarray, last: int) -> np.ndarray:
    """The paths (T, N, 2) of points in one view up to frame index `last`, over its image (h, w) of that frame, with crosses and names."""
    picture = colour(grey)
    k = size_of(picture)
    for n, name in enumerate(names):
        tint, path = COLOURS[n % len(COLOURS)], xy_px[: last + 1, n]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], np.isfinite(path).all(axis=1), [0]])))
        runs = [np.rint(path[a:b] * 8).astype(np.int32) for a, b in zip(edges[::2], edges[1::2])]
        cv2.polylines(picture, runs, False, tint, max(1, round(k)), cv2.LINE_AA, 3)
        if np.isfinite(path[-1]).all():
            x, y = np.rint(path[-1]).astype(int).tolist()
            cv2.drawMarker(picture, (x, y), tint, cv2.MARKER_CROSS, round(11 * k), max(1, round(k)), cv2.LINE_AA)
            small_text(picture, _plain(name), (x + round(7 * k), y - round(5 * k)), tint)
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
            last = place[np.flatnonzero(seen[:, n])[-1], n][axes] - middle[axes]
            x, y = np.rint(picture.shape[0] / 2 * (1 + last * [sign, 1] / half)).astype(int).tolist()
            small_text(picture, _plain(names[n]), (x + 4, y - 4), COLOURS[n % len(COLOURS)], size=1.0)
    return framed(pair, half)


def _plain(name: str) -> str:
    """OpenCV's letters are ASCII."""
    return name.encode("ascii", "replace").decode()
