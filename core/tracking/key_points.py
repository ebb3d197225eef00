"""Key points: points that a user chose, followed as single trajectories in the images and in space.

Unlike the surface's points they have no neighbours and no measured surface that would speak for them: only what the views say to each other
counts, temporal against spatial matching and the rays' residuals (step.py). A point that is lost ends.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..geometry.intersection import forward_intersection
from ..images.sampling import SplineImage
from ..progress import Monitor
from .search import search_box
from .settings import TrackStatus
from .step import FramePair, TrackingView, intersect, match_spatially, track_step
from .templates import cut_tiles, no_templates
from .tracked import TrackedFrame, born

CLICK_SIGMA_PX, CLICK_REACH_PX = 2.0, 6.0
LARGEST_MISFIT_PX, MISFITS = 4.0, 2.5  # rays of the first frame may miss by so much; later by so many of its medians


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class KeyPoints:
    """N points over T frames: full-frame pixels in every view, and the world. NaN where a point is not seen."""

    frames: np.ndarray  # (T,)
    xy_px: np.ndarray  # (T, N, K, 2)
    xyz_m: np.ndarray  # (T, N, 3)
    sigma_m: np.ndarray  # (T, N)
    status: np.ndarray  # (T, N) TrackStatus


def track_key_points(
    read: Callable[[int], Sequence[np.ndarray]], frames: range, points: Mapping[str, Mapping[str, np.ndarray]], view: TrackingView,
    monitor: Monitor,
) -> KeyPoints:  # fmt: skip
    """Follow points, clicked in the first of `frames` in two views or more (name → view → full-frame pixel), through the others.

    `read(frame)` gives the rows (h', w) of all views. In the reference view a point stays where it was clicked, or where its other clicks
    meet; in the other views matching finds it.

    Raises:
        InputError: a point is clicked in fewer than two views.
    """
    steps = list(_follow(read, frames, _clicked(points, view), view, monitor))
    T, N, K = len(steps), len(points), len(view.cameras)
    xy, xyz, sigma = np.full((T, N, K, 2), np.nan), np.full((T, N, 3), np.nan), np.full((T, N), np.nan)
    status = np.zeros((T, N), dtype=np.int8)
    for t, s in enumerate(steps):
        xy[t, s.identity], xyz[t, s.identity] = view.rows.to_frame(s.xy), s.xyz_m
        sigma[t, s.identity] = np.sqrt(np.trace(s.covariance_m2, axis1=1, axis2=2))
        status[t, s.identity], status[t, s.ended] = TrackStatus.MEASURED, s.reason
    return KeyPoints(frames=np.array(frames), xy_px=xy, xyz_m=xyz, sigma_m=sigma, status=status)


def _clicked(points: Mapping[str, Mapping[str, np.ndarray]], view: TrackingView) -> np.ndarray:
    """Clicks (N, K, 2) in rows' pixels; where a view has none, the projection of the point that the others give."""
    xy = np.array([[at.get(c.name, (np.nan, np.nan)) for c in view.cameras] for at in points.values()], dtype=np.float64)
    xy = xy.reshape(-1, len(view.cameras), 2)
    point = forward_intersection(view.cameras, xy, np.tile(np.eye(2) * CLICK_SIGMA_PX**2, (*xy.shape[:2], 1, 1)))
    for name, X in zip(points, point.xyz_m):
        if not np.isfinite(X).all():
            raise InputError(f"The key point “{name}” has no place in space; click it in two views at least.")
    for k, camera in enumerate(view.cameras):
        missing = np.isnan(xy[:, k, 0])
        xy[missing, k] = camera.project(point.xyz_m[missing])
    return view.rows.from_frame(xy)


def _follow(
    read: Callable[[int], Sequence[np.ndarray]], frames: range, clicks: np.ndarray, view: TrackingView, monitor: Monitor
) -> Iterator[TrackedFrame]:
    grey = list(read(frames[0]))
    spline = [SplineImage(g) for g in grey]
    current, before = _first(grey, spline, clicks, frames[0], replace(view, limit_px=max(view.limit_px, LARGEST_MISFIT_PX))), None
    miss = _misfit_px(current, view)
    view = replace(view, limit_px=max(view.limit_px, MISFITS * float(np.median(miss)) if len(miss) else 0.0))
    current = current.without(miss > view.limit_px, TrackStatus.RAYS_MISS)
    ref = view.reference
    how = view.matching, view.rows.step
    templates = no_templates(*how).with_tiles(cut_tiles(spline[ref], current.identity, current.xy[:, ref], *how), *how)
    yield current
    for i, frame in enumerate(frames[1:]):
        monitor.step("tracks", i, len(frames) - 1)
        next_grey = list(read(frame))
        next_spline = [SplineImage(g) for g in next_grey]
        pair = FramePair(grey=grey, spline=spline, next_grey=next_grey, next_spline=next_spline)
        tracked = track_step(view, before, current, templates, pair, frame, monitor)
        fresh = (tracked.key_shape == np.eye(2)).all(axis=(1, 2))
        new = cut_tiles(next_spline[ref], tracked.identity[fresh], tracked.xy[fresh, ref], *how)
        templates, before, current = templates.only(tracked.identity).with_tiles(new, *how), current, tracked
        grey, spline = next_grey, next_spline
        yield tracked


def _misfit_px(points: TrackedFrame, view: TrackingView) -> np.ndarray:
    """(N,) by how much the rays miss: what the rig and the synchronization are worth, too."""
    away = [view.rows.to_frame(points.xy[:, k]) - camera.project(points.xyz_m) for k, camera in enumerate(view.cameras)]
    return np.sqrt(np.nanmean(np.sum(np.square(away), axis=2), axis=0))


def _first(
    grey: Sequence[np.ndarray], spline: Sequence[SplineImage], clicks: np.ndarray, frame: int, view: TrackingView
) -> TrackedFrame:
    """The points in the frame of the clicks: matched from the reference view in the others, as far as clicks are wrong."""
    n, K = clicks.shape[:2]
    eye = np.tile(np.eye(2), (n, K, 1, 1))
    box, at = np.full(n, CLICK_REACH_PX), list(np.moveaxis(clicks, 1, 0))
    for k in view.others:
        at[k], _ = search_box(grey[view.reference], grey[k], clicks[:, view.reference], clicks[:, k], box, view.matching.patch_px,
                              view.rows.step)  # fmt: skip
    start = born(frame, np.arange(n), clicks, eye, np.zeros((n, 3)), np.zeros((n, 3, 3)))
    status = np.full((n, K), TrackStatus.MEASURED, dtype=np.int8)
    spatial = match_spatially(view, start, at, spline, status)
    xy, covariance, shape = clicks.copy(), np.tile(np.eye(2) * 1e-4, (n, K, 1, 1)), eye.copy()
    for k, s in zip(view.others, spatial):
        xy[:, k], covariance[:, k], shape[:, k] = s.xy, s.covariance, s.shape
    points, verdict = intersect(view, start, xy, covariance, shape, status)
    return points.without(verdict != TrackStatus.MEASURED, verdict)


def distances(points: KeyPoints, a: int, b: int) -> np.ndarray:
    """Distance (T,) of two key points in every frame."""
    return np.linalg.norm(points.xyz_m[:, a] - points.xyz_m[:, b], axis=1)
