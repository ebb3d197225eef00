"""One tracking step: from frame i to i + 1, all points as arrays (D'Apuzzo et al. 1999, §2.4; 2000, §3).

    predict   X̂ = 2 X_i − X_{i−1}, projected into every view; a new point moves as its neighbours do              (1)
    search    the box about the prediction for the largest correlation with the patch of frame i                   (2)
    temporal  least squares matching of the patch of frame i in frame i + 1, in every view                         (3)
    control   the reference view's result is adjusted with a match of the point's key template (templates.py),     (4)
              both corrected for the curvature of a turning body where the frame's surface was measured (curvature_correction.py)
    spatial   least squares matching of the reference view's patch in the other views of frame i + 1               (5)
    verify    Δ = x_s − x_t,  Δᵀ (K_s + K_t + Q)⁻¹ Δ ≤ s² χ²(0.999; 2), else again in a larger box, else stop       (6)

Most predictions lie within matching's range of convergence, so the first attempt matches from the prediction without a search.

s² in (6) is a variance component, estimated from the 90 % quantile of the step's own points: matching's covariances are too small where
texture is weak against the noise, by a factor that differs from recording to recording. The result is the controlled match in the reference
view, elsewhere the mean of the temporal and spatial matches weighted by their covariances, and in space the intersection of the rays. Its
covariance includes the drift over the body.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..foundation.arrays import concatenated, select_rows
from ..foundation.progress import Monitor
from ..foundation.threads import equal_pieces, in_threads
from ..geometry.camera import Camera
from ..geometry.intersection import forward_intersection
from ..geometry.small_matrices import invert_spd
from ..images.interlace import FieldLayout, RowGrid
from ..images.sampling import SplineImage
from ..matching.least_squares import (
    SHARED_FROM,
    Matches,
    Matching,
    MatchingSettings,
    PatchTemplates,
    SearchImage,
    TemplatePoints,
    match_patches,
)
from ..matching.patches import patch_offsets
from .curvature_correction import CurvatureCorrection
from .neighbours import common_motion, nearest_neighbours
from .settings import TrackingSettings, TrackStatus
from .templates import REGULARISATION_PX2, Templates, TemplateState, at_least_best, control_drift, search_box
from .tracked import TrackedFrame, rows_of

CHI2 = 13.82  # χ²(0.999; 2) of (6)
CHI2_90 = 4.605  # χ²(0.9; 2), for the variance component
MODEL_SIGMA_PX = 0.12  # Q of (6): deformation that an affine patch does not model
MAX_SCALE = 3.0  # of s
PRIOR_POINTS = 20  # weight of the prior s = 1, in points
ATTEMPT_BOX = (0.0, 0.4, 1.0)  # in units of `tracking.box_px`, by attempt, for points with a predicted motion
ATTEMPT_BOX_NEW = (0.0, 1.0, 2.0)  # the same for points without
HARMLESS_M = 2e-3  # scatter of neighbours about their common motion that is always accepted
TEMPLATE_SIGMA_PX = 0.02  # of the reference view's point in the intersection; its drift is added afterwards
NO_FAILURE = 127  # larger than every TrackStatus


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingView:
    """What a step needs to know of the recording."""

    cameras: tuple[Camera, ...]
    reference: int
    field_layout: FieldLayout
    matching: MatchingSettings
    tracking: TrackingSettings
    limit_px: float  # largest distance between a ray and the image point
    frame: int = 0  # the frame that is measured
    dt_s: float = 0.04  # from one frame to the next
    curvature: CurvatureCorrection | None = None  # from the surface measured in that frame

    def at(self, frame: int) -> "TrackingView":
        """The same for another frame."""
        return replace(self, frame=frame)

    @property
    def rows(self) -> RowGrid:
        """The rows of that frame."""
        return self.field_layout.rows(self.frame)

    @property
    def half_patch(self) -> tuple[int, int]:
        """Half size of the patch, columns and rows."""
        return patch_offsets(self.matching.patch_px, self.rows.step)[2]

    @property
    def others(self) -> list[int]:
        """The views other than the reference."""
        return [k for k in range(len(self.cameras)) if k != self.reference]

    def projected(self, xyz_m: np.ndarray) -> np.ndarray:
        """Points (N, 3) in every view (N, K, 2), rows' pixels of that frame."""
        return np.stack([self.rows.from_frame(camera.project(xyz_m)) for camera in self.cameras], axis=1)


@dataclass(frozen=True, kw_only=True, slots=True)
class FramePair:
    """The rows of two frames, prepared for matching: grey (h', w) float32 and splines, per view."""

    grey: Sequence[np.ndarray]
    spline: Sequence[SplineImage]
    next_grey: Sequence[np.ndarray]
    next_spline: Sequence[SplineImage]


def track_step(
    view: TrackingView,
    before: TrackedFrame | None,
    current: TrackedFrame,
    templates: Templates,
    images: FramePair,
    frame: int,
    monitor: Monitor,
) -> TrackedFrame:
    """Track all points of `current` to `frame`, the second of the two frames of `images`; frames between may be missing.

    Points are in rows' pixels of their own frame; between two fields, positions are converted through the full frame.
    """
    view = view.at(frame)
    n = len(current.identity)
    predicted, moving = predict(current, before, frame, view.tracking.neighbourhood_m)
    reason = np.full(n, TrackStatus.NOT_FOUND, dtype=np.int8)
    result, scale = current, None
    rest = np.flatnonzero(moving)
    for attempt in range(len(ATTEMPT_BOX)):
        if len(rest):
            if monitor.cancelled:
                monitor.step("tracks", attempt, len(ATTEMPT_BOX))
            box = view.tracking.box_px * np.where(moving[rest], ATTEMPT_BOX[attempt], ATTEMPT_BOX_NEW[attempt])
            found, status, scale = _attempt(view, current.select(rest), predicted[rest], box, templates, images, scale)
            reason[rest] = status
            good = status == TrackStatus.MEASURED
            result = result.changed(rest[good], found.select(good))
            predicted, moving = _with_neighbours(current, result, reason == TrackStatus.MEASURED, (predicted, moving), view.tracking)
        rest = np.flatnonzero((reason != TrackStatus.MEASURED) & (reason != TrackStatus.LEFT_IMAGE))
    return replace(result, frame=frame, ended=np.zeros(0, np.int64), reason=np.zeros(0, np.int8)).without(
        reason != TrackStatus.MEASURED, reason
    )


def predict(current: TrackedFrame, before: TrackedFrame | None, frame: int, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Predicted positions (N, 3), and which points have a motion, their own or that of neighbours.  (1)"""
    if before is None or not len(before.identity):
        return current.xyz_m, np.zeros(len(current.identity), dtype=bool)
    at = rows_of(before.identity, current.identity)
    known = at >= 0
    ahead = (frame - current.frame) / max(1, abs(current.frame - before.frame))
    goal = np.where(known[:, None], current.xyz_m + abs(ahead) * (current.xyz_m - before.xyz_m[at]), current.xyz_m)
    new = np.flatnonzero(~known)
    if len(new) and known.any():
        rows, there = nearest_neighbours(current.xyz_m[new], current.xyz_m[known], radius_m)
        moved = common_motion(current.xyz_m[new], current.xyz_m[known][rows], goal[known][rows], there.astype(float), HARMLESS_M).xyz_m
        usable = np.isfinite(moved).all(axis=1)
        goal[new[usable]], known[new[usable]] = moved[usable], True
    return goal, known


def _with_neighbours(
    current: TrackedFrame,
    result: TrackedFrame,
    found: np.ndarray,
    prediction: tuple[np.ndarray, np.ndarray],
    settings: TrackingSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """The prediction, see `predict`, with the points that were not found moved by their neighbours that were."""
    goal, known = (a.copy() for a in prediction)
    lost = np.flatnonzero(~found)
    rows, there = nearest_neighbours(current.xyz_m[lost], current.xyz_m[found], settings.neighbourhood_m)
    if there.any():
        moved = common_motion(current.xyz_m[lost], current.xyz_m[found][rows], result.xyz_m[found][rows], there.astype(float), HARMLESS_M)
        usable = np.isfinite(moved.xyz_m).all(axis=1)
        goal[lost[usable]], known[lost[usable]] = moved.xyz_m[usable], True
    return goal, known


def _attempt(
    view: TrackingView,
    points: TrackedFrame,
    predicted: np.ndarray,
    box: np.ndarray,
    templates: Templates,
    images: FramePair,
    scale: float | None,
) -> tuple[TrackedFrame, np.ndarray, float]:
    """Steps (2) to (6): the points, a status each, and s of (6), which is estimated unless `scale` is given."""
    n, K = len(points.identity), len(view.cameras)
    status = np.where(np.isfinite(points.xy).all(axis=2), TrackStatus.MEASURED, TrackStatus.ABSENT).astype(np.int8)
    start = np.empty((n, K, 2))

    def search(k: int) -> None:
        centre = view.rows.from_frame(view.cameras[k].project(predicted))
        start[:, k], correlation = search_box(
            images.grey[k], images.next_grey[k], points.xy[:, k], centre, box, view.matching.patch_px, view.rows.step
        )
        mark(status[:, k], ~images.next_spline[k].inside(centre, 1.0), TrackStatus.LEFT_IMAGE)
        mark(status[:, k], correlation < view.tracking.min_correlation, TrackStatus.NOT_FOUND)

    in_threads(search, range(K))
    temporal = match_temporally(view, points, start, images, status)
    points, temporal = control(view, points, temporal, templates, images.next_spline[view.reference], status[:, view.reference])
    spatial = match_spatially(view, points, [m.xy for m in temporal], images.next_spline, status)
    scale = scale or disagreement(view, temporal, spatial, status)
    xy, K_xy, shape = _verify(view, points, temporal, spatial, status, scale)
    return *intersect(view, points, xy, K_xy, shape, status), scale


def mark(status: np.ndarray, bad: np.ndarray, why: TrackStatus) -> None:
    """Set the status of the `bad` points that have not failed before."""
    status[bad & (status == TrackStatus.MEASURED)] = why


def match_temporally(view: TrackingView, points: TrackedFrame, start: np.ndarray, images: FramePair, status: np.ndarray) -> list[Matches]:
    """The patch of frame i matched in frame i + 1, per view, all views at once.  (3)"""
    (n, K), row_step = status.shape, view.rows.step

    def match(rows: slice) -> list[Matches]:
        m = rows.stop - rows.start
        templates, begin = list[PatchTemplates](), np.full((K, K, m, 2), np.nan)  # of each image, of each view's patches
        for k in range(K):
            template = TemplatePoints(image=images.spline[k], xy=points.xy[rows, k], row_step=row_step, texture_centre=False)
            templates.append(PatchTemplates(template, view.matching))
            begin[k, k] = np.where((status[rows, k] == TrackStatus.MEASURED)[:, None], start[rows, k], np.nan)
        matching = Matching(images.next_spline, view.matching)
        matching.add(PatchTemplates.joined(templates), begin.reshape(K, K * m, 2), np.tile(np.eye(2), (K, K * m, 1, 1)))
        matching.advance()
        return [select_rows(matches, np.s_[k * m : (k + 1) * m]) for k, matches in enumerate(matching.take()[1])]

    parts = in_threads(match, equal_pieces(n, max(1, n), SHARED_FROM))
    temporal = [concatenated([part[k] for part in parts]) for k in range(K)]
    for k, m in enumerate(temporal):
        mark(status[:, k], ~m.ok, TrackStatus.NOT_MATCHED)
    return temporal


def control(
    view: TrackingView,
    points: TrackedFrame,
    temporal: list[Matches],
    templates: Templates,
    image: SplineImage,
    status: np.ndarray,
) -> tuple[TrackedFrame, list[Matches]]:
    """The points with their drift, and the temporal matches shifted to agree with the key templates.  (4)"""
    raw, curvature = temporal[view.reference], view.curvature
    reference = raw if curvature is None else curvature.corrected(raw, points.local_surface)

    def match_templates(start: np.ndarray, shape: np.ndarray) -> Matches:
        key = templates.match(points.identity, image, start, shape)
        return key if curvature is None else curvature.corrected(key, points.key_local_surface)

    state = TemplateState(shape=points.key_shape, drift=points.drift, key_drift=points.key_drift)
    good = status == TrackStatus.MEASURED
    controlled = control_drift(reference, good, state, match_templates, view.tracking.drift_correlation)
    shift, state = controlled.shift + np.nan_to_num(reference.xy - raw.xy), controlled.state
    moved = [replace(m, xy=m.xy + np.einsum("nij,nj->ni", points.shape[:, k], shift)) for k, m in enumerate(temporal)]
    moved[view.reference] = replace(reference, xy=reference.xy + controlled.shift)
    return replace(points, key_shape=state.shape, key_drift=state.key_drift, drift=state.drift), moved


def match_spatially(
    view: TrackingView, points: TrackedFrame, at: Sequence[np.ndarray], images: Sequence[SplineImage], status: np.ndarray
) -> list[Matches]:
    """The reference view's patch matched in the other views of the same frame, from positions (N, 2) in every view.  (5)

    `status` (N, K) is per view, here and below: a point is tracked without the views in which it failed as long as three are left, or both
    of two.
    """
    good = status == TrackStatus.MEASURED
    good &= good[:, [view.reference]]
    ref = view.reference
    template = TemplatePoints(image=images[ref], xy=at[ref], row_step=view.rows.step, texture_centre=False)
    starts = [np.where(good[:, [k]], at[k], np.nan) for k in view.others]
    searches = [SearchImage(image=images[k], start=start, shape=points.shape[:, k]) for k, start in zip(view.others, starts)]
    spatial = match_patches(template, searches, view.matching)
    for k, s in zip(view.others, spatial):
        mark(status[:, k], ~s.ok, TrackStatus.NOT_VERIFIED)
    return spatial


def disagreement(view: TrackingView, temporal: Sequence[Matches], spatial: Sequence[Matches], status: np.ndarray) -> float:
    """s of (6): the ratio between the observed differences of temporal and spatial matches and those expected from their covariances."""
    d2 = np.concatenate([_distance2(temporal[k], s)[status[:, k] == TrackStatus.MEASURED] for k, s in zip(view.others, spatial)])
    observed = float(np.quantile(d2, 0.9)) / CHI2_90 if len(d2) else 1.0
    return float(np.sqrt(np.clip((len(d2) * observed + PRIOR_POINTS) / (len(d2) + PRIOR_POINTS), 1.0, MAX_SCALE**2)))


def _distance2(t: Matches, s: Matches) -> np.ndarray:
    """Δᵀ (K_s + K_t + Q)⁻¹ Δ of (6)."""
    K = s.covariance + t.covariance + np.eye(2) * MODEL_SIGMA_PX**2
    K = np.where(np.isfinite(K), K, np.eye(2))
    step = s.xy - t.xy
    return np.einsum("ni,nij,nj->n", step, invert_spd(K), step)


def _verify(
    view: TrackingView, points: TrackedFrame, temporal: Sequence[Matches], spatial: Sequence[Matches], status: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, covariances and shapes in every view of the points whose spatial and temporal matches agree.  (6)"""
    xy = np.stack([m.xy for m in temporal], axis=1)
    covariance = np.stack([m.covariance for m in temporal], axis=1)
    covariance[:, view.reference] = np.eye(2) * TEMPLATE_SIGMA_PX**2
    shape = points.shape.copy()
    for k, s in zip(view.others, spatial):
        mark(status[:, k], ~(_distance2(temporal[k], s) <= scale**2 * CHI2), TrackStatus.NOT_VERIFIED)
        xy[:, k], covariance[:, k] = weighted_mean(temporal[k], s, status[:, k] == TrackStatus.MEASURED)
        shape[:, k] = s.shape
    return xy, covariance, shape


def weighted_mean(a: Matches, b: Matches, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 2) and covariances: of these rows (a mask) the weighted mean of both matches, of the others those of `a`."""
    xy, K = a.xy.copy(), a.covariance.copy()
    gain = K[rows] @ invert_spd(K[rows] + b.covariance[rows] + np.eye(2) * REGULARISATION_PX2)
    xy[rows] += np.einsum("nij,nj->ni", gain, (b.xy - a.xy)[rows])
    K[rows] = at_least_best(K[rows] - gain @ K[rows], K[rows], b.covariance[rows])
    return xy, K


def intersect(
    view: TrackingView, points: TrackedFrame, xy: np.ndarray, covariance: np.ndarray, shape: np.ndarray, status: np.ndarray
) -> tuple[TrackedFrame, np.ndarray]:
    """The points at the intersection of the good views' rays, and one status (N,) each, RAYS_MISS where the rays do not meet."""
    good = status == TrackStatus.MEASURED
    verdict = _verdict(view, status)
    usable = good & (verdict == TrackStatus.MEASURED)[:, None]
    xy = np.where(usable[:, :, None], xy, np.nan)
    point = forward_intersection(view.cameras, view.rows.to_frame(xy), view.rows.covariance_to_frame(covariance))
    with np.errstate(invalid="ignore"):
        mark(verdict, ~(point.rms_residual_px <= view.limit_px), TrackStatus.RAYS_MISS)
    K = point.covariance_m2 + drift_covariance(view, point.xyz_m, points.key_drift + points.drift)
    return replace(points, xy=xy, shape=shape, xyz_m=point.xyz_m, covariance_m2=K), verdict


def measured_at(
    view: TrackingView, points: TrackedFrame, at: Sequence[np.ndarray], images: Sequence[SplineImage], status: np.ndarray
) -> tuple[TrackedFrame, np.ndarray]:
    """The points measured by spatial matching alone, from positions (N, 2) in every view, and one status (N,) each."""
    spatial = match_spatially(view, points, at, images, status)
    xy, covariance = np.stack(at, axis=1), np.tile(np.eye(2) * TEMPLATE_SIGMA_PX**2, (*status.shape, 1, 1))
    shape = points.shape.copy()
    for k, s in zip(view.others, spatial):
        xy[:, k], covariance[:, k], shape[:, k] = s.xy, s.covariance, s.shape
    return intersect(view, points, xy, covariance, shape, status)


def _verdict(view: TrackingView, status: np.ndarray) -> np.ndarray:
    """One status (N,) from those of the views (N, K): where too few views are left, why the reference or the first other view failed."""
    good = status == TrackStatus.MEASURED
    enough = good[:, view.reference] & (good.sum(axis=1) >= min(3, len(view.cameras)))
    failed = np.where(good | (status == TrackStatus.ABSENT), NO_FAILURE, status)
    first = np.where(failed[:, view.reference] < NO_FAILURE, failed[:, view.reference], failed.min(axis=1))
    return np.where(enough, TrackStatus.MEASURED, np.where(first < NO_FAILURE, first, TrackStatus.NOT_FOUND)).astype(np.int8)


def drift_covariance(view: TrackingView, xyz_m: np.ndarray, drift_px2: np.ndarray) -> np.ndarray:
    """Covariance (N, 3, 3) of drift (N, 2, 2) in the reference image, across the rays."""
    camera = view.cameras[view.reference]
    pixel_m = camera.to_camera(xyz_m)[:, 2] / camera.focal_px
    across = camera.R_cam_world[:2]  # approximately across the rays, as the camera points at the person
    return np.einsum("ia,nij,jb->nab", across, view.rows.covariance_to_frame(drift_px2), across) * (pixel_m**2)[:, None, None]
