"""Trajectories before and after the filters, from the reference camera and from its side (D'Apuzzo & Plänkers 2000, Figs. 11–13): all
that were tracked, what was removed, by reason, and what was kept."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from ..foundation import store
from ..geometry.camera import Camera
from ..tracking.reasons import COLOUR_WORDS, MEANINGS, OTHERS, REASON_COLOURS
from ..tracking.settings import TrackStatus
from ..tracking.trajectories import Trajectories
from .drawing import FRONT, GROUND, OF_PANELS, SIDE, value_colours, with_legend, with_strip, with_title

SIDE_PX = 360
MOST_ARROWS = 700  # in one picture; of more, every n-th point
ARROW = 0.12  # length of the longest arrows, by half the picture; of the few beyond them at most …
MOST_LONG = 2.0  # … this many times as long
MOST_PLACES = 60_000  # in one picture; of more, every n-th trajectory
VECTORS = {"velocity": ("velocities", "m/s"), "acceleration": ("accelerations", "m/s²")}  # and their units
ALL_COLOUR, KEPT_COLOUR = (190, 190, 190), (120, 200, 90)  # BGR


def trail_pictures(path: Path, camera: Camera) -> list[tuple[str, np.ndarray]]:
    """Captions and pictures from a trajectories_raw.npz: all, removed, kept; none where the file is missing, empty, or of one frame."""
    if not path.is_file():
        return []
    arrays = store.load(path)[0]
    xyz, status = arrays["xyz_m"].astype(np.float64), arrays["status"]
    seen = np.isfinite(xyz).all(axis=2)
    columns = np.flatnonzero(seen.any(axis=0))
    if not len(columns) or len(xyz) < 2:
        return []
    every = max(1, -(-int(seen.sum()) // MOST_PLACES))
    columns = columns[::every]
    xyz, status, seen = xyz[:, columns], status[:, columns], seen[:, columns]
    place = camera.to_camera(xyz.reshape(-1, 3)).reshape(xyz.shape)
    kept = seen & (status == TrackStatus.MEASURED)
    limits = limits_of(place[seen])
    removed = seen & ~kept
    reason = np.where(removed, status, 0)
    colours = np.full((*status.shape, 3), OTHERS, dtype=np.int64)
    for value, colour in REASON_COLOURS.items():
        colours[reason == value] = colour
    grey, green = (np.broadcast_to(np.array(c), colours.shape) for c in (ALL_COLOUR, KEPT_COLOUR))
    some = f", one trajectory in {every}" if every > 1 else ""
    both = f"{FRONT} and {SIDE}{some}"
    wanted = (
        (f"All {int(seen.sum()):,} tracked positions before the filters, {both}", seen, grey, [(ALL_COLOUR, "tracked")]),
        (f"The {int(removed.sum()):,} removed positions{some}: {COLOUR_WORDS}", removed, colours, MEANINGS),
        (f"The {int(kept.sum()):,} positions that were kept, {both}", kept, green, [(KEPT_COLOUR, "kept")]),
    )
    return [
        (words, with_legend(framed(both_views(place, shown, tints, limits), limits[1]), meanings, OF_PANELS))
        for words, shown, tints, meanings in wanted
    ]


def longest_vectors(trajectories: Trajectories, index: int) -> dict[str, float]:
    """The size of the longest arrows in one frame, by the name in `VECTORS`: nearly no point exceeds it. Without those that have none."""
    found = dict[str, float]()
    for name, (_, _, vectors) in _vectors(trajectories, index).items():
        size = np.linalg.norm(vectors, axis=1)
        size = size[np.isfinite(size)]
        if len(size):
            found[name] = max(float(np.percentile(size, 95)), 1e-6)
    return found


def vector_pictures(
    trajectories: Trajectories, camera: Camera, index: int, longest: Mapping[str, float]
) -> dict[str, tuple[str, np.ndarray]]:
    """Captions and pictures of the velocities and of the accelerations in one frame, as arrows from the reference camera and from its side
    (D'Apuzzo et al. 1999, Fig. 9), by the name in `VECTORS`; of those that are in `longest`, the size of the longest and red arrows."""
    found, place = dict[str, tuple[str, np.ndarray]](), camera.to_camera(trajectories.xyz_m[index].astype(np.float64))
    for key, (name, unit, vectors) in _vectors(trajectories, index).items():
        own = vectors @ camera.R_cam_world.T
        rows = np.flatnonzero(np.isfinite(place).all(axis=1) & np.isfinite(own).all(axis=1))
        if key not in longest or not len(rows):
            continue
        every, high = max(1, -(-len(rows) // MOST_ARROWS)), longest[key]
        rows = rows[::every]
        size, limits = np.linalg.norm(own[rows], axis=1), limits_of(place[rows])
        arrows = own[rows] * (ARROW * limits[1] / high * np.minimum(1.0, MOST_LONG * high / np.maximum(size, 1e-12)))[:, None]
        pair = [_arrows(place[rows], arrows, size / high, limits, axes) for axes in ("xy", "zy")]
        some = f", one point in {every}" if every > 1 else ""
        words = f"Frame {trajectories.frames[index]}: {name} of {len(rows):,} tracked points, {FRONT} and {SIDE}{some}"
        shown = framed(pair, limits[1], (high, f"{name}, {unit.replace('²', '^2')}"))
        found[key] = (f"{words}; red and longest: {high:.2g} {unit} or more", shown)
    return found


def _vectors(trajectories: Trajectories, index: int) -> dict[str, tuple[str, str, np.ndarray]]:
    """Name, unit and vectors (N, 3) in one frame."""
    both = trajectories.velocity_m_s, trajectories.acceleration_m_s2
    return {key: (*words, vectors[index].astype(np.float64)) for (key, words), vectors in zip(VECTORS.items(), both)}


def _arrows(place: np.ndarray, arrows: np.ndarray, share: np.ndarray, limits: tuple[np.ndarray, float], axes: str) -> np.ndarray:
    """Arrows (N, 3) at places (N, 3), coloured by their share (N,) of the longest."""
    picture, (middle, half) = np.full((SIDE_PX, SIDE_PX, 3), GROUND, np.uint8), limits
    rows, signs = (0, 1) if axes == "xy" else (2, 1), np.array([1.0 if axes == "xy" else -1.0, 1.0])
    start, end = (SIDE_PX / 2 * (1 + (p[:, rows] - middle[list(rows)]) * signs / half) for p in (place, place + arrows))
    tints = value_colours(share, 0.0, 1.0)
    ends = np.clip(np.rint(8 * np.stack([start, end], axis=1)), -(2**20), 2**20).astype(int)
    for (a, b), tint in zip(ends.tolist(), tints.tolist()):
        cv2.arrowedLine(picture, a, b, tint, 1, cv2.LINE_AA, 3, 0.3)
    return picture


def limits_of(points: np.ndarray) -> tuple[np.ndarray, float]:
    """The middle of points (N, 3) and half the side [m] of a square that contains nearly all of them in both views."""
    low, high = np.percentile(points, [0.3, 99.7], axis=0)
    return 0.5 * (low + high), max(0.55 * float((high - low).max()), 0.01)


def both_views(place: np.ndarray, shown: np.ndarray, colours: np.ndarray, limits: tuple[np.ndarray, float]) -> list[np.ndarray]:
    """Both views of places (T, N, 3) in the camera's axes, of those that are `shown` (T, N)."""
    middle, half = limits
    pair = []
    for axes, signs in (((0, 1), (1, 1)), ((2, 1), (-1, 1))):
        xy = SIDE_PX / 2 * (1 + (place[..., axes] - middle[list(axes)]) * signs / half)
        pair.append(_trails(xy, shown, colours))
    return pair


def framed(pair: Sequence[np.ndarray], half_m: float, bar: tuple[float, str] | None = None) -> np.ndarray:
    """Both views beside each other with their names, scales and axes; the first with the bar of colours instead of the scale, which is the
    same in both."""
    px_per_m, panels, k = pair[0].shape[0] / 2 / half_m, [], OF_PANELS
    for picture, words, axes, own in zip(pair, (FRONT, SIDE), (("x", "y"), ("z", "y")), (bar, None)):
        scale = px_per_m if own is None else float("nan")
        panels.append(with_title(with_strip(picture, scale, axes, left=axes[0] == "z", bar=own, size=k), words, k))
    return np.hstack(panels)


def _trails(xy: np.ndarray, shown: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """The steps to the shown places as lines."""
    picture = np.full((SIDE_PX, SIDE_PX, 3), GROUND, np.uint8)
    pixel = np.clip(np.nan_to_num(xy), -9 * SIDE_PX, 9 * SIDE_PX)
    step = shown[1:] & np.isfinite(xy[:-1]).all(axis=2)
    lines, colour = np.rint(8 * np.stack([pixel[:-1][step], pixel[1:][step]], axis=1)).astype(np.int32), colours[1:][step]
    for one in np.unique(colour, axis=0):
        cv2.polylines(picture, list(lines[(colour == one).all(axis=1)]), False, one.tolist(), 1, cv2.LINE_AA, 3)
    return picture
