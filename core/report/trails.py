"""Trajectories before and after the filters, from the front and from the side (D'Apuzzo & Plänkers 2000, Figs. 11–13): all that were
tracked, what was removed, by reason, and what was kept."""

from pathlib import Path

import cv2
import numpy as np

from ..foundation import store
from ..geometry.camera import Camera
from ..tracking.settings import TrackStatus
from .drawing import add_axes, add_scale

SIDE_PX = 360
MOST_PLACES = 60_000  # in one picture; of more, every n-th trajectory
GROUND = (28, 28, 28)
ALL_COLOUR, KEPT_COLOUR = (190, 190, 190), (120, 200, 90)  # BGR
REASONS = {  # BGR by reason; the others are grey
    TrackStatus.NOT_FOUND: (60, 160, 250),
    TrackStatus.NOT_MATCHED: (60, 160, 250),
    TrackStatus.NOT_VERIFIED: (40, 220, 240),
    TrackStatus.RAYS_MISS: (40, 220, 240),
    TrackStatus.TOO_FAST: (70, 70, 240),
    TrackStatus.ACCELERATES: (70, 70, 240),
    TrackStatus.NOT_UNIFORM: (230, 110, 200),
    TrackStatus.NOT_RIGID: (230, 110, 200),
    TrackStatus.UNSUPPORTED: (230, 110, 200),
    TrackStatus.UNCERTAIN: (230, 160, 70),
}
COLOUR_WORDS = (
    "red too fast or accelerating, violet unlike its neighbours, blue uncertain, yellow not verified, orange not found, grey others"
)


def trail_pictures(path: Path, camera: Camera) -> list[tuple[str, np.ndarray]]:
    """Captions and pictures from a trajectories_raw.npz: all, removed, kept; none where the file is missing or empty."""
    if not path.is_file():
        return []
    arrays = store.load(path)[0]
    xyz, status = arrays["xyz_m"].astype(np.float64), arrays["status"]
    seen = np.isfinite(xyz).all(axis=2)
    columns = np.flatnonzero(seen.any(axis=0))
    if not len(columns):
        return []
    every = max(1, -(-int(seen.sum()) // MOST_PLACES))
    columns = columns[::every]
    xyz, status, seen = xyz[:, columns], status[:, columns], seen[:, columns]
    place = camera.to_camera(xyz.reshape(-1, 3)).reshape(xyz.shape)
    kept = seen & (status == TrackStatus.MEASURED)
    limits = limits_of(place[seen])
    removed = seen & ~kept
    reason = np.where(removed, status, 0)
    colours = np.full((*status.shape, 3), (150, 150, 150), dtype=np.int64)
    for value, colour in REASONS.items():
        colours[reason == value] = colour
    grey, green = (np.broadcast_to(np.array(c), colours.shape) for c in (ALL_COLOUR, KEPT_COLOUR))
    some = f", one trajectory in {every}" if every > 1 else ""
    both = f"from the front and from the right side{some}"
    return [
        (f"All {int(seen.sum()):,} tracked positions before the filters, {both}", both_views(place, seen, grey, limits)),
        (f"The {int(removed.sum()):,} removed positions{some}: {COLOUR_WORDS}", both_views(place, removed, colours, limits)),
        (f"The {int(kept.sum()):,} positions that were kept, {both}", both_views(place, kept, green, limits)),
    ]


def limits_of(points: np.ndarray) -> tuple[np.ndarray, float]:
    """The middle of points (N, 3) and half the side [m] of a square that contains nearly all of them in both views."""
    low, high = np.percentile(points, [0.3, 99.7], axis=0)
    return 0.5 * (low + high), max(0.55 * float((high - low).max()), 0.01)


def both_views(place: np.ndarray, shown: np.ndarray, colours: np.ndarray, limits: tuple[np.ndarray, float]) -> np.ndarray:
    """Both views of places (T, N, 3) in the camera's axes, of those that are `shown` (T, N), with a scale."""
    middle, half = limits
    pair = []
    for axes, signs, names in (((0, 1), (1, 1), ("x", "y")), ((2, 1), (-1, 1), ("z", "y"))):
        xy = SIDE_PX / 2 * (1 + (place[..., axes] - middle[list(axes)]) * signs / half)
        pair.append(_trails(xy, shown, colours, half, names))
    return np.hstack(pair)


def _trails(xy: np.ndarray, shown: np.ndarray, colours: np.ndarray, half_m: float, names: tuple[str, str]) -> np.ndarray:
    """The steps to the shown places as lines, with a scale and the axes."""
    picture = np.full((SIDE_PX, SIDE_PX, 3), GROUND, np.uint8)
    pixel = np.clip(np.nan_to_num(xy), -9 * SIDE_PX, 9 * SIDE_PX)
    step = shown[1:] & np.isfinite(xy[:-1]).all(axis=2)
    lines, colour = np.rint(8 * np.stack([pixel[:-1][step], pixel[1:][step]], axis=1)).astype(np.int32), colours[1:][step]
    for one in np.unique(colour, axis=0):
        cv2.polylines(picture, list(lines[(colour == one).all(axis=1)]), False, one.tolist(), 1, cv2.LINE_AA, 3)
    add_scale(picture, SIDE_PX / 2 / half_m)
    add_axes(picture, names, left=names[0] == "z")
    return picture
