"""Tables of points that the user chose, and of their tracks (CSV)."""

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..foundation import bounded, store
from ..foundation.arrays import check_sparse
from ..foundation.errors import InputError, damage_of, shown
from ..foundation.settings import nearest_name
from ..geometry.camera import Camera
from ..images.interlace import frame_time_s
from .key_points import KeyPoints
from .planar import PlanarTracks
from .settings import TrackStatus

MOST_CORNERS = 1000  # of a polygon, as in take.toml
FARTHEST_PX = 1e6  # of a corner, as in take.toml
SMALLEST_PX2 = 1.0  # area of a polygon
MOST_POINTS = 10_000  # that are followed at once: their patches are in memory together
MOST_VERTICES = 4000  # of the outline that starts from a polygon: its fit needs memory by their square
MAX_COMPARED = 1000  # names among which the nearest to a misspelt one is searched


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ChosenPoints:
    """Points by name. In a table of one camera each of `views` is ""; `joined` lists pairs of names to be joined by lines."""

    names: tuple[str, ...]  # (N,)
    views: tuple[str, ...]  # (N,)
    xy_px: np.ndarray  # (N, 2)
    joined: tuple[tuple[str, str], ...]


def read_points(path: Path, *, with_views: bool = False) -> ChosenPoints:
    """Read a CSV with the columns point, x, y, with `with_views` also view, and optionally joined_to (the name of another point).

    Raises:
        InputError: the file cannot be read, lacks a column, or has an invalid row.
    """
    needed = ("point", "x", "y", *(("view",) if with_views else ()))
    try:
        rows = list(csv.DictReader(io.StringIO(bounded.text_of(path, bounded.TABLE_BYTES))))
    except OSError as error:
        raise InputError(f"Cannot read the points {path}: {error.strerror or error}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} is not a CSV table ({damage_of(error)}); save it as CSV in UTF-8.") from error
    if not rows:
        raise InputError(f"{path} has no points; write a line {','.join(needed)} and one line for each point.")
    if len(rows) > MOST_POINTS:
        raise InputError(f"{path} has {len(rows)} points; {MOST_POINTS} is the most that are followed at once.")
    for name in needed:
        if name not in rows[0]:
            hint = "separate them by commas, not semicolons" if ";" in str(next(iter(rows[0]))) else "its first line must name them"
            raise InputError(f"{path} has no column “{name}”; the columns are {', '.join(needed)}: {hint}.")
    xy = np.array([[_number(row[axis], path, number + 2, axis) for axis in "xy"] for number, row in enumerate(rows)])
    names = tuple((row["point"] or "").strip() for row in rows)
    views = tuple((row["view"] or "").strip() if with_views else "" for row in rows)
    if "" in names or len(set(zip(names, views))) < len(names):
        raise InputError(f"{path} names a point twice or not at all; give every point its own name.")
    joined = tuple((n, row["joined_to"].strip()) for n, row in zip(names, rows) if (row.get("joined_to") or "").strip())
    known = set(names)
    for name, other in joined:
        if other not in known:
            raise InputError(f"{path} joins “{name}” to “{other}”, which is no point of it.{nearest_name(other, names[:MAX_COMPARED])}")
    return ChosenPoints(names=names, views=views, xy_px=xy, joined=joined)


def _number(text: str | None, path: Path, line: int, column: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"Line {line} of {path} has {column} = {shown(text)}; write a pixel coordinate, with a point for decimals.")
    return value


PLANAR_HEAD = "frame,point,x,y,sigma,correlation,status"
SPACE_HEAD, IMAGES_HEAD = "frame,time_s,point,x,y,z,sigma,status", "frame,view,point,x,y"


def write_planar(path: Path, names: tuple[str, ...], tracks: PlanarTracks) -> None:
    """CSV of frame, point, x, y, sigma, correlation, status; a point that is not visible has empty cells, and the reason as its status.

    Raises:
        InputError: the file cannot be written.
    """
    lines = [PLANAR_HEAD]
    for t, frame in enumerate(tracks.frames):
        for n, name in enumerate(names):
            numbers = (*tracks.xy_px[t, n], tracks.sigma_px[t, n], tracks.correlation[t, n])
            cells = [f"{v:.4f}" if np.isfinite(v) else "" for v in numbers]
            lines.append(",".join([str(frame), _quoted(name), *cells, TrackStatus(int(tracks.status[t, n])).name.lower()]))
    store.write_text(Path(path), "\n".join(lines) + "\n")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlanarTable:
    """The table of `write_planar`: N points over T frames; NaN where a point is not visible."""

    frames: np.ndarray  # (T,) ascending
    names: tuple[str, ...]  # (N,)
    xy_px: np.ndarray  # (T, N, 2)


def read_planar(path: Path) -> PlanarTable:
    """Read the table of `write_planar`.

    Raises:
        InputError: it cannot be read, or is another kind of table.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(bounded.text_of(path, bounded.TABLE_BYTES))))
        places = {(int(np.int32(int(r["frame"]))), r["point"]): (float(r["x"] or "nan"), float(r["y"] or "nan")) for r in rows}
    except OSError as error:
        raise InputError(f"Cannot read the tracks {path}: {error.strerror or error}.") from error
    except (UnicodeDecodeError, csv.Error, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} is not a table of 2-D tracks ({damage_of(error)}); choose a file written by `tricap track2d`.") from error
    if not places:
        raise InputError(f"{path} has no tracks; choose a file written by `tricap track2d`.")
    frames, names = sorted({frame for frame, _ in places}), tuple(dict.fromkeys(name for _, name in places))
    check_sparse(len(places), len(frames), len(names), path)
    xy = np.array([[places.get((frame, name), (np.nan, np.nan)) for name in names] for frame in frames])
    return PlanarTable(frames=np.array(frames), names=names, xy_px=np.where(np.isfinite(xy).all(axis=2, keepdims=True), xy, np.nan))


def write_key_points(space: Path, images: Path, names: tuple[str, ...], views: tuple[str, ...], fps: float, points: KeyPoints) -> None:
    """Two CSVs: frame, time_s, point, x, y, z, sigma, status (metres, world); and frame, view, point, x, y (full-frame pixels).

    A point that is not visible has empty cells, and the reason as its status. In a view that does not show it, it has no row.

    Raises:
        InputError: a file cannot be written.
    """
    lines, pixels = [SPACE_HEAD], [IMAGES_HEAD]
    for t, frame in enumerate(points.frames):
        for n, name in enumerate(map(_quoted, names)):
            cells = [f"{v:.6f}" if np.isfinite(v) else "" for v in (*points.xyz_m[t, n], points.sigma_m[t, n])]
            status = TrackStatus(int(points.status[t, n])).name.lower()
            lines.append(",".join([str(frame), f"{frame_time_s(frame, fps):.6f}", name, *cells, status]))
            shown = [(view, *xy) for view, xy in zip(views, points.xy_px[t, n]) if np.isfinite(xy).all()]
            pixels.extend(f"{frame},{_quoted(view)},{name},{x:.4f},{y:.4f}" for view, x, y in shown)
    for path, text in ((space, lines), (images, pixels)):
        store.write_text(path, "\n".join(text) + "\n")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class KeyPointTable:
    """The tables of `write_key_points`: N points over T frames and K views; NaN where a point is not visible."""

    frames: np.ndarray  # (T,) ascending
    names: tuple[str, ...]  # (N,)
    views: tuple[str, ...]  # (K,)
    xyz_m: np.ndarray  # (T, N, 3)
    sigma_m: np.ndarray  # (T, N)
    xy_px: np.ndarray  # (T, N, K, 2)


def read_key_points(space: Path, images: Path) -> KeyPointTable:
    """Read the tables of `write_key_points`.

    Raises:
        InputError: one cannot be read, or is another kind of table.
    """
    try:
        rows, pixels = (list(csv.DictReader(io.StringIO(bounded.text_of(path, bounded.TABLE_BYTES)))) for path in (space, images))
        places = {(_frame(r), r["point"]): [float(r[c] or "nan") for c in ("x", "y", "z", "sigma")] for r in rows}
        seen = {(_frame(r), r["point"], r["view"]): [float(r[c]) for c in "xy"] for r in pixels}
    except OSError as error:
        raise InputError(f"Cannot read the points {error.filename}: {error.strerror or error}.") from error
    except (UnicodeDecodeError, csv.Error, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{space} and {images.name} are not tables of followed points ({damage_of(error)}); follow the points again."
        ) from error
    if not places:
        raise InputError(f"{space} has no points; follow the points again.")
    frames, names = sorted({frame for frame, _ in places}), tuple(dict.fromkeys(name for _, name in places))
    views = tuple(dict.fromkeys(view for *_, view in seen))
    check_sparse(len(places), len(frames), len(names), space)
    check_sparse(max(1, len(seen)), len(frames), max(1, len(names) * len(views)), images)
    xyzs = np.array([[places.get((frame, name), [np.nan] * 4) for name in names] for frame in frames])
    xyzs = np.where(np.isfinite(xyzs[..., :3]).all(axis=2, keepdims=True), xyzs, np.nan)
    xy = [[[seen.get((frame, name, view), [np.nan] * 2) for view in views] for name in names] for frame in frames]
    at = np.array(xy).reshape(len(frames), len(names), len(views), 2)
    return KeyPointTable(frames=np.array(frames), names=names, views=views, xyz_m=xyzs[..., :3], sigma_m=xyzs[..., 3], xy_px=at)


def _frame(row: dict[str, str]) -> int:
    return int(np.int32(int(row["frame"])))


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if any(c in name for c in ',"\n') else name


def read_polygon(path: Path) -> np.ndarray:
    """Vertices (V, 2) of a CSV with the columns x, y.

    Raises:
        InputError: the file cannot be read, has fewer than three different vertices or very many, encloses nothing, or crosses itself.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(bounded.text_of(path, bounded.TABLE_BYTES))))
    except OSError as error:
        raise InputError(f"Cannot read the polygon {path}: {error.strerror or error}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} is not a CSV table ({damage_of(error)}); save it as CSV in UTF-8.") from error
    if len(rows) < 3 or not {"x", "y"} <= set(rows[0]):
        raise InputError(f"{path} is not a polygon; write a line x,y and three or more lines of pixel coordinates.")
    if len(rows) > MOST_CORNERS:
        raise InputError(f"{path} has {len(rows)} corners; {MOST_CORNERS} is the most. `tricap contour` finds the outline between them.")
    xy = np.array([[_number(row[axis], path, number + 2, axis) for axis in "xy"] for number, row in enumerate(rows)])
    if (np.abs(xy) > FARTHEST_PX).any():
        raise InputError(f"{path} has corners beyond {FARTHEST_PX:g} pixels; write pixels of the image.")
    if len(np.unique(xy, axis=0)) < 3 or _enclosed(xy) < SMALLEST_PX2:
        raise InputError(f"{path} encloses less than a pixel; write three or more corners around the person.")
    if (crossing := _crossing_sides(xy)) is not None:
        i, j = crossing
        raise InputError(f"The sides of {path} after corners {i + 1} and {j + 1} cross; write the corners in order around the person.")
    return xy


def check_polygon(polygon_px: np.ndarray, camera: Camera, spacing_px: float, path: Path) -> None:
    """Check that a polygon (V, 2) from a file can be the outline of a person in the image of a camera.

    Raises:
        InputError: it lies outside of the image, reaches far beyond it, or is too long for vertices at this spacing.
    """
    size = np.array(camera.size_px)
    if not camera.sees(polygon_px).any():
        raise InputError(f"The polygon {path} lies outside the image of view {camera.name}; write its pixels in the first frame.")
    if (polygon_px < -size).any() or (polygon_px > 2 * size).any():
        raise InputError(
            f"The polygon {path} reaches further beyond the image of view {camera.name} than that is large "
            f"({size[0]}×{size[1]} px); correct it."
        )
    length = float(np.linalg.norm(polygon_px - np.roll(polygon_px, 1, axis=0), axis=1).sum())
    if length > MOST_VERTICES * spacing_px:
        raise InputError(
            f"The polygon {path} is {length:.0f} px long, and {MOST_VERTICES * spacing_px:.0f} px is the most at contour.spacing_px = "
            f"{spacing_px:g}; draw it once around the person, or with a larger spacing."
        )


def _crossing_sides(polygon_px: np.ndarray) -> tuple[int, int] | None:
    """The first two sides of a closed polygon (V, 2) that cross in their insides, by the corners at which they begin."""
    start, along = polygon_px, np.roll(polygon_px, -1, axis=0) - polygon_px
    for i in range(len(start) - 2):
        others, ahead = start[i + 2 :] - start[i], along[i + 2 :]
        turned = along[i, 0] * ahead[:, 1] - along[i, 1] * ahead[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            here = (others[:, 0] * ahead[:, 1] - others[:, 1] * ahead[:, 0]) / turned
            there = (others[:, 0] * along[i, 1] - others[:, 1] * along[i, 0]) / turned
        crossed = np.flatnonzero((here > 0) & (here < 1) & (there > 0) & (there < 1))
        if len(crossed):
            return i, i + 2 + int(crossed[0])
    return None


def _enclosed(polygon_px: np.ndarray) -> float:
    """The area (px²) of the convex hull of a polygon (V, 2)."""
    hull = cv2.convexHull(polygon_px.astype(np.float32))
    return float(cv2.contourArea(hull))
