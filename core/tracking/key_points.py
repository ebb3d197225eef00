"""Key points: points that the user chose, tracked as single trajectories in the images and in space.

Unlike the surface's points they have no neighbours and no measured surface to confirm them. They are verified by the views alone: temporal
against spatial matching, and the residuals of the rays (step.py). Up to `tracking.bridge_frames` frames in which no point is found are left
out. For a point that is lost alone, its key template is searched for where its own motion predicts it, and from there the point is matched
in the other views.

A round marker looks the same in every orientation, so only its centre can be matched: a click on a marker means its centre.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..calibration.targets import TargetStatus, find_targets
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.intersection import clicks_contradict, forward_intersection, intersect_clicks
from ..images.sampling import SplineImage
from ..matching.least_squares import SearchImage, TemplatePoints, match_patches
from ..matching.patches import patch_offsets
from .published_step import STEPS
from .settings import KeyPointSettings, TrackStatus
from .step import MODEL_SIGMA_PX, FramePair, TrackingView, intersect, measured_at
from .templates import REACQUIRE_CORRELATION, Templates, Tiles, atlas, cut_tiles, no_templates, search_box
from .tracked import TrackedFrame, born, joined, nothing, rows_of

DEFAULT_SETTINGS = KeyPointSettings()
CLICK_REACH_PX = 6.0  # a click may be wrong by as much
SLOPES = ((0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7))  # tried for the surface at a point: up to 35° each way
MAX_MISFIT_PX = 4.0  # of a point's rays
MAX_MISFIT_MEDIANS = 2.5  # the same, in units of the median of the frame's points
MIN_DETERMINANT = 0.05  # of a shape; a flatter one has no usable inverse
FIXED_SIGMA_PX = 0.01  # of a click in the reference view, which defines the point
REACQUIRE_BOX = 2.0  # of a lost point, in units of `tracking.box_px`


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class KeyPoints:
    """N points over T frames: full-frame pixels in every view, and world positions. NaN where a point is not visible."""

    frames: np.ndarray  # (T,)
    xy_px: np.ndarray  # (T, N, K, 2)
    xyz_m: np.ndarray  # (T, N, 3)
    sigma_m: np.ndarray  # (T, N)
    status: np.ndarray  # (T, N) TrackStatus


def track_key_points(
    read: Callable[[int], Sequence[np.ndarray]],
    frames: range,
    points: Mapping[str, Mapping[str, np.ndarray]],
    view: TrackingView,
    monitor: Monitor,
    settings: KeyPointSettings = DEFAULT_SETTINGS,
) -> KeyPoints:
    """Track points, clicked in the first of `frames` in two views or more (name → view → full-frame pixel), through the others.

    `read(frame)` gives the rows (h', w) of all views. In the reference view the click defines the point, or the projection of its other
    clicks; in the other views the point is matched.

    Raises:
        InputError: a point is clicked in fewer than two views, or a marker is missing at a click.
    """
    clicks = _clicked(points, view.at(frames[0]))
    if settings.markers:
        clicks = _on_markers(read(frames[0]), clicks, tuple(points), view)
    steps = list(_follow(read, frames, clicks, view, monitor))
    T, N, K = len(steps), len(points), len(view.cameras)
    xy, xyz, sigma = np.full((T, N, K, 2), np.nan), np.full((T, N, 3), np.nan), np.full((T, N), np.nan)
    status = np.zeros((T, N), dtype=np.int8)
    for t, s in enumerate(steps):
        xy[t, s.identity], xyz[t, s.identity] = view.field_layout.rows(s.frame).to_frame(s.xy), s.xyz_m
        sigma[t, s.identity] = np.sqrt(np.trace(s.covariance_m2, axis1=1, axis2=2))
        status[t, s.identity], status[t, s.ended] = TrackStatus.MEASURED, s.reason
    return KeyPoints(frames=np.array(frames), xy_px=xy, xyz_m=xyz, sigma_m=sigma, status=status)


def _clicked(points: Mapping[str, Mapping[str, np.ndarray]], view: TrackingView) -> np.ndarray:
    """Clicks (N, K, 2) in rows' pixels; in a view without one, the projection of the point from its other clicks."""
    xy = np.array([[at.get(c.name, (np.nan, np.nan)) for c in view.cameras] for at in points.values()], dtype=np.float64)
    xy = xy.reshape(-1, len(view.cameras), 2)
    point = intersect_clicks(view.cameras, xy)
    for name, at, X, missed, miss in zip(points, points.values(), point.xyz_m, clicks_contradict(point), point.rms_residual_px):
        if not np.isfinite(X).all():
            what = "its clicks' rays do not meet; click it again" if len(at) > 1 else "click it in at least two views"
            raise InputError(f"The position of the key point “{name}” cannot be computed; {what}.")
        if missed:
            raise InputError(
                f"The clicks on the key point “{name}” contradict each other: their rays miss by {miss:.0f} px; click it again."
            )
    for k, camera in enumerate(view.cameras):
        missing = np.isnan(xy[:, k, 0])
        xy[missing, k] = camera.project(point.xyz_m[missing])
    return view.rows.from_frame(xy)


def _on_markers(grey: Sequence[np.ndarray], clicks: np.ndarray, names: tuple[str, ...], view: TrackingView) -> np.ndarray:
    """The clicks (N, K, 2) moved to the centres of the nearest bright round targets within reach.

    A click without a target stays in place, except in the reference view.

    Raises:
        InputError: there is no target near a click in the reference view.
    """
    centres = clicks.copy()
    for k, image in enumerate(grey):
        found = find_targets(np.asarray(image, dtype=np.float32))
        xy = found.xy_px[found.status == TargetStatus.OK]
        away = np.linalg.norm((clicks[:, None, k] - xy) * (1.0, view.rows.step), axis=2)
        for n, name in enumerate(names):
            if len(xy) and away[n].min() <= CLICK_REACH_PX:
                centres[n, k] = xy[away[n].argmin()]
            elif k == view.reference:
                where = f"“{name}” in view {view.cameras[k].name}"
                raise InputError(f"There is no bright round marker near the click on {where}; click its centre.")
    return centres


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Lost:
    """N lost points, each as it was in the last frame in which it was visible."""

    points: TrackedFrame
    velocity_m: np.ndarray  # (N, 3) per frame; zero where unknown
    last: np.ndarray  # (N,) that frame

    def after(self, current: TrackedFrame, before: TrackedFrame | None, tracked: TrackedFrame, wait_frames: int) -> "_Lost":
        """The points that are lost after `current` has become `tracked`: without those reacquired or lost for too long."""
        gone = np.isin(current.identity, tracked.ended[tracked.reason != TrackStatus.LEFT_IMAGE])
        points = joined(self.points, current.select(gone))
        velocity, last = np.zeros((len(points.identity), 3)), np.full(len(points.identity), current.frame)
        at = rows_of(self.points.identity, points.identity)
        velocity[at >= 0], last[at >= 0] = self.velocity_m[at[at >= 0]], self.last[at[at >= 0]]
        if before is not None:
            now, then = rows_of(current.identity, points.identity), rows_of(before.identity, points.identity)
            new = (at < 0) & (then >= 0)
            velocity[new] = (current.xyz_m[now[new]] - before.xyz_m[then[new]]) / abs(current.frame - before.frame)
        keep = ~np.isin(points.identity, tracked.identity) & (abs(tracked.frame - last) < wait_frames)
        return _Lost(points=points.select(keep), velocity_m=velocity[keep], last=last[keep])

    def reacquired(
        self, view: TrackingView, templates: Templates, grey: Sequence[np.ndarray], spline: Sequence[SplineImage]
    ) -> TrackedFrame:
        """Those that are visible again in the frame of the view, near where their motion predicts them."""
        ahead = np.abs(view.frame - self.last)[:, None]
        p, ref = replace(self.points, xyz_m=self.points.xyz_m + ahead * self.velocity_m), view.reference
        if not len(p.identity):
            return p
        centre = view.projected(p.xyz_m)
        picture, tiles = atlas(templates.only(p.identity).tiles)
        box = np.full(len(p.identity), REACQUIRE_BOX * view.tracking.box_px)
        start, best = search_box(picture, grey[ref], tiles, centre[:, ref], box, view.matching.patch_px, view.rows.step)
        start = np.where((best >= view.tracking.min_correlation)[:, None], start, np.nan)
        key = templates.match(p.identity, spline[ref], start, p.key_shape)
        status = np.full(p.xy.shape[:2], TrackStatus.MEASURED, dtype=np.int8)
        min_correlation = max(REACQUIRE_CORRELATION, view.tracking.drift_correlation)
        status[~(key.ok & (key.correlation >= min_correlation)), ref] = TrackStatus.NOT_FOUND
        shift = np.nan_to_num(key.xy - centre[:, ref])
        at = [centre[:, k] + np.einsum("nij,nj->ni", p.shape[:, k], shift) for k in range(len(view.cameras))]
        at = [key.xy if k == ref else _search_warped(spline[ref], grey[k], key.xy, at[k], p.shape[:, k], view) for k in range(len(at))]
        found, verdict = measured_at(view, replace(p, key_shape=key.shape, drift=key.covariance), at, spline, status)
        return replace(found.select(verdict == TrackStatus.MEASURED), frame=view.frame)


def _follow(
    read: Callable[[int], Sequence[np.ndarray]], frames: range, clicks: np.ndarray, view: TrackingView, monitor: Monitor
) -> Iterator[TrackedFrame]:
    view = view.at(frames[0])
    grey, spline = _prepared(read(frames[0]))
    lenient = replace(view, limit_px=max(view.limit_px, MAX_MISFIT_PX))
    current, before = _intersecting(_first(grey, spline, clicks, frames[0], lenient), view), None
    ref = view.reference
    how = view.matching, view.rows.step
    templates = no_templates(*how).with_tiles(cut_tiles(spline[ref], current.identity, current.xy[:, ref], *how), *how)
    lost = _Lost(points=nothing(frames[0], len(view.cameras)), velocity_m=np.zeros((0, 3)), last=np.zeros(0, np.int64))
    yield current
    for i, frame in enumerate(frames[1:]):
        monitor.step("tracks", i, len(frames) - 1)
        next_grey, next_spline = _prepared(read(frame))
        pair = FramePair(grey=grey, spline=spline, next_grey=next_grey, next_spline=next_spline)
        tracked = STEPS[view.tracking.scheme](lenient, before, current, templates, pair, frame, monitor)
        reacquired = lost.reacquired(lenient.at(frame), templates, next_grey, next_spline)
        tracked = _intersecting(joined(tracked, reacquired), view.at(frame))
        yield tracked
        if len(current.identity) and not len(tracked.identity) and abs(frame - current.frame) <= view.tracking.bridge_frames:
            continue  # the frame is missing, and not the points
        lost = lost.after(current, before, tracked, view.tracking.wait_frames)
        renewed = tracked.renewed
        new = cut_tiles(next_spline[ref], tracked.identity[renewed], tracked.xy[renewed, ref], *how)
        templates = templates.only(np.concatenate([tracked.identity, lost.points.identity])).with_tiles(new, *how)
        before, current, grey, spline = current, tracked, next_grey, next_spline


def _prepared(images: Sequence[np.ndarray]) -> tuple[list[np.ndarray], list[SplineImage]]:
    return list(images), [SplineImage(g) for g in images]


def _intersecting(points: TrackedFrame, view: TrackingView) -> TrackedFrame:
    """The points whose rays miss each other by no more than is usual in this frame; the usual misfit enters the sigmas.

    Errors of the rig and of the synchronization are common to all points of a frame.
    """
    away = [view.rows.to_frame(points.xy[:, k]) - camera.project(points.xyz_m) for k, camera in enumerate(view.cameras)]
    miss = np.sqrt(np.nanmean(np.sum(np.square(away), axis=2), axis=0))
    usual = float(np.median(miss)) if len(miss) else 0.0
    excess = np.eye(2) * max(0.0, usual**2 - MODEL_SIGMA_PX**2)
    xy = view.rows.to_frame(points.xy)
    common = forward_intersection(view.cameras, xy, np.tile(excess + np.eye(2) * 1e-6, (*xy.shape[:2], 1, 1))).covariance_m2
    met = replace(points, covariance_m2=points.covariance_m2 + common)
    return met.without(miss > max(view.limit_px, MAX_MISFIT_MEDIANS * usual), TrackStatus.RAYS_MISS)


def _first(grey: Sequence[np.ndarray], spline: Sequence[SplineImage], clicks: np.ndarray, frame: int, view: TrackingView) -> TrackedFrame:
    """The points in the frame of the clicks: searched for around the clicks in the other views, and matched with the reference view.

    The surface's slope is unknown, so several are tried; the one with the best correlation counts.
    """
    n, K = clicks.shape[:2]
    xy, covariance, shape = clicks.copy(), np.tile(np.eye(2) * FIXED_SIGMA_PX**2, (n, K, 1, 1)), np.tile(np.eye(2), (n, K, 1, 1))
    status = np.full((n, K), TrackStatus.NOT_FOUND, dtype=np.int8)
    status[:, view.reference] = TrackStatus.MEASURED
    best = np.zeros((n, K))
    for slope in SLOPES:
        induced = _induced_shapes(clicks, np.array(slope), view)
        for k in view.others:
            start = _search_warped(spline[view.reference], grey[k], clicks[:, view.reference], clicks[:, k], induced[:, k], view)
            template = TemplatePoints(image=spline[view.reference], xy=clicks[:, view.reference], row_step=view.rows.step)
            m = match_patches(template, [SearchImage(image=spline[k], start=start, shape=induced[:, k])], view.matching)[0]
            better = m.ok & (m.correlation > best[:, k])
            xy[better, k], covariance[better, k], shape[better, k] = m.xy[better], m.covariance[better], m.shape[better]
            best[better, k], status[better, k] = m.correlation[better], TrackStatus.MEASURED
    chosen = born(frame, np.arange(n), clicks, shape, np.zeros((n, 3)), np.zeros((n, 3, 3)))
    points, verdict = intersect(view, chosen, xy, covariance, shape, status)
    return points.without(verdict != TrackStatus.MEASURED, verdict)


def _induced_shapes(clicks: np.ndarray, slope: np.ndarray, view: TrackingView) -> np.ndarray:
    """Shapes (N, K, 2, 2) from the reference view to each view, of planes through the clicked points.

    `slope` (2,) is the relative growth of their depth per distance across, in units of the depth; (0, 0) faces the reference camera.
    """
    base, to_frame = view.cameras[view.reference], view.rows.to_frame
    point = intersect_clicks(view.cameras, to_frame(clicks))
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    depth = base.to_camera(point.xyz_m)[:, 2, None] * (1 + (corners * (1, view.rows.step)) @ slope / base.focal_px)
    X = base.points_at_depth(to_frame(clicks[:, view.reference, None] + corners), depth)  # (N, 3, 3)
    image = np.stack([view.rows.from_frame(camera.project(X)) for camera in view.cameras], axis=1)  # (N, K, 3, 2)
    return np.stack([image[:, :, 1] - image[:, :, 0], image[:, :, 2] - image[:, :, 0]], axis=-1)


def _search_warped(
    reference: SplineImage, grey: np.ndarray, xy: np.ndarray, clicks: np.ndarray, shape: np.ndarray, view: TrackingView
) -> np.ndarray:
    """Positions (N, 2) near the clicks at which the reference's patches, warped to these shapes, correlate best."""
    u, v, (w, h) = patch_offsets(view.matching.patch_px, view.rows.step)
    usable = np.abs(np.linalg.det(shape)) > MIN_DETERMINANT
    inverse = np.linalg.inv(np.where(usable[:, None, None], shape, np.eye(2)))
    tile = reference.sample_patches(xy, inverse, np.stack([np.ones_like(u), u, v])).reshape(-1, 2 * h + 1, 2 * w + 1)
    warped, at = atlas(Tiles(identity=np.arange(len(xy)), tile=tile, offset=np.zeros((len(xy), 2))))
    start, _ = search_box(warped, grey, at, clicks, np.full(len(xy), CLICK_REACH_PX), view.matching.patch_px, view.rows.step)
    return np.where(usable[:, None], start, np.nan)


def distances(points: KeyPoints, a: int, b: int) -> np.ndarray:
    """Distance (T,) of two key points in every frame."""
    return np.linalg.norm(points.xyz_m[:, a] - points.xyz_m[:, b], axis=1)
