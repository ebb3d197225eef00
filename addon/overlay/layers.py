"""The data of each overlay in one frame and view, as arrays in image pixels; draw.py draws them. No bpy here."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...core.geometry.robust import finite_median
from ...core.surface.cloud import FILTERS
from ...core.tracking.settings import TrackStatus

if TYPE_CHECKING:
    from ...core.run.inspection import TrackHistory
    from .results import RunResults

ALL = "ALL"  # every filter
KEPT, REMOVED = np.array([0.25, 0.75, 1.0]), np.array([1.0, 0.3, 0.25])
HEAT_COLOURS = np.array([[0.15, 0.35, 1.0], [0.1, 0.85, 0.9], [0.35, 0.95, 0.3], [1.0, 0.85, 0.15], [1.0, 0.2, 0.15]])
RED_QUANTILE = 0.95  # of the points' sigmas: what is painted red unless the user chose a sigma
FADE = 0.85  # of opacity, from the newest to the oldest segment of a trajectory
REACH_PX = 12.0  # how far from the pointer things are found


@dataclass(frozen=True, eq=False, kw_only=True)
class ColouredPoints:
    """Points coloured by sigma."""

    xy_px: np.ndarray  # (N, 2)
    colours: np.ndarray  # (N, 4)
    red_mm: float  # the sigma that is painted red


@dataclass(frozen=True, eq=False, kw_only=True)
class Inspection:
    """The point and the trajectory nearest to the pointer, in words, and the corners of the point's patch in every view."""

    lines: tuple[str, ...]
    xy_px: dict[str, np.ndarray]  # by view
    start_boxes: dict[str, np.ndarray]  # (4, 2) by view
    matched_boxes: dict[str, np.ndarray]  # (4, 2) by view


@dataclass(frozen=True, eq=False, kw_only=True)
class Pulled:
    """A joint that is being dragged in a frame, and what moves with it, by view: bones (K, 2, 2), the outline of their skin (N, 2, 2), and
    the joint (2, 2) where it was fitted and where it is now."""

    name: str
    frame: int
    bones_px: dict[str, np.ndarray]
    outline_px: dict[str, np.ndarray]
    joint_px: dict[str, np.ndarray]


def heat_colours(value: np.ndarray) -> np.ndarray:
    """Colours (N, 4) of 0 (blue) to 1 (red)."""
    at = np.clip(np.nan_to_num(value), 0.0, 1.0) * (len(HEAT_COLOURS) - 1)
    low = np.minimum(at.astype(int), len(HEAT_COLOURS) - 2)
    share = (at - low)[:, None]
    return np.concatenate([HEAT_COLOURS[low] * (1 - share) + HEAT_COLOURS[low + 1] * share, np.ones((len(at), 1))], axis=1)


def coloured_points(run: "RunResults", view: str, frame: int, red_mm: float) -> ColouredPoints | None:
    """The matched points of a frame in a view."""
    points = run.points(frame)
    if points is None or not len(points.xyz_m):
        return None
    sigma = 1e3 * points.sigma_m
    most = red_mm if red_mm > 0 else max(float(np.quantile(sigma, RED_QUANTILE)), 1e-6)
    xy = points.xy_px[:, list(run.cameras).index(view)]
    visible = np.isfinite(xy).all(axis=1)
    return ColouredPoints(xy_px=xy[visible], colours=heat_colours(sigma[visible] / most), red_mm=most)


def removed_points(run: "RunResults", view: str, frame: int, by: str = ALL) -> tuple[np.ndarray, list[tuple[str, int]]]:
    """Pixels (M, 2) in a view of the points that a surface filter, or any, removed from a frame, and how many each filter removed."""
    xy, why = run.removed(frame)
    mine = np.isin(why, np.arange(1, len(FILTERS) + 1)) if by == ALL else why == int(by)
    if not mine.any():
        return np.zeros((0, 2)), []
    visible = xy[mine, list(run.cameras).index(view)]
    counts = [(words, int((why[mine] == n).sum())) for n, words in enumerate(FILTERS, 1)]
    return visible[np.isfinite(visible).all(axis=1)], [(words, count) for words, count in counts if count]


def tails(run: "RunResults", view: str, frame: int, length: int, which: str, by: str = ALL) -> tuple[np.ndarray, np.ndarray]:
    """Segments (M, 2, 2) of the trajectories and their colours (M, 4), fading with age. `by`: as if there were only that filter."""
    history = run.tracks()
    if history is None:
        return np.zeros((0, 2, 2)), np.zeros((0, 4))
    camera, parts = run.cameras[view], []
    removed = history.removed if by == ALL else history.removed & (history.status == TrackStatus[by])
    if which in ("before", "kept", "both"):
        wanted = history.kept | removed if which == "before" else history.kept
        parts.append((history.tails(camera, frame, length, wanted), KEPT))
    if which in ("removed", "both"):
        parts.append((history.tails(camera, frame, length, removed), REMOVED))
    colours = [np.concatenate([np.broadcast_to(c, (len(age), 3)), (1 - FADE * age)[:, None]], axis=1) for (_, _, age), c in parts]
    return np.concatenate([segments for (segments, _, _), _ in parts]), np.concatenate(colours)


def chosen_paths(run: "RunResults", view: str, frame: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Segments (M, 2, 2) of the paths of single points up to a frame, their colours (M, 4), and the points' pixels in it by name."""
    table = run.chosen()
    if table is None or view not in table.views:
        return np.zeros((0, 2, 2)), np.zeros((0, 4)), {}
    rows = np.flatnonzero(table.frames <= frame)
    xy = table.xy_px[rows, :, table.views.index(view)]
    steps = np.stack([xy[:-1], xy[1:]], axis=2)  # (T − 1, N, 2, 2)
    known = np.isfinite(steps).all(axis=(2, 3)) & (np.diff(table.frames[rows]) == 1)[:, None]
    tints = heat_colours((np.arange(len(table.names)) + 0.5) / max(len(table.names), 1))
    now = xy[-1] if len(rows) and table.frames[rows[-1]] == frame else np.full((len(table.names), 2), np.nan)
    at = {name: place for name, place in zip(table.names, now) if np.isfinite(place).all()}
    return steps[known], np.broadcast_to(tints, (*known.shape, 4))[known], at


def removal_counts(history: "TrackHistory", frame: int, by: str = ALL) -> list[tuple[str, int]]:
    """Why positions were removed from a frame, and how many for each reason, the most frequent first."""
    now = np.flatnonzero(history.frames == frame)
    if not len(now):
        return []
    status = history.status[now[0]][history.removed[now[0]]]
    status = status if by == ALL else status[status == TrackStatus[by]]
    reasons, counts = np.unique(status, return_counts=True)
    return [(TrackStatus(int(reasons[i])).words, int(counts[i])) for i in np.argsort(-counts)]


def graph_curve(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Heights 0…1 of a graph's curve (T,), NaN where unknown, and the median, which lies at half height."""
    usual = finite_median(values, 0.0)
    return np.clip(values / (2 * usual), 0.0, 1.0) if usual > 0 else np.where(np.isfinite(values), 0.5, np.nan), usual


def inspect(run: "RunResults", view: str, frame: int, xy_px: np.ndarray, reach_px: float = REACH_PX) -> Inspection | None:
    """The matched point and the trajectory nearest to a pixel, within reach."""
    row = nearest_point(run, view, frame, xy_px, reach_px)
    track = nearest_track(run, view, frame, xy_px, reach_px)
    lines: list[str] = []
    places: dict[str, np.ndarray] = {}
    start: dict[str, np.ndarray] = {}
    matched: dict[str, np.ndarray] = {}
    views = list(run.cameras)
    points = run.points(frame)
    if row is not None and points is not None:
        lines.append(f"point: sigma {1e3 * points.sigma_m[row]:.2f} mm")
        places = dict(zip(views, points.xy_px[row]))
        if np.isfinite(points.residual_px[row]):
            lines.append(f"residual {points.residual_px[row]:.2f} px, correlation {points.correlation[row]:.2f}")
            from ...core.run.inspection import patch_boxes

            start_boxes, matched_boxes = patch_boxes(
                points, row, list(run.cameras.values()), run.reference, run.rows_at(frame), run.patch_px
            )
            start, matched = dict(zip(views, start_boxes)), dict(zip(views, matched_boxes))
        else:
            lines.append("no patches to show: the cache was deleted; run again to see them")
    if track is not None:
        number, status = track
        kept = status == TrackStatus.MEASURED
        lines.append(f"trajectory {number}: kept" if kept else f"trajectory {number}: removed here ({TrackStatus(status).words})")
    return Inspection(lines=tuple(lines), xy_px=places, start_boxes=start, matched_boxes=matched) if lines else None


def nearest_point(run: "RunResults", view: str, frame: int, xy_px: np.ndarray, reach_px: float) -> int | None:
    """Row of the matched point nearest to a pixel, None where none is within reach."""
    points = run.points(frame)
    if points is None:
        return None
    away = np.linalg.norm(points.xy_px[:, list(run.cameras).index(view)] - xy_px, axis=1)
    return _nearest(away, reach_px)


def nearest_track(run: "RunResults", view: str, frame: int, xy_px: np.ndarray, reach_px: float) -> tuple[int, int] | None:
    """Number and TrackStatus of the trajectory nearest to a pixel, kept ones first; None where none is within reach."""
    history = run.tracks()
    if history is None:
        return None
    xy, status = history.at(run.cameras[view], frame)
    away = np.linalg.norm(xy - xy_px, axis=1)
    for mine in (status == TrackStatus.MEASURED, np.ones(len(status), dtype=bool)):
        number = _nearest(np.where(mine, away, np.inf), reach_px)
        if number is not None:
            return number, int(status[number])
    return None


def track_place(run: "RunResults", view: str, frame: int, xy_px: np.ndarray, reach_px: float) -> np.ndarray | None:
    """Pixel (2,) in a view of the trajectory nearest to a pixel; None where none is within reach."""
    found, history = nearest_track(run, view, frame, xy_px, reach_px), run.tracks()
    return history.at(run.cameras[view], frame)[0][found[0]] if found is not None and history is not None else None


def _nearest(away: np.ndarray, reach: float) -> int | None:
    if not len(away) or not np.isfinite(away).any():
        return None
    row = int(np.nanargmin(away))
    return row if away[row] <= reach else None
