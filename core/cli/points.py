"""`tricap track TAKE --points FILE`: points that the user chose, tracked as single trajectories in the images and in space."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation import store
from ..foundation.bounded import real_path
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..report.pictures import png
from ..report.point_pictures import paths_in_space, paths_over_footage
from ..results.folder import Results, check_inside, check_separate_folder
from ..results.listed_files import PICTURES, check_files, list_files
from ..results.outputs import check_replaceable
from ..run import take_run
from ..run.settings import settings_of
from ..take.footage import Footage, open_take
from ..take.take import read_take
from ..tracking.key_points import KeyPoints, track_key_points
from ..tracking.point_tables import IMAGES_HEAD, SPACE_HEAD, ChosenPoints, read_points, write_key_points
from ..tracking.settings import TrackStatus
from ..tracking.track import TrackingRules
from .arguments import frame_range, overrides


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Track the chosen points and write OUT/points3d.csv and OUT/points2d.csv; the lines to show.

    Raises:
        InputError: the arguments, the points or the footage have an error.
    """
    take = read_take(args.take)
    settings = settings_of(take.settings, overrides(args.set), str(take.folder / "take.toml"))
    footage, frames = open_take(take, click_sigma_px=settings["fitting"].click_sigma_px), frame_range(args.frames)
    check_separate_folder(args.out, take.folder, (path for s in footage.sequences for path in s.files()))
    for folder in () if args.pictures is None else (args.pictures, *(args.pictures / view.name for view in take.views)):
        check_separate_folder(folder, take.folder, (path for s in footage.sequences for path in s.files()))
        check_files(folder, PICTURES)
        if folder != args.pictures:
            check_inside(folder, real_path(args.pictures))
    footage = footage if frames is None else take_run.only_frames(footage, frames)
    first = footage.frames.start if args.points_frame is None else args.points_frame
    if first not in footage.frames:
        raise InputError(f"--points-frame {first} is not among the frames {footage.frames.start} to {footage.frames.stop - 1}.")
    points = _by_name(read_points(args.points, with_views=True), footage, args.points)
    views = tuple(c.name for c in footage.rig.cameras)
    with Results(args.out).opened() as results:
        take_run.check_same_take(results.folder, results.read_run(), take)
        check_replaceable(results.path("points3d.csv"), SPACE_HEAD)
        check_replaceable(results.path("points2d.csv"), IMAGES_HEAD)
        tracked = follow_points(footage, points, first, settings, monitor)
        write_key_points(results.path("points3d.csv"), results.path("points2d.csv"), tuple(points), views, take.fps, tracked)
        if args.pictures is not None:
            _draw(args.pictures, footage, tuple(points), tracked, monitor)
    whole = int((tracked.status == TrackStatus.MEASURED).all(axis=0).sum())
    return [f"{results.folder}: {len(points)} points over {len(tracked.frames)} frames, {whole} of them visible in every frame."]


def follow_points(
    footage: Footage, points: Mapping[str, Mapping[str, np.ndarray]], first: int, settings: Mapping[str, Any], monitor: Monitor
) -> KeyPoints:
    """Track points, clicked in frame `first`, to the end of the footage and back to its beginning.

    Raises:
        InputError: the position of a point cannot be computed, or the images cannot be read.
    """
    view = TrackingRules(matching=settings["matching"], tracking=settings["tracking"]).view(footage)

    def read(frame: int) -> list[np.ndarray]:
        return [footage.take.rows_at(frame).rows(image) for image in footage.read(frame)]

    ahead = track_key_points(read, range(first, footage.frames.stop), points, view, monitor, settings["key_points"])
    if first == footage.frames.start:
        return ahead
    back = track_key_points(read, range(first, footage.frames.start - 1, -1), points, view, monitor, settings["key_points"])
    names = KeyPoints.__dataclass_fields__
    return KeyPoints(**{name: np.concatenate([getattr(back, name)[:0:-1], getattr(ahead, name)]) for name in names})


def _draw(folder: Path, footage: Footage, names: tuple[str, ...], tracked: KeyPoints, monitor: Monitor) -> None:
    """Write a picture per frame and view, and paths.png, the paths in space."""
    in_space = paths_in_space(names, tracked, footage.rig.cameras[footage.take.reference])
    list_files(folder, PICTURES, ["paths.png"] if in_space is not None else [])
    for camera in footage.rig.cameras:
        list_files(folder / camera.name, PICTURES, [f"{frame:04d}.png" for frame in tracked.frames])
    for t, frame in enumerate(tracked.frames.tolist()):
        monitor.step("pictures", t, len(tracked.frames))
        for k, (grey, camera) in enumerate(zip(footage.read_whole(frame), footage.rig.cameras)):
            picture = paths_over_footage(grey, names, tracked.xy_px[:, :, k], t)
            store.write_bytes(folder / camera.name / f"{frame:04d}.png", png(picture))
    if in_space is not None:
        store.write_bytes(folder / "paths.png", png(in_space))


def _by_name(chosen: ChosenPoints, footage: Footage, path: Path) -> dict[str, dict[str, np.ndarray]]:
    points: dict[str, dict[str, np.ndarray]] = {}
    cameras = [camera.name for camera in footage.rig.cameras]
    for name, view, xy in zip(chosen.names, chosen.views, chosen.xy_px):
        if view not in cameras:
            known = f"The take's views are {', '.join(cameras)}."
            raise InputError(f"The point “{name}” of {path} is in view “{view}”, which the take does not have. {known}")
        if not footage.rig[view].sees(xy):
            raise InputError(f"The point “{name}” of {path} lies at ({xy[0]:g}, {xy[1]:g}), outside the image of view {view}.")
        points.setdefault(name, {})[view] = xy
    return points
