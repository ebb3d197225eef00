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
from ..matching.least_squares import match_patches, patch_offsets
from ..progress import Monitor
from .search import search_box
from .settings import TrackStatus
from .step import MODEL_SIGMA_PX, FramePair, TrackingView, intersect, track_step
from .templates import Tiles, atlas, cut_tiles, no_templates
from .tracked import TrackedFrame, born

CLICK_SIGMA_PX, CLICK_REACH_PX = 2.0, 6.0
SLOPES = ((0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7))  # of the surface about a point: up to 35° either way
LARGEST_MISFIT_PX, MISFITS = 4.0, 2.5  # rays may miss by so much, and by so many of their median in the frame


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
    steps = list(_follow(read, frames, _clicked(points, view.at(frames[0])), view, monitor))
    T, N, K = len(steps), len(points), len(view.cameras)
    xy, xyz, sigma = np.full((T, N, K, 2), np.nan), np.full((T, N, 3), np.nan), np.full((T, N), np.nan)
    status = np.zeros((T, N), dtype=np.int8)
    for t, s in enumerate(steps):
        xy[t, s.identity], xyz[t, s.identity] = view.instants.rows(s.frame).to_frame(s.xy), s.xyz_m
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
    view = view.at(frames[0])
    loose = replace(view, limit_px=max(view.limit_px, LARGEST_MISFIT_PX))
    current, before = _meeting(_first(grey, spline, clicks, frames[0], loose), view), None
    ref = view.reference
    how = view.matching, view.rows.step
    templates = no_templates(*how).with_tiles(cut_tiles(spline[ref], current.identity, current.xy[:, ref], *how), *how)
    yield current
    for i, frame in enumerate(frames[1:]):
        monitor.step("tracks", i, len(frames) - 1)
        next_grey = list(read(frame))
        next_spline = [SplineImage(g) for g in next_grey]
        pair = FramePair(grey=grey, spline=spline, next_grey=next_grey, next_spline=next_spline)
        tracked = _meeting(track_step(loose, before, current, templates, pair, frame, monitor), view.at(frame))
        fresh = (tracked.key_shape == np.eye(2)).all(axis=(1, 2))
        new = cut_tiles(next_spline[ref], tracked.identity[fresh], tracked.xy[fresh, ref], *how)
        templates, before, current = templates.only(tracked.identity).with_tiles(new, *how), current, tracked
        grey, spline = next_grey, next_spline
        yield tracked


def _meeting(points: TrackedFrame, view: TrackingView) -> TrackedFrame:
    """The points whose rays miss each other no more than is usual in this frame; what is usual there goes into the sigmas.

    The rig and the synchronization have their share in it: a frame's points can all miss by the same.
    """
    away = [view.rows.to_frame(points.xy[:, k]) - camera.project(points.xyz_m) for k, camera in enumerate(view.cameras)]
    miss = np.sqrt(np.nanmean(np.sum(np.square(away), axis=2), axis=0))
    usual = float(np.median(miss)) if len(miss) else 0.0
    excess = np.eye(2) * max(0.0, usual**2 - MODEL_SIGMA_PX**2)
    xy = view.rows.to_frame(points.xy)
    common = forward_intersection(view.cameras, xy, np.tile(excess + np.eye(2) * 1e-6, (*xy.shape[:2], 1, 1))).covariance_m2
    met = replace(points, covariance_m2=points.covariance_m2 + common)
    return met.without(miss > max(view.limit_px, MISFITS * usual), TrackStatus.RAYS_MISS)


def _first(
    grey: Sequence[np.ndarray], spline: Sequence[SplineImage], clicks: np.ndarray, frame: int, view: TrackingView
) -> TrackedFrame:
    """The points in the frame of the clicks: matched from the reference view in the others, as far as clicks are wrong.

    Nothing is known of the surface's slope, so several are tried; the one with the best correlation counts.
    """
    n, K = clicks.shape[:2]
    xy, covariance, shape = clicks.copy(), np.tile(np.eye(2) * 1e-4, (n, K, 1, 1)), np.tile(np.eye(2), (n, K, 1, 1))
    status = np.full((n, K), TrackStatus.NOT_FOUND, dtype=np.int8)
    status[:, view.reference] = TrackStatus.MEASURED
    best = np.zeros((n, K))
    for slope in SLOPES:
        induced = _induced_shapes(clicks, np.array(slope), view)
        for k in view.others:
            start = _searched(spline[view.reference], grey[k], clicks[:, view.reference], clicks[:, k], induced[:, k], view)
            m = match_patches(spline[view.reference], clicks[:, view.reference], [spline[k]], [start], [induced[:, k]], view.matching,
                              row_step=view.rows.step)[0]  # fmt: skip
            better = m.ok & (m.correlation > best[:, k])
            xy[better, k], covariance[better, k], shape[better, k] = m.xy[better], m.covariance[better], m.shape[better]
            best[better, k], status[better, k] = m.correlation[better], TrackStatus.MEASURED
    chosen = born(frame, np.arange(n), clicks, shape, np.zeros((n, 3)), np.zeros((n, 3, 3)))
    points, verdict = intersect(view, chosen, xy, covariance, shape, status)
    return points.without(verdict != TrackStatus.MEASURED, verdict)


def _induced_shapes(clicks: np.ndarray, slope: np.ndarray, view: TrackingView) -> np.ndarray:
    """Shapes (N, K, 2, 2) from the reference view to each view, of planes through the clicked points.

    Their depth, relative to the point's, grows by `slope` (2,) per width that equals the depth; (0, 0) faces the reference camera.
    """
    base, to_frame = view.cameras[view.reference], view.rows.to_frame
    point = forward_intersection(view.cameras, to_frame(clicks), np.tile(np.eye(2) * CLICK_SIGMA_PX**2, (*clicks.shape[:2], 1, 1)))
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    depth = base.to_camera(point.xyz_m)[:, 2, None] * (1 + (corners * (1, view.rows.step)) @ slope / base.focal_px)
    X = base.points_at_depth(to_frame(clicks[:, view.reference, None] + corners), depth)  # (N, 3, 3)
    image = np.stack([view.rows.from_frame(camera.project(X)) for camera in view.cameras], axis=1)  # (N, K, 3, 2)
    return np.stack([image[:, :, 1] - image[:, :, 0], image[:, :, 2] - image[:, :, 0]], axis=-1)


def _searched(
    reference: SplineImage, grey: np.ndarray, xy: np.ndarray, clicks: np.ndarray, shape: np.ndarray, view: TrackingView
) -> np.ndarray:
    """Where (N, 2) about the clicks the reference's patches, drawn in these shapes, correlate best."""
    u, v, (w, h) = patch_offsets(view.matching.patch_px, view.rows.step)
    usable = np.abs(np.linalg.det(shape)) > 0.05
    inverse = np.linalg.inv(np.where(usable[:, None, None], shape, np.eye(2)))
    tile = reference.sample_patches(xy, inverse, np.stack([np.ones_like(u), u, v])).reshape(-1, 2 * h + 1, 2 * w + 1)
    drawn, at = atlas(Tiles(identity=np.arange(len(xy)), tile=tile, offset=np.zeros((len(xy), 2))))
    start, _ = search_box(drawn, grey, at, clicks, np.full(len(xy), CLICK_REACH_PX), view.matching.patch_px, view.rows.step)
    return np.where(usable[:, None], start, np.nan)


def distances(points: KeyPoints, a: int, b: int) -> np.ndarray:
    """Distance (T,) of two key points in every frame."""
    return np.linalg.norm(points.xyz_m[:, a] - points.xyz_m[:, b], axis=1)
