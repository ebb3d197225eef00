"""The 2-D mode: points followed in the images of one camera (D'Apuzzo et al. 2000, §4).

There is no second view to verify a step, so each is done forwards and backwards: the patch found in frame i + 1 is matched back in
frame i, and must come back to where it was,

    |p − bwd(fwd(p))| ≤ max(0.5 px, 3 σ)                                                                  (1)

Else the point is lost. A lost point waits where it was last seen, and its key template is looked for there in the frames that follow, as
many as it may wait for.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..images.fields import RowGrid
from ..images.sampling import SplineImage
from ..matching.least_squares import MatchingSettings, match_patches
from ..progress import Monitor
from .control import hold
from .search import search_box
from .settings import TrackingSettings, TrackStatus
from .templates import Templates, atlas, cut_tiles, no_templates

FRAME = RowGrid()  # all rows
RETURN_PX, RETURN_SIGMAS = 0.5, 3.0
KNOWN_BOX, UNKNOWN_BOX = (0.0, 0.4, 2.0), (0.0, 1.0, 2.0)  # of the box in each attempt, for points whose motion is known or not
RETAKEN_CORRELATION = 0.9  # of a lost point with its template: more than in tracking, for nothing else speaks for it


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlanarTracks:
    """N points over T frames of one camera, full-frame pixels. A point that is not seen has NaN, and a status that says why."""

    frames: np.ndarray  # (T,)
    xy_px: np.ndarray  # (T, N, 2)
    sigma_px: np.ndarray  # (T, N) of the place on what is shown, over both directions
    correlation: np.ndarray  # (T, N) with the patch of the frame before
    status: np.ndarray  # (T, N) TrackStatus


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Points:
    """The state of N points at a frame."""

    xy: np.ndarray
    speed: np.ndarray  # (N, 2) px per frame; NaN when not known
    key_shape: np.ndarray
    drift: np.ndarray
    key_drift: np.ndarray
    seen: np.ndarray  # (N,) else it waits
    since: np.ndarray  # (N,) frames since it was seen
    correlation: np.ndarray
    reason: np.ndarray


@dataclass(frozen=True, kw_only=True, slots=True)
class _How:
    """By which rules points are followed."""

    matching: MatchingSettings
    tracking: TrackingSettings
    row_step: int  # 2 for a field


def track_planar(
    read: Callable[[int], np.ndarray],
    frames: range,
    xy_px: np.ndarray,
    matching: MatchingSettings,
    tracking: TrackingSettings,
    monitor: Monitor,
    grid: RowGrid = FRAME,
) -> PlanarTracks:
    """Follow points (N, 2) of the first of `frames` through the others. `read(i)` gives the grey image (h, w) of a frame, of which the rows
    of `grid` are looked at: of interlaced video one field.

    The frames may run backwards. Memory does not grow with their number.
    """
    how = _How(matching=matching, tracking=tracking, row_step=grid.step)
    steps = list(_follow(lambda i: grid.rows(read(i)), frames, grid.from_frame(xy_px), how, monitor))
    seen = np.array([s.seen for s in steps])
    spread = np.array([np.trace(grid.covariance_to_frame(s.drift + s.key_drift), axis1=1, axis2=2) for s in steps])
    return PlanarTracks(
        frames=np.array(frames),
        xy_px=np.where(seen[..., None], [grid.to_frame(s.xy) for s in steps], np.nan),
        sigma_px=np.where(seen, np.sqrt(spread), np.nan),
        correlation=np.where(seen, [s.correlation for s in steps], np.nan),
        status=np.where(seen, TrackStatus.MEASURED, [s.reason for s in steps]).astype(np.int8),
    )


def _follow(
    read: Callable[[int], np.ndarray],
    frames: range,
    xy: np.ndarray,
    how: _How,
    monitor: Monitor,
) -> Iterator[_Points]:
    matching, step = how.matching, how.row_step
    grey = read(frames[0])
    image, n = SplineImage(grey), len(xy)
    templates = no_templates(matching, step).with_tiles(cut_tiles(image, np.arange(n), xy, matching, step), matching, step)
    none = np.zeros((n, 2, 2))
    points = _Points(
        xy=xy,
        speed=np.full((n, 2), np.nan),
        key_shape=np.tile(np.eye(2), (n, 1, 1)),
        drift=none,
        key_drift=none,
        seen=image.inside(xy, 0.0),
        since=np.zeros(n, dtype=np.int64),
        correlation=np.ones(n),
        reason=np.full(n, TrackStatus.LEFT_IMAGE, dtype=np.int8),
    )
    yield points
    for i, frame in enumerate(frames[1:]):
        monitor.step("tracks", i, len(frames) - 1)
        next_grey = read(frame)
        following = SplineImage(next_grey)
        points, fresh = _step(points, templates, (grey, image), (next_grey, following), how)
        templates = templates.with_tiles(cut_tiles(following, fresh, points.xy[fresh], matching, step), matching, step)
        grey, image = next_grey, following
        yield points


def _step(
    points: _Points,
    templates: Templates,
    now: tuple[np.ndarray, SplineImage],
    after: tuple[np.ndarray, SplineImage],
    how: _How,
) -> tuple[_Points, np.ndarray]:
    """One frame on; and which points need their present patch as a new template."""
    matching, tracking = how.matching, how.tracking
    rows = np.arange(len(points.xy))
    known = np.isfinite(points.speed).all(axis=1)
    result, fresh = replace(points, seen=np.zeros(len(rows), dtype=bool), speed=np.full((len(rows), 2), np.nan)), []
    centre = np.where(known[:, None], points.xy + np.nan_to_num(points.speed), points.xy)
    for attempt in range(3):
        rest = np.flatnonzero(points.seen & ~result.seen & (known | (attempt > 0)))
        if len(rest):
            box = tracking.box_px * np.where(known[rest], KNOWN_BOX[attempt], UNKNOWN_BOX[attempt])
            start, best = search_box(now[0], after[0], points.xy[rest], centre[rest], box, matching.patch_px, how.row_step)
            eye = np.tile(np.eye(2), (len(rest), 1, 1))
            start = np.where((best >= tracking.min_correlation)[:, None], start, np.nan)
            there = match_patches(now[1], points.xy[rest], [after[1]], [start], [eye], matching, row_step=how.row_step,
                                  of_texture=False)[0]  # fmt: skip
            good = there.ok & _returns(now[1], after[1], points.xy[rest], there.xy, there.shape, there.covariance, how)
            held = hold(there, good, points.key_shape[rest], points.drift[rest], templates, rest, after[1],
                        tracking.drift_correlation)  # fmt: skip
            if attempt == 2:  # far from where it was expected: the template must agree
                good &= ~held.renewed | (there.correlation >= RETAKEN_CORRELATION)
            why = np.where(best < tracking.min_correlation, TrackStatus.NOT_FOUND, TrackStatus.NOT_MATCHED)
            why = np.where(there.ok, TrackStatus.NOT_VERIFIED, why)
            renewed = held.renewed[:, None, None]
            key_drift = points.key_drift[rest] + np.where(renewed, held.drift, 0.0)
            result = _with(result, rest, good, points, there.xy + held.shift, held.key_shape, np.where(renewed, 0.0, held.drift),
                           key_drift, there.correlation, why)  # fmt: skip
            fresh.extend(rest[held.renewed & good])
    waiting = np.flatnonzero(~points.seen & (points.reason != TrackStatus.LEFT_IMAGE) & (points.since < tracking.wait_frames))
    if len(waiting):
        box = np.full(len(waiting), float(tracking.box_px))
        grey, tiles = atlas(templates.tiles.select(waiting))
        start, best = search_box(grey, after[0], tiles, points.xy[waiting], box, matching.patch_px, how.row_step)
        start = np.where((best >= tracking.min_correlation)[:, None], start, np.nan)
        key = templates.match(waiting, after[1], start, points.key_shape[waiting])
        good = key.ok & (key.correlation >= max(RETAKEN_CORRELATION, tracking.drift_correlation))
        result = _with(result, waiting, good, points, key.xy, key.shape, key.covariance, points.key_drift[waiting], key.correlation,
                       points.reason[waiting])  # fmt: skip
    return replace(result, since=np.where(result.seen, 0, points.since + 1)), np.array(fresh, dtype=np.int64)


def _returns(
    now: SplineImage,
    after: SplineImage,
    xy: np.ndarray,
    found: np.ndarray,
    shape: np.ndarray,
    covariance: np.ndarray,
    how: _How,
) -> np.ndarray:
    """Which points come back to where they were.  (1)"""
    inverse = np.linalg.inv(np.where(np.abs(np.linalg.det(shape)) > 0.05, 1.0, np.nan)[:, None, None] * shape)
    inverse = np.where(np.isfinite(inverse), inverse, np.eye(2))
    back = match_patches(after, found, [now], [xy], [inverse], how.matching, row_step=how.row_step, of_texture=False)[0]
    sigma = np.sqrt(np.maximum(np.trace(covariance + back.covariance, axis1=1, axis2=2), 0.0))
    return back.ok & (np.linalg.norm(back.xy - xy, axis=1) <= np.maximum(RETURN_PX, RETURN_SIGMAS * sigma))


def _with(
    result: _Points,
    rows: np.ndarray,
    good: np.ndarray,
    before: _Points,
    xy: np.ndarray,
    key_shape: np.ndarray,
    drift: np.ndarray,
    key_drift: np.ndarray,
    correlation: np.ndarray,
    why: np.ndarray,
) -> _Points:
    """The result with the good ones of `rows`; the others carry the reason."""
    at = rows[good]
    values = {n: getattr(result, n).copy() for n in ("xy", "key_shape", "drift", "key_drift", "correlation", "seen", "reason", "speed")}
    new = dict(xy=xy, key_shape=key_shape, drift=drift, key_drift=key_drift, correlation=correlation, speed=xy - before.xy[rows])
    for name, array in new.items():
        values[name][at] = array[good]
    values["speed"][at[~before.seen[at]]] = np.nan
    values["seen"][at] = True
    values["reason"][rows[~good]] = why[~good]
    return replace(result, **values)
