"""The tracking step as published, with a separate prediction in each view (D'Apuzzo et al. 1999, §2.4; 2000, §3.1).

    predict   p̂_{i+1} = 2 p_i − p_{i−1} in every image; a new point moves as its neighbours do on average               (1)
    search    the box about p̂ for the largest correlation with the patch of frame i; half its size allows for an
              acceleration a,  r = a dt² f / Z + 2 px                                                                  (2)
    temporal  least squares matching of the patch of frame i in frame i + 1, in every view                             (3)
    spatial   least squares matching of the reference view's patch in the other views of frame i + 1                   (4)
    verify    |x_s − x_t| ≤ 0.5 px, else again in a box of 2 r, else stop                                               (5)

The result is the temporal match in the reference view, elsewhere the mean of both matches weighted by their covariances, and in space the
intersection of the rays. Drift is not controlled: it grows with every frame, and the sigmas include it. The bias of a patch on a curved
surface is not corrected, and the sigmas do not include it. The step in space (step.py) is the other scheme.
"""

from dataclasses import replace

import numpy as np

from ..foundation.progress import Monitor
from .neighbours import nearest_neighbours
from .settings import TrackStatus
from .step import TEMPLATE_SIGMA_PX, FramePair, TrackingView, intersect, mark, match_spatially, match_temporally, track_step, weighted_mean
from .templates import Templates, search_box
from .tracked import TrackedFrame, rows_of

MAX_DIFFERENCE_PX = 0.5  # between spatial and temporal match, (5)
MIN_RADIUS_PX = 2.0  # of (2), without any acceleration
MAX_BOX_PX = 64.0  # of r
ATTEMPTS = (1.0, 2.0)  # in units of r


def track_step_published(
    view: TrackingView,
    before: TrackedFrame | None,
    current: TrackedFrame,
    templates: Templates,
    images: FramePair,
    frame: int,
    monitor: Monitor,
) -> TrackedFrame:
    """Track all points of `current` to `frame`, the second of the two frames of `images`. Key templates are not used."""
    view = view.at(frame)
    centre, box = predict_in_images(view, before, current), search_radius(view, current)
    reason = np.full(len(current.identity), TrackStatus.NOT_FOUND, dtype=np.int8)
    result = current
    for times in ATTEMPTS:
        rest = np.flatnonzero((reason != TrackStatus.MEASURED) & (reason != TrackStatus.LEFT_IMAGE))
        if len(rest):
            if monitor.cancelled:
                monitor.step("tracks", times, max(ATTEMPTS))
            found, status = _attempt(view, current.select(rest), centre[rest], np.minimum(times * box[rest], MAX_BOX_PX), images)
            reason[rest] = status
            good = status == TrackStatus.MEASURED
            result = result.changed(rest[good], found.select(good))
    return replace(result, frame=frame, ended=np.zeros(0, np.int64), reason=np.zeros(0, np.int8)).without(
        reason != TrackStatus.MEASURED, reason
    )


STEPS = {"space": track_step, "published": track_step_published}  # by `tracking.scheme`


def predict_in_images(view: TrackingView, before: TrackedFrame | None, current: TrackedFrame) -> np.ndarray:
    """Predicted positions (N, K, 2), rows' pixels of the view's frame.  (1)"""
    now = view.field_layout.rows(current.frame).to_frame(current.xy)
    if before is None or not len(before.identity) or not len(now):
        return view.rows.from_frame(now)
    at = rows_of(before.identity, current.identity)
    known, new = np.flatnonzero(at >= 0), np.flatnonzero(at < 0)
    frames = abs(view.frame - current.frame) / max(1, abs(current.frame - before.frame))
    moved = np.zeros_like(now)
    moved[known] = frames * (now[known] - view.field_layout.rows(before.frame).to_frame(before.xy)[at[known]])
    moved = np.nan_to_num(moved)  # NaN in a view without the point
    rows, there = nearest_neighbours(current.xyz_m[new], current.xyz_m[known], view.tracking.neighbourhood_m)
    if len(new) and len(known):
        total = np.maximum(there.sum(axis=1), 1)[:, None, None]
        moved[new] = np.where(there[..., None, None], moved[known][rows], 0.0).sum(axis=1) / total
    return view.rows.from_frame(now + moved)


def search_radius(view: TrackingView, current: TrackedFrame) -> np.ndarray:
    """Half the sizes (N, K) of the search boxes, full-frame pixels.  (2)"""
    dt = abs(view.frame - current.frame) * view.dt_s
    depth = np.stack([camera.to_camera(current.xyz_m)[:, 2] for camera in view.cameras], axis=1)
    pixel_m = np.maximum(depth, 1e-3) / np.array([camera.focal_px for camera in view.cameras])
    return np.minimum(view.tracking.prediction_acceleration * dt**2 / pixel_m + MIN_RADIUS_PX, MAX_BOX_PX)


def _attempt(
    view: TrackingView, points: TrackedFrame, centre: np.ndarray, box: np.ndarray, images: FramePair
) -> tuple[TrackedFrame, np.ndarray]:
    """Steps (2) to (5): the points and a status each."""
    status = np.where(np.isfinite(points.xy).all(axis=2), TrackStatus.MEASURED, TrackStatus.ABSENT).astype(np.int8)
    start = np.empty_like(centre)
    for k in range(len(view.cameras)):
        start[:, k], correlation = search_box(
            images.grey[k], images.next_grey[k], points.xy[:, k], centre[:, k], box[:, k], view.matching.patch_px, view.rows.step
        )
        mark(status[:, k], ~images.next_spline[k].inside(centre[:, k], 1.0), TrackStatus.LEFT_IMAGE)
        mark(status[:, k], correlation < view.tracking.min_correlation, TrackStatus.NOT_FOUND)
    temporal = match_temporally(view, points, start, images, status)
    spatial = match_spatially(view, points, [m.xy for m in temporal], images.next_spline, status)
    xy = np.stack([m.xy for m in temporal], axis=1)
    covariance = np.stack([m.covariance for m in temporal], axis=1)
    covariance[:, view.reference] = np.eye(2) * TEMPLATE_SIGMA_PX**2
    shape, ref = points.shape.copy(), temporal[view.reference]
    for k, s in zip(view.others, spatial):
        difference = np.linalg.norm((s.xy - temporal[k].xy) * (1.0, view.rows.step), axis=1)
        mark(status[:, k], ~(difference <= MAX_DIFFERENCE_PX), TrackStatus.NOT_VERIFIED)
        xy[:, k], covariance[:, k] = weighted_mean(temporal[k], s, status[:, k] == TrackStatus.MEASURED)
        shape[:, k] = s.shape
    drift = np.where((status[:, view.reference] == TrackStatus.MEASURED)[:, None, None], points.drift + ref.covariance, points.drift)
    return intersect(view, replace(points, drift=drift, key_shape=ref.shape @ points.key_shape), xy, covariance, shape, status)
