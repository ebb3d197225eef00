"""`tricap contour`: the outline of the person in one view, frame after frame, carried by the trajectories."""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from . import pipeline, store
from .arguments import frame_range, overrides
from .errors import InputError
from .images.sequence import read_image
from .inspection import body_outline
from .measuring import NothingMeasured
from .progress import Monitor
from .settings import nearest_name
from .tracking.contour import (
    Contour,
    ContourSettings,
    carried_points,
    contour_of_mask,
    mask_of_points,
    predict_contour,
    relax_contour,
    resampled,
)
from .tracking.point_tables import read_polygon

BACKGROUND_SIGMAS, OPENING_PX, CLOSING_PX = 4.0, 1, 3
SHADOW_PX, SHADOW_SCATTER, DARKEST_SHADOW = 7, 0.06, 0.6  # window, and what a shadow leaves of the light
CLOSING_CELLS, ONE_PIECE = (2, 3, 4, 6), 0.9
APART_PX, AGREEING = 8.0, 0.95  # a contour of which more than a twentieth is further from the measured outline begins anew


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Start:
    """What the contour begins with; by default the outline of the measured surface."""

    polygon: np.ndarray | None = None  # (V, 2) px of the first frame
    background: np.ndarray | None = None  # (h, w) the view without the person
    body: bool = False  # the projected skin of the fitted body


MEASURED_SURFACE = Start()


def add_command(commands: Any) -> None:
    """Join `contour` to the parser's commands."""
    about = "the outline of the person in one view, tracked through the frames"
    parser = commands.add_parser("contour", help=about, description=about[0].upper() + about[1:])
    parser.add_argument("take", type=Path, metavar="TAKE", help="folder with take.toml")
    parser.add_argument("--view", required=True, nargs="+", metavar="NAME", help="the view, such as C, or several")
    parser.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder for the results; contours/NAME.csv is written")
    parser.add_argument("--frames", metavar="A:B", help="only frames A to B - 1")
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--polygon", type=Path, metavar="FILE", help="CSV with x,y of the outline in the first frame")
    start.add_argument("--background", type=Path, metavar="FILE", help="image of the view without the person")
    start.add_argument("--from-body", action="store_true", help="begin with the outline of the body that is fitted in OUT")
    parser.add_argument("--set", action="append", default=[], metavar="GROUP.NAME=VALUE", help="a setting, such as matching.patch_px=17")
    parser.set_defaults(run=run, json=False)


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Track the contour (measures and tracks first where that is needed); the lines to show.

    Raises:
        InputError: the arguments or the take need mending.
    """
    with pipeline.open_run(args.take, args.out, overrides(args.set), frame_range(args.frames)) as job:
        start = Start(
            polygon=read_polygon(args.polygon) if args.polygon else None,
            background=read_image(args.background) if args.background else None,
            body=args.from_body,
        )
        return write_contours(job, args.view, monitor, start)


def write_contours(job: pipeline.Run, views: list[str], monitor: Monitor, start: Start = MEASURED_SURFACE) -> list[str]:
    """Track the contour in the views of these names: contours/NAME.csv of each.

    Measures and tracks first where that is needed: a background shows the outline in every frame, and what cannot be measured, or is not
    to be (fitting.use_surface), is followed in the images from a polygon.

    Says what was found. A body that the contours begin with is that of the same frames and settings; with the contours it is stale.

    Raises:
        InputError: there is no such view, or nothing to start from.
    """
    names = [v.name for v in job.footage.take.views]
    for name in views:
        if name not in names:
            raise InputError(f"{job.footage.take.folder} has no view “{name}”.{nearest_name(name, names)}")
    if len(views) > 1 and (start.polygon is not None or start.background is not None):
        raise InputError("A polygon or a background is that of one view; give one --view with it.")
    if start.body and not job.results.path("skin").is_dir():
        folder = job.results.folder
        raise InputError(f"{folder} holds no body with a skin that was fitted to these frames with these settings; run `tricap fit` first.")
    own_start = start.polygon is not None or start.background is not None or start.body
    if job.trajectories is None and start.background is None and (job.settings["fitting"].use_surface or not own_start):
        _track_if_possible(job, monitor, own_start)
    return [_write_contour(job, name, names.index(name), monitor, start) for name in views]


def _track_if_possible(job: pipeline.Run, monitor: Monitor, own_start: bool) -> None:
    """Measure and track; that there is nothing to measure is no fault where the contour has another start."""
    try:
        pipeline.track(job, monitor)
    except NothingMeasured as error:
        if not own_start:
            raise
        job.warn(f"{error} The outline was followed in the images.")


def _write_contour(job: pipeline.Run, name: str, view: int, monitor: Monitor, start: Start) -> str:
    contours = dict(track_contour(job, view, monitor, start))
    path = job.results.path("contours", f"{name}.csv")
    store.write_text(path, _table(contours))
    job.account["stages"].pop("fit", None)  # the body is to be fitted again
    job.results.write_run(job.account)
    seen = float(np.mean([c.seen.mean() for c in contours.values()]))
    return f"{path}: the outline in {len(contours)} frames, {100 * seen:.0f} % of its vertices on an edge."


def track_contour(job: pipeline.Run, view: int, monitor: Monitor, start: Start) -> Iterator[tuple[int, Contour]]:
    """(frame, contour) of one view; each predicted by the projected trajectories inside the last one that had any, or else by points that
    are followed in the images.

    A predicted contour that differs too much from the frame's own outline, of the measured surface, of the fitted body or before the
    background, gives way to it, unless it began with a polygon.

    Raises:
        InputError: there is nothing to start from.
    """
    camera, tracks, settings = job.footage.rig.cameras[view], job.trajectories, job.settings["contour"]
    base: Contour | None = None  # in frame number `last`, of the image `before`
    last, before = 0, np.zeros((0, 0))
    for i, cloud in enumerate(job.clouds):
        monitor.step("contours", i, len(job.clouds))
        grey = job.footage.take.rows_at(cloud.frame).whole(job.footage.read(cloud.frame)[view])
        own = np.zeros((0, 2))
        if start.body:
            own = _of_body(body_outline(job.results.folder, cloud.frame, camera), settings)
        elif start.background is not None:
            own = _before_background(grey, start.background, settings)
        elif start.polygon is None:
            own = _outline(grey, camera.project(cloud.xyz_m), settings)
        if base is None:
            predicted = own if start.polygon is None else resampled(start.polygon, settings.spacing_px)
            if len(predicted) < 8:
                raise InputError(f"There is no outline to start from in frame {cloud.frame}; give one with --polygon.")
        else:
            places = carried_points(base.xy_px, before, grey) if tracks is None else (
                camera.project(tracks.xyz_m[last]), camera.project(tracks.xyz_m[i]))
            carried = predict_contour(base.xy_px, *places)
            predicted = _renewed(carried, own)
        contour = relax_contour(predicted, grey, settings)
        if base is None or (contour.seen.any() if tracks is None else tracks.seen[i].any()):
            base, last, before = contour, i, grey
        yield cloud.frame, contour


def _before_background(grey: np.ndarray, background: np.ndarray, settings: ContourSettings) -> np.ndarray:
    """The outline of what differs from the background, shadows aside: they darken a place by little, and evenly.

    Raises:
        InputError: the background is of another size.
    """
    if background.shape != grey.shape:
        raise InputError("The background image has another size than the view; take it with the same camera.")
    difference = cv2.GaussianBlur(np.abs(grey - background).astype(np.float32), (0, 0), 1.5)
    limit = max(float(np.median(difference)) * BACKGROUND_SIGMAS, 4.0)
    mask = ((difference > limit) & ~_shadow(grey, background)).astype(np.uint8)
    for operation, radius in ((cv2.MORPH_OPEN, OPENING_PX), (cv2.MORPH_CLOSE, CLOSING_PX)):
        mask = cv2.morphologyEx(mask, operation, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2))
    return contour_of_mask(mask, settings.spacing_px)


def _shadow(grey: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Where (h, w) an image is the background, darker by a factor that is nearly the same all around (Horprasert et al. 1999)."""
    ratio = ((grey + 1) / (background + 1)).astype(np.float32)
    mean, square = (cv2.blur(r, (SHADOW_PX, SHADOW_PX)) for r in (ratio, ratio**2))
    even = np.sqrt(np.maximum(square - mean**2, 0.0)) < SHADOW_SCATTER
    smooth = cv2.GaussianBlur(ratio, (0, 0), 1.5)
    return np.asarray(even & (smooth > DARKEST_SHADOW) & (smooth < 1.0))


def _of_body(outlines: list[np.ndarray], settings: ContourSettings) -> np.ndarray:
    """The largest of the outlines of a body's skin; none where it has none."""
    if not outlines:
        return np.zeros((0, 2))
    return resampled(max(outlines, key=lambda o: cv2.contourArea(o.astype(np.float32))), settings.spacing_px)


def _outline(grey: np.ndarray, points: np.ndarray, settings: ContourSettings) -> np.ndarray:
    """The outline of the measured surface; gaps are closed until nearly all of it is one piece."""
    size = (grey.shape[1], grey.shape[0])
    outline = np.zeros((0, 2))
    for cells in CLOSING_CELLS:
        mask = mask_of_points(points, size, cells * settings.spacing_px)
        outline = contour_of_mask(mask, settings.spacing_px)
        if len(outline) >= 8:
            inside = np.zeros(mask.shape, dtype=np.uint8)
            cv2.fillPoly(inside, [np.rint(outline).astype(np.int32)], 1)
            if (mask & (inside > 0)).sum() >= ONE_PIECE * mask.sum():
                break
    return outline


def _renewed(predicted: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """The predicted contour, or the frame's own outline where both differ too much: limbs crossed, or parted."""
    if len(outline) < 8:
        return predicted
    there, back = (cKDTree(b).query(a)[0] for a, b in ((predicted, outline), (outline, predicted)))
    return outline if max(np.quantile(there, AGREEING), np.quantile(back, AGREEING)) > APART_PX else predicted


def _table(contours: dict[int, Contour]) -> str:
    lines = ["frame,vertex,x,y,normal_x,normal_y,sigma,on_edge"]
    for frame, c in contours.items():
        rows = np.column_stack([c.xy_px, c.normal, c.sigma_px])
        lines += [f"{frame},{v}," + ",".join(f"{x:.4f}" for x in row) + f",{int(c.seen[v])}" for v, row in enumerate(rows)]
    return "\n".join(lines) + "\n"
