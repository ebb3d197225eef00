"""Fits without a measured surface (views far apart, a person without texture, or no need of one): outlines and keypoints remain."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from ...foundation.progress import Monitor
from ...images.foreground import FEWEST
from ...results.folder import Results
from ...surface.cloud import PointCloud
from ...take.footage import Footage
from ...tracking.contour import ContourTable, Polygons
from ...tracking.image_points import ImageStep, followed
from ..settings import FitSettings
from .background import UNIT_PX, find_background, has_silhouettes, near_points
from .fit_input import BackgroundDistances, Packed

STEP_PX = 4  # of the distances from outlines
LEAST_CORNERS = 3  # of a polygon
ON_BODY_M = 0.03  # of a body whose place is known about, from which points are followed
AROUND = 0.04  # of the picture's longer side, about what differs from the background: parts that stand still are near those that move
SUBPIXEL_BITS = 4  # of a polygon's vertices in OpenCV's fixed-point coordinates


def can_fit_without_surface(footage: Footage, results: Results) -> bool:
    """Whether there are outlines (`tricap contour`) or keypoints for a fit without measured points."""
    return bool(footage.take.keypoints) or any(results.path("contours", f"{v.name}.csv").is_file() for v in footage.take.views)


def can_show_outlines(footage: Footage, settings: FitSettings) -> bool:
    """Whether the images may show outlines of the person for a fit: by masks or a background of the user's, or in enough frames."""
    given = any(view.background is not None or has_silhouettes(footage, k) for k, view in enumerate(footage.take.views))
    return settings.use_background and (given or len(footage.frames) >= FEWEST)


def empty_clouds(footage: Footage) -> list[PointCloud]:
    """A cloud without points for every frame."""
    none, views = np.zeros((0, 3)), len(footage.take.views)
    return [
        PointCloud(
            frame=frame,
            xyz_m=none,
            covariance_m2=np.zeros((0, 3, 3)),
            normals=none,
            intensity=np.zeros(0),
            xy_px=np.zeros((0, views, 2)),
            residual_px=np.zeros(0),
            extended=np.zeros(0, dtype=bool),
        )
        for frame in footage.frames
    ]


def outline_polygons(footage: Footage, results: Results, folder: str = "contours") -> dict[str, Mapping[int, np.ndarray]]:
    """The outline (V, 2) px of the person from `tricap contour`, or others in a folder of OUT, by view and frame; views without one are
    omitted.

    Raises:
        InputError: a table of contours is damaged.
    """
    tables = {view.name: ContourTable(results.path(folder, f"{view.name}.csv")) for view in footage.take.views}
    polygons = {name: Polygons(table, footage.frames, LEAST_CORNERS) for name, table in tables.items()}
    return {name: found for name, found in polygons.items() if found}


def points_in_views(
    footage: Footage, background: Sequence[BackgroundDistances], monitor: Monitor, bodies: Sequence[np.ndarray] | None = None
) -> dict[str, list[ImageStep]]:
    """The points of the person that are followed in each view by itself (`tracking.image_points`), in views whose background is known;
    nothing of interlaced video. `bodies`: see `find_background`; the points are near them.

    Raises:
        InputError: an image cannot be read.
        Cancelled: the user asked to stop.
    """
    if footage.take.interlaced != "none":
        return {}
    names, found = [view.name for view in footage.take.views], dict[str, list[ImageStep]]()
    for i, region in enumerate(background):
        k = names.index(region.view)

        def read(frame: int, k: int = k) -> np.ndarray:
            return footage.sequences[k].read(footage.number(k, frame))

        person = partial(_person, footage, region, bodies)
        found[region.view] = list(followed(read, footage.frames, person, monitor.part("follow points", i, len(background))))
    return found


def _person(footage: Footage, region: BackgroundDistances, bodies: Sequence[np.ndarray] | None, frame: int) -> np.ndarray:
    """Where (h, w) the person is in a view: near the body, if its place is known about, or near what differs from the background."""
    camera = footage.rig[region.view]
    shape = camera.size_px[::-1]
    if bodies is not None:
        return near_points(camera, bodies[frame - footage.frames.start], shape, 1, ON_BODY_M)
    distance = region.of_frame(frame)
    if distance is None:
        return np.zeros(shape, dtype=bool)
    reach = 2 * (round(AROUND * max(distance.shape)) if region.estimated else 0) + 1
    shown = cv2.dilate((distance == 0).astype(np.uint8), np.ones((reach, reach), np.uint8))
    return np.asarray(cv2.resize(shown, shape[::-1], interpolation=cv2.INTER_NEAREST) > 0)


def filled(polygon_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """The mask (h, w) of a polygon (V, 2)."""
    mask = np.zeros(size_px[::-1], np.uint8)
    cv2.fillPoly(mask, [np.rint(polygon_px * 2**SUBPIXEL_BITS).astype(np.int32)], 1, shift=SUBPIXEL_BITS)
    return mask.astype(bool)


def background_regions(
    footage: Footage,
    results: Results,
    clouds: Sequence[PointCloud],
    settings: FitSettings,
    monitor: Monitor,
    rows: range | None = None,
    bodies: Sequence[np.ndarray] | None = None,
) -> list[BackgroundDistances]:
    """The background regions of the views: outside the outline; in views without one, where the still background is visible.

    `rows`: of the clouds, in whose frames they are wanted; by default in all. `bodies`: see `find_background`.

    Raises:
        InputError: an image or a table of contours cannot be read.
        Cancelled: the user asked to stop.
    """
    if not settings.use_background:
        return []
    wanted = footage if rows is None else replace(footage, frames=footage.frames[rows.start : rows.stop])
    outlines = outline_polygons(wanted, results) if settings.use_contours else {}
    others = find_background(footage, clouds, monitor, rows, bodies) if len(outlines) < len(footage.take.views) else []
    return background_outside_outlines(footage, outlines) + [region for region in others if region.view not in outlines]


def background_outside_outlines(footage: Footage, outlines: Mapping[str, Mapping[int, np.ndarray]]) -> list[BackgroundDistances]:
    """The background regions outside of the outlines."""
    found = []
    for name, polygons in outlines.items():
        tables = Packed(_distances(filled(xy, footage.rig[name].size_px)) for xy in polygons.values())
        found.append(BackgroundDistances(view=name, frame=np.array(list(polygons)), distance=tables, step_px=STEP_PX, unit_px=UNIT_PX))
    return found


def _distances(inside: np.ndarray) -> np.ndarray:
    """Distance (h', w') of the middles of squares from the mask, in units of `UNIT_PX`."""
    far = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    h, w = (n // STEP_PX for n in inside.shape)
    middles = far[: h * STEP_PX, : w * STEP_PX].reshape(h, STEP_PX, w, STEP_PX).mean(axis=(1, 3))
    return np.asarray(np.minimum(middles / UNIT_PX, 255)).astype(np.uint8)
