"""`tricap track2d`: the 2-D mode. Points chosen in the first frame of one camera are tracked through its images."""

import argparse
from pathlib import Path

import numpy as np

from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.settings import from_table
from ..images.interlace import row_grid
from ..images.sequence import IMAGE_ENDINGS, ImageSequence, open_sequence
from ..matching.least_squares import MatchingSettings
from ..report.pictures import png
from ..report.point_pictures import paths_over_footage
from ..results.listed_files import PICTURES, check_files, list_files
from ..results.outputs import check_replaceable
from ..run.settings import Overrides
from ..tracking.planar import PlanarTracks, track_planar
from ..tracking.point_tables import PLANAR_HEAD, ChosenPoints, read_points, write_planar
from ..tracking.settings import TrackingSettings, TrackStatus
from .arguments import check_not_read, frame_range, overrides

ENDING = ".csv"
MIN_CORRELATION = 0.7  # default of matching.min_correlation here: faces have weak texture and deform
MAX_SIGMA_PX = 0.4  # default of matching.max_sigma_px here, for the same reason
WAIT_FRAMES = 100  # default of tracking.wait_frames here: a lost point is searched for only at its last place


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Track and write; the lines to show.

    Raises:
        InputError: the arguments, the points or the footage have an error.
    """
    tables = overrides(args.set)
    if set(tables) - {"matching", "tracking"}:
        raise InputError("--set of track2d accepts settings of the groups matching and tracking only.")
    matching, tracking = settings_of_2d(tables)
    points, sequence = read_points(args.points), open_footage(args.sequence)
    check_not_read("--out", args.out, args.points, args.sequence)
    if args.out.suffix.lower() != ENDING:
        raise InputError(f"--out {args.out} is not the name of a table; let it end in {ENDING}.")
    check_replaceable(args.out, PLANAR_HEAD)
    if args.pictures is not None:
        check_not_read("--pictures", args.pictures, *{path.parent for path in sequence.files()[:1]})
        check_files(args.pictures, PICTURES)
    frames = range(*(frame_range(args.frames) or (0, sequence.count)))
    if not frames or frames[0] < 0 or frames[-1] >= sequence.count:
        raise InputError(f"--frames {args.frames} are not among the frames 0 to {sequence.count - 1} of {args.sequence}.")
    _check_inside(points, sequence.read(frames[0]), args.points)
    tracks = track_planar(sequence.read, frames, points.xy_px, matching, tracking, monitor, row_grid(args.interlaced))
    write_planar(args.out, points.names, tracks)
    if args.pictures is not None:
        _draw(args.pictures, sequence, points, tracks, monitor)
    whole = int((tracks.status == TrackStatus.MEASURED).all(axis=0).sum())
    return [f"{args.out}: {len(points.names)} points over {len(frames)} frames, {whole} of them visible in every frame."]


def settings_of_2d(tables: Overrides) -> tuple[MatchingSettings, TrackingSettings]:
    """The settings of the 2-D mode, with its own defaults.

    Raises:
        InputError: an unknown name, or a value that cannot be.
    """
    own = {"min_correlation": MIN_CORRELATION, "max_sigma_px": MAX_SIGMA_PX}
    matching: MatchingSettings = from_table(MatchingSettings, {**own, **tables.get("matching", {})}, "[matching]")
    tracking: TrackingSettings = from_table(TrackingSettings, {"wait_frames": WAIT_FRAMES, **tables.get("tracking", {})}, "[tracking]")
    return matching, tracking


def track_both_ways(
    sequence: ImageSequence,
    xy_px: np.ndarray,
    first: int,
    matching: MatchingSettings,
    tracking: TrackingSettings,
    monitor: Monitor,
    interlaced: str = "none",
) -> PlanarTracks:
    """Track points (N, 2) of image `first` to the end of the sequence, and back to its beginning."""
    grid = row_grid(interlaced)
    ahead = track_planar(sequence.read, range(first, sequence.count), xy_px, matching, tracking, monitor, grid)
    if first == 0:
        return ahead
    back = track_planar(sequence.read, range(first, -1, -1), xy_px, matching, tracking, monitor, grid)
    names = PlanarTracks.__dataclass_fields__
    return PlanarTracks(**{name: np.concatenate([getattr(back, name)[:0:-1], getattr(ahead, name)]) for name in names})


def open_footage(path: Path) -> ImageSequence:
    """A movie, or the images of a folder.

    Raises:
        InputError: there is none, or the folder has images of several kinds.
    """
    if path.is_dir():
        endings = sorted({p.suffix for p in path.iterdir() if p.suffix.lower() in IMAGE_ENDINGS})
        if len(endings) != 1:
            raise InputError(f"The folder {path} has {'no images' if not endings else 'images of several kinds'}; it needs one kind.")
        return open_sequence(path, images=f"*{endings[0]}", movie=None, view=path.name)
    if not path.is_file():
        raise InputError(f"The footage {path} is missing; give a movie or a folder of images.")
    return open_sequence(path.parent, images=None, movie=path.name, view=path.stem)


def _check_inside(points: ChosenPoints, image: np.ndarray, path: Path) -> None:
    h, w = image.shape
    for name, (x, y) in zip(points.names, points.xy_px):
        if not (0 <= x <= w - 1 and 0 <= y <= h - 1):
            raise InputError(f"The point “{name}” of {path} lies at ({x:g}, {y:g}), outside the image of {w}×{h} pixels.")


def _draw(folder: Path, sequence: ImageSequence, points: ChosenPoints, tracks: PlanarTracks, monitor: Monitor) -> None:
    """Write a picture per frame: the points with their names and paths, joined by lines."""
    list_files(folder, PICTURES, [f"{frame:04d}.png" for frame in tracks.frames])
    for t, frame in enumerate(tracks.frames.tolist()):
        monitor.step("pictures", t, len(tracks.frames))
        picture = paths_over_footage(sequence.read(frame), points.names, tracks.xy_px, t, points.joined)
        store.write_bytes(folder / f"{frame:04d}.png", png(picture))
