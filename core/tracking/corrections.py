"""The user's corrections of a take (take.toml, [[corrections]]), applied to clouds and trajectories.

A correction removes a trajectory that was clicked, or everything inside a polygon that was drawn over a view. Corrections are applied after
measuring and tracking, whose checkpoints stay valid: neither adding nor removing one needs new matching.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import cv2
import numpy as np

from ..foundation.progress import Monitor
from ..geometry.camera import Camera
from ..geometry.rig import Rig
from ..surface.cloud import PointCloud
from ..take.take import Correction
from .settings import TrackingSettings, TrackStatus
from .trajectories import Filtered, Trajectories, filter_trajectories, picked

SMALLEST_PX2 = 1.0  # of the image in a region
RIM_PX = 2.0  # of an image, in which nothing is measured: half of the smallest patch
CLICK_REACH_PX = 5.0  # distance from a click to the trajectory that it means


def inside_polygon(xy: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Which points (N, 2) lie inside a polygon (V, 2), by the even–odd rule; NaN lies outside."""
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(((xy >= polygon.min(axis=0)) & (xy <= polygon.max(axis=0))).all(axis=1))
    rows = rows[np.argsort(xy[rows, 1], kind="stable")]
    x, y = xy[rows].T
    inside = np.zeros(len(rows), dtype=bool)
    ends = np.roll(polygon, -1, axis=0)
    first, last = (np.searchsorted(y, edge(polygon[:, 1], ends[:, 1])) for edge in (np.minimum, np.maximum))
    for k in np.flatnonzero(last > first).tolist():  # the points beside each side
        (ax, ay), (bx, by), beside = polygon[k], ends[k], slice(first[k], last[k])
        inside[beside] ^= x[beside] < ax + (y[beside] - ay) * (bx - ax) / (by - ay)
    found = np.zeros(len(xy), dtype=bool)
    found[rows] = inside
    return found


def in_region(raw: Trajectories, camera: Camera, polygon: np.ndarray, frames: range) -> np.ndarray:
    """(T, N) the positions that project into a polygon (full-frame pixels) in these frames."""
    inside = np.zeros(raw.visible.shape, dtype=bool)
    for t in np.flatnonzero(np.isin(raw.frames, frames)):
        inside[t] = inside_polygon(camera.project(raw.xyz_m[t]), polygon)
    return inside


def clicked(filtered: Filtered, camera: Camera, xy: np.ndarray, frame: int) -> int | None:
    """The column of the raw trajectory whose projection is nearest to a pixel (2,) in a frame; None where none is near.

    A trajectory that passed the filters has precedence over one that was removed.
    """
    t = np.flatnonzero(filtered.raw.frames == frame)
    for candidates in (filtered.kept.xyz_m, filtered.raw.xyz_m) if len(t) else ():
        rows = np.flatnonzero(np.isfinite(candidates[t[0], :, 0]))
        away = np.linalg.norm(camera.project(candidates[t[0], rows]) - xy, axis=1)
        if len(rows) and away.min() <= CLICK_REACH_PX:
            at = rows[int(away.argmin())]
            return int(filtered.source[at]) if candidates is filtered.kept.xyz_m else int(at)
    return None


def without(filtered: Filtered, source: int) -> Filtered:
    """The trajectories without all pieces of that of a raw column."""
    verdict = filtered.raw.status.copy()
    verdict[filtered.raw.visible[:, source], source] = TrackStatus.REMOVED_BY_USER
    left = filtered.source != source
    return Filtered(kept=picked(filtered.kept, left), source=filtered.source[left], raw=replace(filtered.raw, status=verdict))


def corrected_cloud(cloud: PointCloud, corrections: Sequence[Correction], rig: Rig) -> PointCloud:
    """The cloud without the points inside the regions of its frame."""
    gone = in_regions(cloud.xyz_m, cloud.frame, corrections, rig)
    return cloud.select(~gone) if gone.any() else cloud


def in_regions(xyz_m: np.ndarray, frame: int, corrections: Sequence[Correction], rig: Rig) -> np.ndarray:
    """(N,) the points (N, 3) inside the regions of a frame."""
    inside = np.zeros(len(xyz_m), dtype=bool)
    for c in corrections:
        if c.kind == "region" and frame in c.frames:
            inside |= inside_polygon(rig[c.view].project(xyz_m), c.xy_px)
    return inside


def corrected_tracks(
    raw: Trajectories, corrections: Sequence[Correction], rig: Rig, settings: TrackingSettings, monitor: Monitor, rows: range | None = None
) -> tuple[Filtered, dict[int, int]]:
    """The filtered trajectories without those that the user removed, and the column of `raw` that each click hit, by number of correction.

    Clicks in frames outside the `rows` (None: all) hit nothing.
    """
    left_out = np.zeros(raw.visible.shape, dtype=bool)
    for c in corrections:
        if c.kind == "region":
            left_out |= in_region(raw, rig[c.view], c.xy_px, c.frames)
    filtered, hit = filter_trajectories(raw, settings, monitor, left_out), dict[int, int]()
    here = raw.frames[slice(rows.start, rows.stop) if rows else slice(None)]
    for number, c in enumerate(corrections):
        if c.kind == "trajectory" and c.frames.start in here:
            source = clicked(filtered, rig[c.view], c.xy_px[0], c.frames.start)
            if source is not None:
                filtered, hit[number] = without(filtered, source), source
    return filtered, hit


def odd_regions(corrections: Sequence[Correction], rig: Rig) -> list[str]:
    """A sentence for each region that has nothing of its view's image in it, or all of it; and for regions that have all of it together."""
    sentences = []
    regions = [c for c in corrections if c.kind == "region"]
    for view in dict.fromkeys(c.view for c in regions):
        camera, parts = rig[view], list[tuple[Correction, np.ndarray]]()
        for c in (c for c in regions if c.view == view):
            place, inside = f"The corrected region at ({c.xy_px[0][0]:g}, {c.xy_px[0][1]:g}) of view {view}", _enclosed(camera, c.xy_px)
            if _enclosed_px2(c.xy_px, camera) < SMALLEST_PX2:
                sentences.append(f"{place} encloses nothing of the image; draw it again or remove it.")
            elif inside.all():
                where = _named(c.frames)
                sentences.append(f"{place} encloses the whole image, so that no points remain in {where}; draw it again or remove it.")
            else:
                parts.append((c, inside))
        if (frames := _covered(parts)) is not None:
            together = f"The corrected regions of view {view} together enclose the whole image"
            sentences.append(f"{together}, so that no points remain in {_named(frames)}; draw them again or remove some.")
    return sentences


def _named(frames: range) -> str:
    return f"frame {frames[0]}" if len(frames) == 1 else f"frames {frames[0]} to {frames[-1]}"


def _covered(parts: Sequence[tuple[Correction, np.ndarray]]) -> range | None:
    """The first frames in which regions, with the places (N,) of an image inside each, have all of these together; None without any."""
    changes = sorted(
        [(c.frames.start, 1, inside) for c, inside in parts] + [(c.frames.stop, -1, inside) for c, inside in parts], key=_first
    )
    count = np.zeros(len(parts[0][1]) if parts else 0, dtype=int)
    for n, (frame, sign, inside) in enumerate(changes[:-1]):
        count += sign * inside
        if changes[n + 1][0] > frame and (count > 0).all():
            return range(frame, changes[n + 1][0])
    return None


def _first(change: tuple[int, int, np.ndarray]) -> int:
    return change[0]


def _enclosed(camera: Camera, polygon: np.ndarray) -> np.ndarray:
    """Which of the places (N,) all over an image, as far as points are measured, are inside a polygon (V, 2)."""
    x, y = (np.linspace(min(RIM_PX, (size - 1) / 2), max(size - 1 - RIM_PX, (size - 1) / 2), 40) for size in camera.size_px)
    return inside_polygon(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), polygon)


def _enclosed_px2(polygon: np.ndarray, camera: Camera) -> float:
    """The area of the image within the convex hull of a polygon (V, 2)."""
    w, h = camera.size_px
    image = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    hull = cv2.convexHull(polygon.astype(np.float32))[:, 0]
    return float(cv2.intersectConvexConvex(hull, image)[0]) if len(hull) > 2 else 0.0


def missed_clicks(corrections: Sequence[Correction], hit: Collection[int]) -> list[str]:
    """A sentence for each correction by a click whose number is not among those that hit a trajectory."""
    missed = [c for number, c in enumerate(corrections) if c.kind == "trajectory" and number not in hit]
    where = [f"({c.xy_px[0][0]:g}, {c.xy_px[0][1]:g}) of view {c.view} in frame {c.frames.start}" for c in missed]
    return [f"There is no trajectory near the correction at {place}; click it again or remove it." for place in where]
