"""What each overlay shows in one frame and view, as arrays in image pixels; drawn by draw.py. No Blender in here."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...core.inspection import TrackHistory, patch_boxes
from ...core.surface.cloud import FILTERS
from ...core.tracking.settings import TrackStatus

if TYPE_CHECKING:
    from .recording import Recording

ALL = "ALL"  # filters
KEPT, REMOVED = np.array([0.25, 0.75, 1.0]), np.array([1.0, 0.3, 0.25])
RAMP = np.array([[0.15, 0.35, 1.0], [0.1, 0.85, 0.9], [0.35, 0.95, 0.3], [1.0, 0.85, 0.15], [1.0, 0.2, 0.15]])
COMMON = 0.95  # of the points are below the end of the ramp
REACH_PX = 12.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Sigmas:
    """Points coloured by sigma."""

    xy_px: np.ndarray  # (N, 2)
    colours: np.ndarray  # (N, 4)
    most_mm: float  # what is painted red


@dataclass(frozen=True, eq=False, kw_only=True)
class Looked:
    """What lies nearest to the pointer: words, and the outlines of its patch in every view."""

    words: tuple[str, ...]
    xy_px: dict[str, np.ndarray]  # by view
    start: dict[str, np.ndarray]  # (4, 2)
    found: dict[str, np.ndarray]  # (4, 2)


def ramp(value: np.ndarray) -> np.ndarray:
    """Colours (N, 4) of 0 (blue) to 1 (red)."""
    at = np.clip(np.nan_to_num(value), 0.0, 1.0) * (len(RAMP) - 1)
    low = np.minimum(at.astype(int), len(RAMP) - 2)
    share = (at - low)[:, None]
    return np.concatenate([RAMP[low] * (1 - share) + RAMP[low + 1] * share, np.ones((len(at), 1))], axis=1)


def sigmas(recording: "Recording", view: str, frame: int, most_mm: float) -> Sigmas | None:
    """The matched points of a frame in a view."""
    points = recording.points(frame)
    if points is None or not len(points.xyz_m):
        return None
    sigma = 1e3 * points.sigma_m
    most = most_mm if most_mm > 0 else max(float(np.quantile(sigma, COMMON)), 1e-6)
    xy = points.xy_px[:, list(recording.cameras).index(view)]
    seen = np.isfinite(xy).all(axis=1)
    return Sigmas(xy_px=xy[seen], colours=ramp(sigma[seen] / most), most_mm=most)


def removed_points(recording: "Recording", view: str, frame: int, by: str = ALL) -> tuple[np.ndarray, list[tuple[str, int]]]:
    """Where (M, 2) a view saw the points that a filter of the surface, or any, took out of a frame, and how many each filter did."""
    xy, why = recording.removed(frame)
    mine = np.isin(why, np.arange(1, len(FILTERS) + 1)) if by == ALL else why == int(by)
    if not mine.any():
        return np.zeros((0, 2)), []
    seen = xy[mine, list(recording.cameras).index(view)]
    counts = [(words, int((why[mine] == n).sum())) for n, words in enumerate(FILTERS, 1)]
    return seen[np.isfinite(seen).all(axis=1)], [(words, count) for words, count in counts if count]


def tails(recording: "Recording", view: str, frame: int, length: int, which: str, by: str = ALL) -> tuple[np.ndarray, np.ndarray]:
    """Segments (M, 2, 2) of the trajectories and their colours (M, 4); the older the paler. `by`: as if there were only that filter."""
    history = recording.tracks()
    if history is None:
        return np.zeros((0, 2, 2)), np.zeros((0, 4))
    camera, parts = recording.cameras[view], []
    removed = history.removed if by == ALL else history.removed & (history.status == TrackStatus[by])
    if which in ("before", "kept", "both"):
        wanted = history.kept | removed if which == "before" else history.kept
        parts.append((history.tails(camera, frame, length, wanted), KEPT))
    if which in ("removed", "both"):
        parts.append((history.tails(camera, frame, length, removed), REMOVED))
    colours = [np.concatenate([np.broadcast_to(c, (len(age), 3)), (1 - 0.85 * age)[:, None]], axis=1) for (_, _, age), c in parts]
    return np.concatenate([segments for (segments, _, _), _ in parts]), np.concatenate(colours)


def removed_here(history: TrackHistory, frame: int, by: str = ALL) -> list[tuple[str, int]]:
    """Why positions of a frame were taken out, and how many of each, the most frequent first."""
    now = np.flatnonzero(history.frames == frame)
    if not len(now):
        return []
    status = history.status[now[0]][history.removed[now[0]]]
    status = status if by == ALL else status[status == TrackStatus[by]]
    reasons, counts = np.unique(status, return_counts=True)
    return [(TrackStatus(int(reasons[i])).words, int(counts[i])) for i in np.argsort(-counts)]


def curve(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Heights 0…1 of a graph's curve (T,), NaN where unknown, and the usual value, which lies at half height."""
    known = values[np.isfinite(values)]
    usual = float(np.median(known)) if len(known) else 0.0
    return np.clip(values / (2 * usual), 0.0, 1.0) if usual > 0 else np.where(np.isfinite(values), 0.5, np.nan), usual


def look(recording: "Recording", view: str, frame: int, xy_px: np.ndarray, reach_px: float = REACH_PX) -> Looked | None:
    """The matched point and the trajectory nearest to a pixel, within reach."""
    row = nearest_point(recording, view, frame, xy_px, reach_px)
    track = nearest_track(recording, view, frame, xy_px, reach_px)
    words: list[str] = []
    places: dict[str, np.ndarray] = {}
    start: dict[str, np.ndarray] = {}
    found: dict[str, np.ndarray] = {}
    views = list(recording.cameras)
    points = recording.points(frame)
    if row is not None and points is not None:
        words.append(f"point: sigma {1e3 * points.sigma_m[row]:.2f} mm")
        places = dict(zip(views, points.xy_px[row]))
        if np.isfinite(points.residual_px[row]):
            words.append(f"rays miss by {points.residual_px[row]:.2f} px, correlation {points.correlation[row]:.2f}")
            begun, end = patch_boxes(
                points, row, list(recording.cameras.values()), recording.reference, recording.rows_at(frame), recording.patch_px
            )
            start, found = dict(zip(views, begun)), dict(zip(views, end))
        else:
            words.append("its patches are not known: the cache was deleted, run again to see them")
    if track is not None:
        number, status = track
        kept = status == TrackStatus.MEASURED
        words.append(f"trajectory {number}: kept" if kept else f"trajectory {number}: removed here ({TrackStatus(status).words})")
    return Looked(words=tuple(words), xy_px=places, start=start, found=found) if words else None


def nearest_point(recording: "Recording", view: str, frame: int, xy_px: np.ndarray, reach_px: float) -> int | None:
    """Row of the matched point nearest to a pixel, None where none is within reach."""
    points = recording.points(frame)
    if points is None:
        return None
    away = np.linalg.norm(points.xy_px[:, list(recording.cameras).index(view)] - xy_px, axis=1)
    return _nearest(away, reach_px)


def nearest_track(recording: "Recording", view: str, frame: int, xy_px: np.ndarray, reach_px: float) -> tuple[int, int] | None:
    """Number and TrackStatus of the trajectory nearest to a pixel, kept ones first; None where none is within reach."""
    history = recording.tracks()
    if history is None:
        return None
    xy, status = history.at(recording.cameras[view], frame)
    away = np.linalg.norm(xy - xy_px, axis=1)
    for mine in (status == TrackStatus.MEASURED, np.ones(len(status), dtype=bool)):
        number = _nearest(np.where(mine, away, np.inf), reach_px)
        if number is not None:
            return number, int(status[number])
    return None


def track_place(recording: "Recording", view: str, frame: int, xy_px: np.ndarray, reach_px: float) -> np.ndarray | None:
    """Where (2,) the view sees the trajectory nearest to a pixel; None where none is within reach."""
    found, history = nearest_track(recording, view, frame, xy_px, reach_px), recording.tracks()
    return history.at(recording.cameras[view], frame)[0][found[0]] if found is not None and history is not None else None


def _nearest(away: np.ndarray, reach: float) -> int | None:
    if not len(away) or not np.isfinite(away).any():
        return None
    row = int(np.nanargmin(away))
    return row if away[row] <= reach else None
