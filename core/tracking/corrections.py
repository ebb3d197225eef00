"""What a user takes out of a recording by hand: trajectories that were clicked, and what lies inside a polygon drawn over a view.

Pure functions of positions; which corrections a take has stands in take.toml, and measured frames and tracks stay valid under them.
"""

from dataclasses import replace

import numpy as np

from ..geometry.camera import Camera
from .settings import TrackStatus
from .trajectories import Filtered, Trajectories, picked

CLICK_REACH_PX = 5.0


def inside_polygon(xy: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Which points (N, 2) lie inside a polygon (V, 2), by the even–odd rule; NaN lies outside."""
    a, b = polygon[None], np.roll(polygon, -1, axis=0)[None]
    x, y = xy[:, None, 0], xy[:, None, 1]
    crosses = (a[..., 1] > y) != (b[..., 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[..., 0] + (y - a[..., 1]) * (b[..., 0] - a[..., 0]) / (b[..., 1] - a[..., 1])
        return ((crosses & (x < at)).sum(axis=1) % 2 == 1) & np.isfinite(xy).all(axis=1)


def in_region(raw: Trajectories, camera: Camera, polygon: np.ndarray, frames: range) -> np.ndarray:
    """(T, N) which positions the camera sees inside a polygon (full-frame pixels) in these frames."""
    inside = np.zeros(raw.seen.shape, dtype=bool)
    for t in np.flatnonzero(np.isin(raw.frames, frames)):
        inside[t] = inside_polygon(camera.project(raw.xyz_m[t]), polygon)
    return inside


def clicked(filtered: Filtered, camera: Camera, xy: np.ndarray, frame: int) -> int | None:
    """The column of the raw trajectory that the camera sees nearest to a pixel (2,) in a frame; None where none is near.

    One that the filters kept is meant before one that they removed.
    """
    t = np.flatnonzero(filtered.raw.frames == frame)
    for candidates in (filtered.kept.xyz_m, filtered.raw.xyz_m) if len(t) else ():
        rows = np.flatnonzero(np.isfinite(candidates[t[0], :, 0]))
        away = np.linalg.norm(camera.project(candidates[t[0], rows]) - xy, axis=1)
        if len(rows) and away.min() <= CLICK_REACH_PX:
            at = rows[int(away.argmin())]
            return int(filtered.source[at]) if candidates is filtered.kept.xyz_m else int(at)
    return None


def without(filtered: Filtered, source: int) -> Filtered:
    """The trajectories without that of a raw column, all of its pieces."""
    verdict = filtered.raw.status.copy()
    verdict[filtered.raw.seen[:, source], source] = TrackStatus.REMOVED_BY_USER
    left = filtered.source != source
    return Filtered(kept=picked(filtered.kept, left), source=filtered.source[left], raw=replace(filtered.raw, status=verdict))
