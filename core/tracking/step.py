"""One tracking step: from frame i to i + 1, all points as arrays (D'Apuzzo et al. 1999, §2.4; 2000, §3).

    predict   X̂ = 2 X_i − X_{i−1} (a new point stays where it is), projected into every view                 (1)
    search    the box about the prediction for the largest correlation with the patch of frame i              (2)
    temporal  least squares matching of the patch of frame i in frame i + 1, in every view                    (3)
    spatial   least squares matching of the reference view's patch in the other views of frame i + 1          (4)
    verify    |x_s − x_t| ≤ max(0.5 px, 3 √(σ_s² + σ_t²)), else once more in a box twice as large, else stop  (5)

Kept: the reference view's temporal result, elsewhere the mean of temporal and spatial weighted by their covariances; then the point
where the rays meet.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.intersection import Intersection, forward_intersection
from ..images.fields import RowGrid
from ..images.sampling import SplineImage
from ..matching.least_squares import Matches, MatchingSettings, match_patches, patch_offsets
from ..progress import Monitor
from ..settings import knob

VERIFY_PX, VERIFY_SIGMAS = 0.5, 3.0
PREDICTED_BOX = 0.4  # of the box, for points whose velocity is known


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingSettings:
    """How points are followed from frame to frame, and which trajectories are kept."""

    spacing_px: int = knob(8, "Distance between tracked points in the reference image.", unit="px", low=1, high=64)
    box_px: int = knob(
        12,
        "Half size of the box that is searched about the predicted position; the second try has twice as much.",
        unit="px",
        low=2,
        high=64,
    )
    min_correlation: float = knob(0.6, "Smallest correlation in the box.", low=0.0, high=0.99)
    max_residual_px: float = knob(
        0.7, "Largest distance by which rays may miss, or what the calibration of the take needs.", unit="px", low=0.05, high=10.0
    )
    regenerate_every: int = knob(
        2, "Every so many frames, new points start where the surface has none (0: never).", unit="frames", low=0, high=1000
    )
    max_speed: float = knob(10.0, "Trajectories faster than this are cut.", unit="m/s", low=0.1, high=100.0)
    max_acceleration: float = knob(150.0, "Trajectories that accelerate more than this are cut.", unit="m/s²", low=1.0, high=10_000.0)
    min_length: int = knob(5, "Trajectories of fewer frames are removed.", unit="frames", low=2, high=1000)


class TrackStatus(IntEnum):
    """What became of a trajectory in a frame."""

    ABSENT = 0  # not born yet, or ended before
    MEASURED = 1
    LEFT_IMAGE = 2
    NOT_FOUND = 3  # no correlation in the box
    NOT_MATCHED = 4  # temporal matching failed its limits
    NOT_VERIFIED = 5  # spatial matching contradicts the temporal one
    RAYS_MISS = 6
    TOO_FAST = 7
    ACCELERATES = 8
    TOO_SHORT = 9


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TrackedFrame:
    """The points that are followed at one frame. Rows' pixels, metres."""

    frame: int
    identity: np.ndarray  # (N,) int, ascending
    xy: np.ndarray  # (N, K, 2)
    shape: np.ndarray  # (N, K, 2, 2) from the reference view to each view
    xyz_m: np.ndarray  # (N, 3)
    covariance_m2: np.ndarray  # (N, 3, 3)
    ended: np.ndarray  # (M,) identities that were lost on the way to this frame
    reason: np.ndarray  # (M,) TrackStatus

    def select(self, rows: np.ndarray) -> "TrackedFrame":
        """Only these rows (a mask or indices); the ended ones stay."""
        names = ("identity", "xy", "shape", "xyz_m", "covariance_m2")
        return TrackedFrame(frame=self.frame, ended=self.ended, reason=self.reason, **{n: getattr(self, n)[rows] for n in names})


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TrackingView:
    """What a step needs to know of the recording."""

    cameras: tuple[Camera, ...]
    reference: int
    rows: RowGrid
    matching: MatchingSettings
    tracking: TrackingSettings
    limit_px: float  # by which rays may miss


def track_step(
    view: TrackingView,
    before: TrackedFrame | None,
    current: TrackedFrame,
    images: Sequence[SplineImage],
    next_images: Sequence[SplineImage],
    next_grey: Sequence[np.ndarray],
    grey: Sequence[np.ndarray],
    frame: int,
    monitor: Monitor,
) -> TrackedFrame:
    """Follow all points of `current` to `frame`, whose images are `next_images` and `next_grey` (rows, float32)."""
    n = len(current.identity)
    predicted, known = _predict(current, before)
    reason = np.full(n, TrackStatus.LEFT_IMAGE, dtype=np.int8)
    result, rest = current, np.arange(n)
    for attempt in (1, 2):
        box = np.where(known[rest] & (attempt == 1), PREDICTED_BOX * view.tracking.box_px, attempt * view.tracking.box_px)
        if monitor.cancelled:
            monitor.step("tracks", attempt, 2)
        found, status = _attempt(view, current.select(rest), predicted[rest], box, images, next_images, next_grey, grey)
        reason[rest] = status
        good = status == TrackStatus.MEASURED
        result = _replace_rows(result, rest[good], found, good)
        rest = rest[~good]
        rest = rest[reason[rest] != TrackStatus.LEFT_IMAGE]
        if not len(rest):
            break
    kept = reason == TrackStatus.MEASURED
    return TrackedFrame(
        frame=frame,
        identity=current.identity[kept],
        xy=result.xy[kept],
        shape=result.shape[kept],
        xyz_m=result.xyz_m[kept],
        covariance_m2=result.covariance_m2[kept],
        ended=current.identity[~kept],
        reason=reason[~kept],
    )


def _predict(current: TrackedFrame, before: TrackedFrame | None) -> tuple[np.ndarray, np.ndarray]:
    """Predicted positions (N, 3) and for which points a velocity is known.  (1)"""
    if before is None or not len(before.identity):
        return current.xyz_m, np.zeros(len(current.identity), dtype=bool)
    at = np.searchsorted(before.identity, current.identity).clip(0, len(before.identity) - 1)
    known = before.identity[at] == current.identity
    return np.where(known[:, None], 2 * current.xyz_m - before.xyz_m[at], current.xyz_m), known


def _attempt(
    view: TrackingView,
    points: TrackedFrame,
    predicted: np.ndarray,
    box: np.ndarray,
    images: Sequence[SplineImage],
    next_images: Sequence[SplineImage],
    next_grey: Sequence[np.ndarray],
    grey: Sequence[np.ndarray],
) -> tuple[TrackedFrame, np.ndarray]:
    n, K = len(points.identity), len(view.cameras)
    status = np.full(n, TrackStatus.MEASURED, dtype=np.int8)
    start = np.empty((n, K, 2))
    for k, camera in enumerate(view.cameras):
        centre = view.rows.from_frame(camera.project(predicted))
        start[:, k], correlation = _search_box(grey[k], next_grey[k], points.xy[:, k], centre, box, view)
        _mark(status, ~next_images[k].inside(centre, 1.0), TrackStatus.LEFT_IMAGE)
        _mark(status, correlation < view.tracking.min_correlation, TrackStatus.NOT_FOUND)
    temporal = _temporal(view, points, start, images, next_images, status)
    xy, covariance, shape = _verify(view, points, temporal, next_images, status)
    good = status == TrackStatus.MEASURED
    point = forward_intersection(
        view.cameras, np.where(good[:, None, None], view.rows.to_frame(xy), np.nan), view.rows.covariance_to_frame(covariance)
    )
    with np.errstate(invalid="ignore"):
        _mark(status, ~(point.rms_residual_px <= view.limit_px), TrackStatus.RAYS_MISS)
    return _tracked(points, xy, shape, point), status


def _mark(status: np.ndarray, bad: np.ndarray, why: TrackStatus) -> None:
    status[bad & (status == TrackStatus.MEASURED)] = why


def _search_box(
    grey: np.ndarray, next_grey: np.ndarray, xy: np.ndarray, centre: np.ndarray, box: np.ndarray, view: TrackingView
) -> tuple[np.ndarray, np.ndarray]:
    """Start positions (n, 2) where the patch correlates best within the box, and that correlation (n,).  (2)"""
    _, _, (w, h) = patch_offsets(view.matching.patch_px, view.rows.step)
    H, W = grey.shape
    best, start = np.full(len(xy), -1.0), np.array(centre)
    with np.errstate(invalid="ignore"):
        p = np.rint(np.nan_to_num(xy, nan=-1e6)).astype(np.int64)
        q = np.rint(np.nan_to_num(centre, nan=-1e6)).astype(np.int64)
    rx, ry = np.ceil(box).astype(np.int64), np.maximum(1, np.ceil(box / view.rows.step)).astype(np.int64)
    usable = (p[:, 0] >= w) & (p[:, 1] >= h) & (p[:, 0] < W - w) & (p[:, 1] < H - h)
    usable &= (q[:, 0] >= w) & (q[:, 1] >= h) & (q[:, 0] < W - w) & (q[:, 1] < H - h)
    for i in np.flatnonzero(usable):
        (px, py), (qx, qy) = p[i], q[i]
        x0, x1 = max(0, qx - w - rx[i]), min(W, qx + w + rx[i] + 1)
        y0, y1 = max(0, qy - h - ry[i]), min(H, qy + h + ry[i] + 1)
        score = cv2.matchTemplate(next_grey[y0:y1, x0:x1], grey[py - h : py + h + 1, px - w : px + w + 1], cv2.TM_CCOEFF_NORMED)
        _, best[i], _, (bx, by) = cv2.minMaxLoc(score)
        start[i] = xy[i] + (x0 + bx + w - px, y0 + by + h - py)
    return start, best


def _temporal(
    view: TrackingView,
    points: TrackedFrame,
    start: np.ndarray,
    images: Sequence[SplineImage],
    next_images: Sequence[SplineImage],
    status: np.ndarray,
) -> list[Matches]:
    """The patch of frame i found in frame i + 1, per view.  (3)"""
    eye = np.tile(np.eye(2), (len(start), 1, 1))
    matches = []
    for k in range(len(view.cameras)):
        begin = np.where((status == TrackStatus.MEASURED)[:, None], start[:, k], np.nan)
        m = match_patches(images[k], points.xy[:, k], [next_images[k]], [begin], [eye], view.matching, row_step=view.rows.step)[0]
        _mark(status, ~m.ok, TrackStatus.NOT_MATCHED)
        matches.append(m)
    return matches


def _verify(
    view: TrackingView, points: TrackedFrame, temporal: list[Matches], next_images: Sequence[SplineImage], status: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, covariances and shapes of frame i + 1 in every view, where spatial and temporal matching agree.  (4), (5)"""
    ref = view.reference
    others = [k for k in range(len(view.cameras)) if k != ref]
    good = status == TrackStatus.MEASURED
    centre = temporal[ref].xy
    starts = [np.where(good[:, None], temporal[k].xy, np.nan) for k in others]
    spatial = match_patches(
        next_images[ref],
        centre,
        [next_images[k] for k in others],
        starts,
        [points.shape[:, k] for k in others],
        view.matching,
        row_step=view.rows.step,
    )
    xy = np.stack([m.xy for m in temporal], axis=1)
    covariance = np.stack([m.covariance for m in temporal], axis=1)
    shape = points.shape.copy()
    for k, s in zip(others, spatial):
        _mark(status, ~s.ok, TrackStatus.NOT_VERIFIED)
        total = s.covariance + temporal[k].covariance
        allowed = np.maximum(VERIFY_PX, VERIFY_SIGMAS * np.sqrt(np.maximum(np.trace(total, axis1=1, axis2=2), 0.0)))
        _mark(status, np.linalg.norm(s.xy - temporal[k].xy, axis=1) > allowed, TrackStatus.NOT_VERIFIED)
        xy[:, k], covariance[:, k] = _weighted_mean(temporal[k], s, status == TrackStatus.MEASURED)
        shape[:, k] = s.shape
    return xy, covariance, shape


def _weighted_mean(a: Matches, b: Matches, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    xy, K = a.xy.copy(), a.covariance.copy()
    small = np.eye(2) * 1e-8
    P, Q = np.linalg.inv(a.covariance[rows] + small), np.linalg.inv(b.covariance[rows] + small)
    K[rows] = np.linalg.inv(P + Q)
    xy[rows] = np.einsum("nij,nj->ni", K[rows], np.einsum("nij,nj->ni", P, a.xy[rows]) + np.einsum("nij,nj->ni", Q, b.xy[rows]))
    return xy, K


def _tracked(points: TrackedFrame, xy: np.ndarray, shape: np.ndarray, point: Intersection) -> TrackedFrame:
    return TrackedFrame(
        frame=points.frame,
        identity=points.identity,
        xy=xy,
        shape=shape,
        xyz_m=point.xyz_m,
        covariance_m2=point.covariance_m2,
        ended=points.ended,
        reason=points.reason,
    )


def _replace_rows(all_rows: TrackedFrame, rows: np.ndarray, found: TrackedFrame, good: np.ndarray) -> TrackedFrame:
    values = {}
    for name in ("xy", "shape", "xyz_m", "covariance_m2"):
        values[name] = getattr(all_rows, name).copy()
        values[name][rows] = getattr(found, name)[good]
    return TrackedFrame(frame=all_rows.frame, identity=all_rows.identity, ended=all_rows.ended, reason=all_rows.reason, **values)
