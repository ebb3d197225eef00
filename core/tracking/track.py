"""Tracking of the surface through a whole take: points of each frame are tracked into the next, in the order of time, with a checkpoint
per frame; new points start where the surface has none (D'Apuzzo et al. 2000, §3.2).

A frame in which next to no point is found, because one view is black or the recorder lost it, is left out: the points are tracked from
the frame before it into the one after.

At the outline of a limb, half of a patch shows the background. Such a point belongs to neither surface: it slides along the outline, with a
high correlation. A point is therefore tracked only while its patch lies on the surface measured in the same frame, faces the camera, and
has the depth of that surface. Its depth is then replaced by the surface's, which is corrected for curvature (surface/local_surface.py).

Light and shade stay in place while a body turns, and with them patches of weak texture, which slide over the body with a high correlation.
The images are therefore tracked without their mean over about a patch (`without_shading`). Within one frame, shading is texture like any
other.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..foundation import store
from ..foundation.progress import Monitor
from ..images.enhance import EnhanceSettings, without_shading
from ..images.sampling import SplineImage
from ..matching.least_squares import MatchingSettings
from ..matching.region_growing import MatchedField
from ..results.folder import Results
from ..surface.cloud import PointCloud
from ..surface.frames import MeasuredFrames
from ..surface.measure import MeasuredFrame
from ..surface.starts import FrameImages, load_images
from ..take.footage import Footage
from .curvature_correction import NEAREST_POINTS, CurvatureCorrection, nearest_points
from .lost_points import Guide, LostPoints, none_lost
from .published_step import STEPS
from .settings import TrackingSettings, TrackStatus
from .step import FramePair, TrackingView, drift_covariance
from .templates import Templates, Tiles, cut_tiles, no_templates
from .tracked import TrackedFrame, born, joined, nothing

MIN_DISTANCE = 0.85  # in units of `tracking.spacing_px`: a surface point further from every tracked point starts a trajectory
MIN_FACING = 0.3  # cosine between the normal and the ray to the camera
MAX_DEPTH_SIGMAS = 4.0  # by which a point may lie off the surface
MAX_DEPTH_CELLS = 1.0  # the same in cells of the grid; the larger limit counts
MAX_SLOPE = 3.0  # change of depth per distance across, within one surface
MAX_SHIFT_CELLS = 0.8  # of a cell's texture from its middle; a larger one is at the outline


def start_tracks(field: MatchedField, cloud: PointCloud, view: TrackingView) -> TrackedFrame:
    """The first tracked points: the measured surface, thinned to the spacing of tracking."""
    rows = _thinned(field, view.tracking.spacing_px)
    return _born(field, cloud, rows[_well_inside(field, cloud, rows, view)], 0, view)


def regenerate(tracked: TrackedFrame, field: MatchedField, cloud: PointCloud, view: TrackingView, next_identity: int) -> TrackedFrame:
    """The tracked points of a frame, and new ones where no tracked point is near the frame's measured surface."""
    from scipy.spatial import cKDTree

    rows = _thinned(field, view.tracking.spacing_px)
    if len(tracked.identity) and len(rows):
        to_frame = field.grid.rows.to_frame
        distance, _ = cKDTree(to_frame(tracked.xy[:, view.reference])).query(to_frame(field.xy[rows, view.reference]))
        rows = rows[distance > MIN_DISTANCE * view.tracking.spacing_px]
    return joined(tracked, _born(field, cloud, rows[_well_inside(field, cloud, rows, view)], next_identity, view))


def on_surface(tracked: TrackedFrame, field: MatchedField, cloud: PointCloud, view: TrackingView) -> TrackedFrame:
    """The points that lie on the frame's measured surface; the others end. In a frame without a surface all points stay.

    A point's direction comes from the track, its depth from the surface, which was measured together with its neighbours and corrected for
    curvature.
    """
    from scipy.spatial import cKDTree

    if not len(field.cell) or not len(tracked.identity):
        return tracked
    camera, to_frame = view.cameras[view.reference], field.grid.rows.to_frame
    at = to_frame(tracked.xy[:, view.reference])
    ray, depth = camera.rays(at), camera.to_camera(tracked.xyz_m)[:, 2]
    distance, near = nearest_points(cKDTree(to_frame(field.xy[:, view.reference])), at, NEAREST_POINTS)
    slope = np.einsum("nki,ni->nk", cloud.normals[near], ray)  # negative: towards the camera
    facing = -slope[:, 0] / np.linalg.norm(ray, axis=1)
    met = np.einsum("nki,nki->nk", cloud.normals[near], cloud.xyz_m[near] - camera.centre_m) / np.minimum(slope, -MIN_FACING)
    weight = 1 / np.maximum(distance, 1.0) ** 2
    surface_depth = (weight * met).sum(axis=1) / weight.sum(axis=1)  # where the ray meets the nearest points' tangent planes
    cell_m = field.grid.spacing_px * depth / camera.focal_px
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", ray, tracked.covariance_m2 + cloud.covariance_m2[near[:, 0]], ray)) / (ray**2).sum(axis=1)
    covered = _coverage(field, tracked.xy[:, view.reference], depth, view) >= view.tracking.min_coverage
    reason = np.where(covered & (facing >= MIN_FACING), TrackStatus.MEASURED, TrackStatus.AT_OUTLINE)
    far = np.abs(surface_depth - depth) > np.maximum(MAX_DEPTH_SIGMAS * sigma, MAX_DEPTH_CELLS * cell_m)
    reason[(reason == TrackStatus.MEASURED) & far] = TrackStatus.OFF_SURFACE
    drift = drift_covariance(view, tracked.xyz_m, tracked.key_drift + tracked.drift)
    placed = replace(tracked, xyz_m=camera.centre_m + ray * surface_depth[:, None], covariance_m2=cloud.covariance_m2[near[:, 0]] + drift)
    return _with_local_surface(placed, view).without(reason != TrackStatus.MEASURED, reason)


def _well_inside(field: MatchedField, cloud: PointCloud, rows: np.ndarray, view: TrackingView) -> np.ndarray:
    """Which of these rows of the field may become tracked points: their patches lie on the surface, which faces the camera."""
    camera, xyz = view.cameras[view.reference], field.xyz_m[rows]
    back = camera.centre_m - xyz
    facing = np.einsum("ni,ni->n", cloud.normals[rows], back) / np.linalg.norm(back, axis=1)
    coverage = _coverage(field, field.xy[rows, view.reference], camera.to_camera(xyz)[:, 2], view)
    rays = np.isfinite(field.xy[rows]).all(axis=2).sum(axis=1)
    return (coverage >= view.tracking.min_coverage) & (facing >= MIN_FACING) & (rays >= min(3, len(view.cameras)))


def _coverage(field: MatchedField, xy: np.ndarray, depth: np.ndarray, view: TrackingView) -> np.ndarray:
    """The part (N,) of each point's patch that the measured surface covers at about the point's depth."""
    gh, gw = field.grid.shape
    step, camera = field.grid.step, view.cameras[view.reference]
    surface = np.full((gh + 2, gw + 2), np.nan)
    moved = np.abs(field.xy[:, view.reference] - field.grid.xy(field.cell)) / step
    inner = np.flatnonzero(moved.max(axis=1) <= MAX_SHIFT_CELLS)
    surface[field.cell[inner] // gw + 1, field.cell[inner] % gw + 1] = camera.to_camera(field.xyz_m[inner])[:, 2]
    across, down = (max(1, int(p // s)) for p, s in zip(view.half_patch, step))
    j, i = (d.ravel() for d in np.mgrid[-down : down + 1, -across : across + 1])
    middle = np.rint(xy / step).astype(np.int64) + 1
    there = surface[np.clip(middle[:, 1, None] + j, 0, gh + 1), np.clip(middle[:, 0, None] + i, 0, gw + 1)]
    reach = MAX_SLOPE * field.grid.spacing_px * np.hypot(i, j).max() / camera.focal_px * depth
    with np.errstate(invalid="ignore"):
        return (np.abs(there - depth[:, None]) <= reach[:, None]).mean(axis=1)


def _born(field: MatchedField, cloud: PointCloud, rows: np.ndarray, first: int, view: TrackingView) -> TrackedFrame:
    identity = np.arange(first, first + len(rows))
    return _with_local_surface(
        born(cloud.frame, identity, field.xy[rows], field.shape[rows], cloud.xyz_m[rows], cloud.covariance_m2[rows]), view
    )


def _with_local_surface(points: TrackedFrame, view: TrackingView) -> TrackedFrame:
    """The points with the frame's local surface under them, which is also that of the key templates cut in this frame."""
    if view.curvature is None:
        return points
    here = view.curvature.local_surface(points.xy[:, view.reference])
    return replace(points, local_surface=here, key_local_surface=np.where(points.renewed[:, None], here, points.key_local_surface))


def _thinned(field: MatchedField, spacing_px: int) -> np.ndarray:
    """Rows of the field on every n-th column and row of the grid."""
    n = max(1, round(spacing_px / field.grid.spacing_px))
    j, i = field.cell // field.grid.shape[1], field.cell % field.grid.shape[1]
    return np.flatnonzero((i % n == 0) & (j % n == 0))


ALGORITHM = "tracking 19"  # part of every key: raise it when the same input gives other numbers
SHADING_PATCHES = 1.3  # side of the window whose mean is shading, in sides of a patch
MIN_PART_FOUND = 0.1  # of the points: where fewer are found in a frame, the frame is missing, and not the points


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingRules:
    """How the points of a recording are tracked: the settings concerned, and what its calibration allows."""

    matching: MatchingSettings
    tracking: TrackingSettings
    enhance: EnhanceSettings | None = None
    limit_px: float = 0.0  # rays were allowed to miss by as much when the surface was measured
    smoothed_px: float = 0.0  # sigma of the Gaussian against noise, as when the surface was measured

    @staticmethod
    def of(settings: Mapping[str, Any], measured: MeasuredFrames) -> "TrackingRules":
        """Those of settings by group, for measured frames."""
        return TrackingRules(
            matching=settings["matching"],
            tracking=settings["tracking"],
            enhance=settings["enhance"],
            limit_px=measured.limit_px,
            smoothed_px=measured.smoothed_px,
        )

    def view(self, footage: Footage) -> TrackingView:
        """What a tracking step needs to know of the recording."""
        return TrackingView(
            cameras=footage.rig.cameras,
            reference=footage.take.reference,
            field_layout=footage.take.field_layout,
            matching=self.matching,
            tracking=self.tracking,
            limit_px=max(self.tracking.max_residual_px, self.limit_px),
            dt_s=1 / footage.take.fps,
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _State:
    """What the next step needs."""

    before: TrackedFrame | None
    current: TrackedFrame | None
    templates: Templates
    lost: LostPoints
    next_identity: int

    def after(self, tracked: TrackedFrame, cut: Tiles, view: TrackingView, guide: Guide | None) -> "_State":
        """The state after a frame, with the templates that were cut in it; a frame that was left out changes nothing."""
        if self.current is not None and not len(tracked.identity) and not len(tracked.ended):
            return self
        lost = self.lost if self.current is None else self.lost.after(self.current, tracked, view.tracking, guide)
        wanted = np.concatenate([tracked.identity, lost.points.identity])
        return _State(
            before=self.current,
            current=tracked,
            templates=self.templates.only(wanted).with_tiles(cut, view.matching, view.rows.step),
            lost=lost,
            next_identity=max([self.next_identity, *(tracked.identity[-1:] + 1)]),
        )


def track_frames(
    footage: Footage,
    measured: Sequence[MeasuredFrame],
    rules: TrackingRules,
    results: Results,
    monitor: Monitor,
    guide: Guide | None = None,
) -> Iterator[TrackedFrame]:
    """Track points of the surface through the measured frames, in the order of time.

    Frames with a valid checkpoint are not tracked again; the settings of the filters do not invalidate it. With a `guide` for lost points
    the checkpoints are separate.
    """
    rules = replace(rules, tracking=rules.tracking.of_the_step)
    view = rules.view(footage)
    no_template = no_templates(view.matching, view.rows.step)
    state = _State(before=None, current=None, templates=no_template, lost=none_lost(len(view.cameras)), next_identity=0)
    stamp = repr((rules.matching, rules.tracking, rules.limit_px, rules.smoothed_px, rules.enhance))
    key = store.digest(ALGORITHM, stamp, *([guide.key] if guide else []))
    group = "guided" if guide else "tracks"
    images: FrameImages | None = None
    for i, surface in enumerate(measured):
        monitor.step("tracks", i, len(measured))
        key = store.digest(key, surface.key)
        done = _from_checkpoint(results, group, surface.frame, key)
        if done is None:
            if state.current is not None and images is None:
                images = _images(footage, state.current.frame, rules)
            next_images = _images(footage, surface.frame, rules)
            start_new = bool(view.tracking.regenerate_every) and i % view.tracking.regenerate_every == 0
            tracked = _advance(view.at(surface.frame), state, _pair(images, next_images), surface, monitor, guide, start_new)
            done = tracked, _cut(view, tracked, next_images)
            _checkpoint(results, group, *done, key)
        else:
            next_images = None
        after = state.after(*done, view, guide)
        images = images if after is state else next_images
        state = after
        yield done[0]


def _images(footage: Footage, frame: int, rules: TrackingRules) -> FrameImages:
    """Read a frame for tracking: smoothed as the surface was measured, and without shading, unless tracking is that of the papers."""
    images = load_images(footage, frame, rules.enhance)
    if rules.tracking.scheme != "space":
        return images
    window_px, row_step = round(SHADING_PATCHES * rules.matching.patch_px), footage.take.rows_at(frame).step
    smooth = [image.smoothed(rules.smoothed_px, row_step) for image in images.spline] if rules.smoothed_px else images.spline
    level = [without_shading(image.grey, window_px, row_step=row_step) for image in smooth]
    return FrameImages(grey=level, spline=[SplineImage(grey) for grey in level])


def _pair(images: FrameImages | None, after: FrameImages) -> FramePair | None:
    if images is None:
        return None
    return FramePair(grey=images.grey, spline=images.spline, next_grey=after.grey, next_spline=after.spline)


def _advance(
    view: TrackingView,
    state: _State,
    images: FramePair | None,
    surface: MeasuredFrame,
    monitor: Monitor,
    guide: Guide | None,
    start_new: bool,
) -> TrackedFrame:
    """The tracked points in the frame of the view, whose surface is given; with `start_new` new ones where it has none."""
    surface, in_space = surface.of_patches, view.tracking.scheme == "space"
    if in_space:
        view = replace(view, curvature=_curvature(view, surface))
    if state.current is None or images is None:
        return start_tracks(surface.field, surface.cloud, view)
    tracked = STEPS[view.tracking.scheme](view, state.before, state.current, state.templates, images, surface.frame, monitor)
    few = len(tracked.identity) < MIN_PART_FOUND * len(state.current.identity)
    if few and surface.frame - state.current.frame <= view.tracking.bridge_frames:
        return nothing(surface.frame, len(view.cameras))
    if in_space:
        lost = state.lost.carried(state.current, tracked, view.tracking, guide).in_sight(guide)
        reacquired = on_surface(lost.reacquired(view, state.templates, images.next_spline), surface.field, surface.cloud, view)
        tracked = joined(on_surface(tracked, surface.field, surface.cloud, view), reacquired)
    return regenerate(tracked, surface.field, surface.cloud, view, state.next_identity) if start_new else tracked


def _curvature(view: TrackingView, surface: MeasuredFrame) -> CurvatureCorrection:
    return CurvatureCorrection(
        field=surface.field,
        cloud=surface.cloud,
        camera=view.cameras[view.reference],
        reference=view.reference,
        half_patch=view.half_patch,
    )


def _cut(view: TrackingView, tracked: TrackedFrame, images: FrameImages) -> Tiles:
    """The tiles of the key templates that are cut in this frame: of new points, and of those that no longer match theirs."""
    new = tracked.renewed
    return cut_tiles(images.spline[view.reference], tracked.identity[new], tracked.xy[new, view.reference], view.matching, view.rows.step)


def _checkpoint(results: Results, group: str, tracked: TrackedFrame, cut: Tiles, key: str) -> None:
    arrays = tracked.arrays() | {f"cut_{f.name}": getattr(cut, f.name) for f in fields(Tiles)}
    results.save_checkpoint(group, f"{tracked.frame:04d}", key, arrays)


def _from_checkpoint(results: Results, group: str, frame: int, key: str) -> tuple[TrackedFrame, Tiles] | None:
    arrays = results.load_checkpoint(group, f"{frame:04d}", key)
    if arrays is None:
        return None
    cut = Tiles(**{f.name: arrays.pop(f"cut_{f.name}") for f in fields(Tiles)})
    return TrackedFrame(frame=frame, **arrays), cut
