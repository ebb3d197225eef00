"""The 2-D mode: points tracked in the images of one camera (D'Apuzzo et al. 2000, §4).

There is no second view to verify a step, so each is done forwards and backwards: the patch matched in frame i + 1 is matched back in
frame i, and must return to where it started,

    |p − bwd(fwd(p))| ≤ max(0.5 px, 3 σ)                                                                  (1)

Otherwise the point is lost. Its key template is then searched for at its last place in the following frames, for at most
`tracking.wait_frames` of them.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..foundation.progress import Monitor
from ..images.interlace import RowGrid
from ..images.sampling import SplineImage
from ..matching.least_squares import Matches, MatchingSettings, SearchImage, TemplatePoints, match_patches
from .settings import TrackingSettings, TrackStatus
from .templates import REACQUIRE_CORRELATION, Templates, TemplateState, atlas, control_drift, cut_tiles, no_templates, search_box

ALL_ROWS = RowGrid()
RETURN_PX = 0.5  # of (1) (D'Apuzzo et al. 2000, §4)
RETURN_SIGMAS = 3.0  # of (1)
ATTEMPT_BOX = (0.0, 0.4, 2.0)  # in units of `tracking.box_px`, by attempt, for points with a predicted motion
ATTEMPT_BOX_NEW = (0.0, 1.0, 2.0)  # the same for points without
LAST_ATTEMPT = len(ATTEMPT_BOX) - 1
MIN_DETERMINANT = 0.05  # of a shape; a flatter one has no usable inverse


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlanarTracks:
    """N points over T frames of one camera, full-frame pixels. A point that is not visible has NaN, and the reason as its status."""

    frames: np.ndarray  # (T,)
    xy_px: np.ndarray  # (T, N, 2)
    sigma_px: np.ndarray  # (T, N) of the place on the imaged object, x and y combined
    correlation: np.ndarray  # (T, N) with the patch of the frame before
    status: np.ndarray  # (T, N) TrackStatus


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Found:
    """New places of M points in a frame."""

    xy: np.ndarray  # (M, 2)
    state: TemplateState
    correlation: np.ndarray  # (M,)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Points:
    """The state of N points at a frame."""

    xy: np.ndarray  # (N, 2) rows' pixels; of a lost point its last place
    speed: np.ndarray  # (N, 2) px per frame; NaN where unknown
    key_shape: np.ndarray  # (N, 2, 2) as in TemplateState
    drift: np.ndarray  # (N, 2, 2) the same
    key_drift: np.ndarray  # (N, 2, 2) the same
    visible: np.ndarray  # (N,) otherwise it is lost
    lost_frames: np.ndarray  # (N,) frames since it was last visible
    correlation: np.ndarray  # (N,)
    reason: np.ndarray  # (N,) TrackStatus, why a point was lost

    def state(self, rows: np.ndarray) -> TemplateState:
        """Of these rows."""
        return TemplateState(shape=self.key_shape[rows], drift=self.drift[rows], key_drift=self.key_drift[rows])

    def updated(self, before: "_Points", rows: np.ndarray, good: np.ndarray, found: _Found, reason: np.ndarray) -> "_Points":
        """These points with the good ones of `rows` at their new places; the others of `rows` are given the reason (M,)."""
        names = ("xy", "key_shape", "drift", "key_drift", "correlation", "visible", "reason", "speed")
        values = {name: getattr(self, name).copy() for name in names}
        at, state = rows[good], found.state
        new = dict(xy=found.xy, key_shape=state.shape, drift=state.drift, key_drift=state.key_drift, correlation=found.correlation)
        for name, array in (new | {"speed": found.xy - before.xy[rows]}).items():
            values[name][at] = array[good]
        values["speed"][at[~before.visible[at]]] = np.nan
        values["visible"][at] = True
        values["reason"][rows[~good]] = reason[~good]
        return replace(self, **values)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Picture:
    """The rows of one frame, prepared for matching."""

    grey: np.ndarray  # (h', w) float32
    spline: SplineImage


@dataclass(frozen=True, kw_only=True, slots=True)
class _Rules:
    """How points are tracked."""

    matching: MatchingSettings
    tracking: TrackingSettings
    row_step: int  # 2 for a field


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Step:
    """What is matched from one frame to the next, and how."""

    now: _Picture
    after: _Picture
    templates: Templates
    rules: _Rules

    def search(self, xy: np.ndarray, centre: np.ndarray, box: np.ndarray, grey: np.ndarray | None = None) -> np.ndarray:
        """Where (N, 2) in the next frame the patches about `xy` of this frame (or of `grey`) correlate best; NaN where too little."""
        grey = self.now.grey if grey is None else grey
        start, best = search_box(grey, self.after.grey, xy, centre, box, self.rules.matching.patch_px, self.rules.row_step)
        return np.where((best >= self.rules.tracking.min_correlation)[:, None], start, np.nan)


def track_planar(
    read: Callable[[int], np.ndarray],
    frames: range,
    xy_px: np.ndarray,
    matching: MatchingSettings,
    tracking: TrackingSettings,
    monitor: Monitor,
    grid: RowGrid = ALL_ROWS,
) -> PlanarTracks:
    """Track points (N, 2) of the first of `frames` through the others. `read(i)` gives the grey image (h, w) of a frame, of which only
    the rows of `grid` are used: one field of interlaced video.

    The frames may run backwards. Memory does not grow with their number.
    """
    rules = _Rules(matching=matching, tracking=tracking, row_step=grid.step)

    def picture(frame: int) -> _Picture:
        grey = grid.rows(read(frame))
        return _Picture(grey=grey, spline=SplineImage(grey))

    steps = list(_follow(picture, frames, grid.from_frame(xy_px), rules, monitor))
    visible = np.array([s.visible for s in steps])
    variance = np.array([np.trace(grid.covariance_to_frame(s.drift + s.key_drift), axis1=1, axis2=2) for s in steps])
    return PlanarTracks(
        frames=np.array(frames),
        xy_px=np.where(visible[..., None], [grid.to_frame(s.xy) for s in steps], np.nan),
        sigma_px=np.where(visible, np.sqrt(variance), np.nan),
        correlation=np.where(visible, [s.correlation for s in steps], np.nan),
        status=np.where(visible, TrackStatus.MEASURED, [s.reason for s in steps]).astype(np.int8),
    )


def _follow(picture: Callable[[int], _Picture], frames: range, xy: np.ndarray, rules: _Rules, monitor: Monitor) -> Iterator[_Points]:
    now, matching, step = picture(frames[0]), rules.matching, rules.row_step
    templates = no_templates(matching, step).with_tiles(cut_tiles(now.spline, np.arange(len(xy)), xy, matching, step), matching, step)
    points = _first(xy, now.spline)
    yield points
    for i, frame in enumerate(frames[1:]):
        monitor.step("tracks", i, len(frames) - 1)
        after = picture(frame)
        points, renewed = _next(points, _Step(now=now, after=after, templates=templates, rules=rules))
        templates = templates.with_tiles(cut_tiles(after.spline, renewed, points.xy[renewed], matching, step), matching, step)
        now = after
        yield points


def _first(xy: np.ndarray, image: SplineImage) -> _Points:
    n = len(xy)
    zero = np.zeros((n, 2, 2))
    return _Points(
        xy=xy,
        speed=np.full((n, 2), np.nan),
        key_shape=np.tile(np.eye(2), (n, 1, 1)),
        drift=zero,
        key_drift=zero,
        visible=image.inside(xy, 0.0),
        lost_frames=np.zeros(n, dtype=np.int64),
        correlation=np.ones(n),
        reason=np.full(n, TrackStatus.LEFT_IMAGE, dtype=np.int8),
    )


def _next(points: _Points, step: _Step) -> tuple[_Points, np.ndarray]:
    """The points in the next frame, and the rows of those whose present patch is to become their key template."""
    n, box_px = len(points.xy), step.rules.tracking.box_px
    predicted = np.isfinite(points.speed).all(axis=1)
    centre = np.where(predicted[:, None], points.xy + np.nan_to_num(points.speed), points.xy)
    result, replaced = replace(points, visible=np.zeros(n, dtype=bool), speed=np.full((n, 2), np.nan)), [np.zeros(0, dtype=np.int64)]
    for attempt in range(LAST_ATTEMPT + 1):
        rest = np.flatnonzero(points.visible & ~result.visible & (predicted | (attempt > 0)))
        if len(rest):
            box = box_px * np.where(predicted[rest], ATTEMPT_BOX[attempt], ATTEMPT_BOX_NEW[attempt])
            least = REACQUIRE_CORRELATION if attempt == LAST_ATTEMPT else -np.inf  # far from the predicted place
            found, status, renewed = _attempt(points, rest, step.search(points.xy[rest], centre[rest], box), step, least)
            good = status == TrackStatus.MEASURED
            result = result.updated(points, rest, good, found, status)
            replaced.append(rest[renewed & good])
    result = _reacquired(result, points, step)
    return replace(result, lost_frames=np.where(result.visible, 0, points.lost_frames + 1)), np.concatenate(replaced)


def _attempt(
    points: _Points, rows: np.ndarray, start: np.ndarray, step: _Step, min_correlation_renewed: float
) -> tuple[_Found, np.ndarray, np.ndarray]:
    """New places of the points of `rows`, a status each, and which of them no longer match their key template.

    `start` is NaN where the box search failed. A point that no longer matches its key template needs the given correlation.
    """
    matching, tracking, row_step = step.rules.matching, step.rules.tracking, step.rules.row_step
    xy, eye = points.xy[rows], np.tile(np.eye(2), (len(rows), 1, 1))
    template = TemplatePoints(image=step.now.spline, xy=xy, row_step=row_step, texture_centre=False)
    match = match_patches(template, [SearchImage(image=step.after.spline, start=start, shape=eye)], matching)[0]
    good = match.ok & _returns(match, xy, step)
    key_match = partial(step.templates.match, rows, step.after.spline)
    controlled = control_drift(match, good, points.state(rows), key_match, tracking.drift_correlation)
    good &= ~controlled.renewed | (match.correlation >= min_correlation_renewed)
    status = np.where(np.isnan(start).any(axis=1), TrackStatus.NOT_FOUND, TrackStatus.NOT_MATCHED)
    status = np.where(match.ok, TrackStatus.NOT_VERIFIED, status)
    found = _Found(xy=match.xy + controlled.shift, state=controlled.state, correlation=match.correlation)
    return found, np.where(good, TrackStatus.MEASURED, status), controlled.renewed


def _returns(match: Matches, xy: np.ndarray, step: _Step) -> np.ndarray:
    """Which points the match back returns to `xy`, where they started.  (1)"""
    inverse = np.linalg.inv(np.where(np.abs(np.linalg.det(match.shape)) > MIN_DETERMINANT, 1.0, np.nan)[:, None, None] * match.shape)
    inverse = np.where(np.isfinite(inverse), inverse, np.eye(2))
    matching, row_step = step.rules.matching, step.rules.row_step
    template = TemplatePoints(image=step.after.spline, xy=match.xy, row_step=row_step, texture_centre=False)
    back = match_patches(template, [SearchImage(image=step.now.spline, start=xy, shape=inverse)], matching)[0]
    sigma = np.sqrt(np.maximum(np.trace(match.covariance + back.covariance, axis1=1, axis2=2), 0.0))
    return back.ok & (np.linalg.norm(back.xy - xy, axis=1) <= np.maximum(RETURN_PX, RETURN_SIGMAS * sigma))


def _reacquired(result: _Points, points: _Points, step: _Step) -> _Points:
    """The result with those of the lost points whose key template reappears at their last place."""
    tracking = step.rules.tracking
    lost = np.flatnonzero(~points.visible & (points.reason != TrackStatus.LEFT_IMAGE) & (points.lost_frames < tracking.wait_frames))
    if not len(lost):
        return result
    grey, tiles = atlas(step.templates.tiles.select(lost))
    start = step.search(tiles, points.xy[lost], np.full(len(lost), float(tracking.box_px)), grey)
    key = step.templates.match(lost, step.after.spline, start, points.key_shape[lost])
    good = key.ok & (key.correlation >= max(REACQUIRE_CORRELATION, tracking.drift_correlation))
    state = TemplateState(shape=key.shape, drift=key.covariance, key_drift=points.key_drift[lost])
    return result.updated(points, lost, good, _Found(xy=key.xy, state=state, correlation=key.correlation), points.reason[lost])
