"""Tracking the whole surface: which points are followed, where new ones start, and each frame's own surface as a control
(D'Apuzzo et al. 2000, §3.2).

At the outline of a limb half of a patch shows what lies behind it. Such a point is neither on the one nor on the other: it slides along
the outline, well correlated. So a point is followed only while its patch lies on the surface that was measured in the same frame, faces the
camera, and is no deeper or nearer than that surface. From it the points take the correction for curvature, too (surface/cloud.py).
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ..matching.growing import TripletField
from ..surface.cloud import PointCloud
from .relief import NEAREST_POINTS
from .settings import TrackStatus
from .step import TrackingView, over_the_body
from .tracked import TrackedFrame, born, joined

BARE = 0.85  # a surface point with no tracked point within this many spacings starts a new trajectory
STEEPEST_COSINE = 0.3  # between the normal and the ray
DEPTH_SIGMAS, DEPTH_CELLS = 4.0, 1.0
STEEPEST_SLOPE = 3.0  # change of depth per distance across, within one surface
MOVED_CELLS = 0.8  # a cell whose texture lies further from its middle is at the outline


def start_tracks(field: TripletField, cloud: PointCloud, view: TrackingView) -> TrackedFrame:
    """The first tracked points: the measured surface, thinned to the tracking's spacing."""
    rows = _thinned(field, view.tracking.spacing_px)
    return _born(field, cloud, rows[_well_inside(field, cloud, rows, view)], 0, view)


def regenerate(tracked: TrackedFrame, field: TripletField, cloud: PointCloud, view: TrackingView, next_identity: int) -> TrackedFrame:
    """The tracked points of a frame and new ones from the frame's own surface, where it has no tracked point near."""
    rows = _thinned(field, view.tracking.spacing_px)
    if len(tracked.identity) and len(rows):
        to_frame = field.grid.rows.to_frame
        distance, _ = cKDTree(to_frame(tracked.xy[:, view.reference])).query(to_frame(field.xy[rows, view.reference]))
        rows = rows[distance > BARE * view.tracking.spacing_px]
    return joined(tracked, _born(field, cloud, rows[_well_inside(field, cloud, rows, view)], next_identity, view))


def on_surface(tracked: TrackedFrame, field: TripletField, cloud: PointCloud, view: TrackingView) -> TrackedFrame:
    """The points that lie on the frame's own surface; the others end. A frame in which no surface was measured says nothing.

    The track says where on the surface a point is, the surface how deep: it was measured with all neighbours, and corrected for
    curvature, which a patch alone sees too flat.
    """
    if not len(field.cell) or not len(tracked.identity):
        return tracked
    camera, to_frame = view.cameras[view.reference], field.grid.rows.to_frame
    at = to_frame(tracked.xy[:, view.reference])
    ray, depth = camera.rays(at), camera.to_camera(tracked.xyz_m)[:, 2]
    distance, near = cKDTree(to_frame(field.xy[:, view.reference])).query(at, k=min(NEAREST_POINTS, len(field.cell)))
    distance, near = distance.reshape(len(at), -1), near.reshape(len(at), -1)
    slope = np.einsum("nki,ni->nk", cloud.normals[near], ray)  # negative: towards the camera
    facing = -slope[:, 0] / np.linalg.norm(ray, axis=1)
    met = np.einsum("nki,nki->nk", cloud.normals[near], cloud.xyz_m[near] - camera.centre_m) / np.minimum(slope, -STEEPEST_COSINE)
    weight = 1 / np.maximum(distance, 1.0) ** 2
    found = (weight * met).sum(axis=1) / weight.sum(axis=1)  # depth at which the ray meets the tangent planes of the nearest points
    cell_m = field.grid.spacing_px * depth / camera.focal_px
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", ray, tracked.covariance_m2 + cloud.covariance_m2[near[:, 0]], ray)) / (ray**2).sum(axis=1)
    covered = _coverage(field, tracked.xy[:, view.reference], depth, view) >= view.tracking.min_coverage
    reason = np.where(covered & (facing >= STEEPEST_COSINE), TrackStatus.MEASURED, TrackStatus.AT_OUTLINE)
    far = np.abs(found - depth) > np.maximum(DEPTH_SIGMAS * sigma, DEPTH_CELLS * cell_m)
    reason[(reason == TrackStatus.MEASURED) & far] = TrackStatus.OFF_SURFACE
    strayed = over_the_body(view, tracked.xyz_m, tracked.key_drift + tracked.drift)
    placed = replace(tracked, xyz_m=camera.centre_m + ray * found[:, None], covariance_m2=cloud.covariance_m2[near[:, 0]] + strayed)
    return _with_local_surface(placed, view).without(reason != TrackStatus.MEASURED, reason)


def _well_inside(field: TripletField, cloud: PointCloud, rows: np.ndarray, view: TrackingView) -> np.ndarray:
    """Which of these rows of the field may become tracked points."""
    camera, xyz = view.cameras[view.reference], field.xyz_m[rows]
    back = camera.centre_m - xyz
    facing = np.einsum("ni,ni->n", cloud.normals[rows], back) / np.linalg.norm(back, axis=1)
    coverage = _coverage(field, field.xy[rows, view.reference], camera.to_camera(xyz)[:, 2], view)
    rays = np.isfinite(field.xy[rows]).all(axis=2).sum(axis=1)
    return (coverage >= view.tracking.min_coverage) & (facing >= STEEPEST_COSINE) & (rays >= min(3, len(view.cameras)))


def _coverage(field: TripletField, xy: np.ndarray, depth: np.ndarray, view: TrackingView) -> np.ndarray:
    """Part (N,) of the patch about each point that the measured surface covers at the point's depth."""
    gh, gw = field.grid.shape
    step, camera = field.grid.step, view.cameras[view.reference]
    surface = np.full((gh + 2, gw + 2), np.nan)
    moved = np.abs(field.xy[:, view.reference] - field.grid.xy(field.cell)) / step
    inner = np.flatnonzero(moved.max(axis=1) <= MOVED_CELLS)
    surface[field.cell[inner] // gw + 1, field.cell[inner] % gw + 1] = camera.to_camera(field.xyz_m[inner])[:, 2]
    across, down = (max(1, int(p // s)) for p, s in zip(view.half_patch, step))
    j, i = (d.ravel() for d in np.mgrid[-down : down + 1, -across : across + 1])
    middle = np.rint(xy / step).astype(np.int64) + 1
    there = surface[np.clip(middle[:, 1, None] + j, 0, gh + 1), np.clip(middle[:, 0, None] + i, 0, gw + 1)]
    reach = STEEPEST_SLOPE * field.grid.spacing_px * np.hypot(i, j).max() / camera.focal_px * depth
    with np.errstate(invalid="ignore"):
        return (np.abs(there - depth[:, None]) <= reach[:, None]).mean(axis=1)


def _born(field: TripletField, cloud: PointCloud, rows: np.ndarray, first: int, view: TrackingView) -> TrackedFrame:
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


def _thinned(field: TripletField, spacing_px: int) -> np.ndarray:
    """Rows of the field on every n-th column and row of the grid."""
    n = max(1, round(spacing_px / field.grid.spacing_px))
    j, i = field.cell // field.grid.shape[1], field.cell % field.grid.shape[1]
    return np.flatnonzero((i % n == 0) & (j % n == 0))
