"""Outlines of the person in a view, tracked frame by frame: predicted by trajectories, and compared with an outline of the frame's own."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import cv2
import numpy as np

from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.camera import Camera
from ..surface.cloud import PointCloud
from ..tracking.contour import (
    HEAD,
    Contour,
    ContourSettings,
    carried_points,
    contour_of_mask,
    contour_rows,
    mask_of_points,
    predict_contour,
    relax_contour,
    resampled,
)
from . import drawn_outlines
from .inspection import body_outline
from .take_run import Run

ALGORITHM = "contours 4"  # part of the checkpoints' keys: raise it when the same input gives other numbers
BACKGROUND_MEDIANS = 4.0  # smallest difference from the background, in units of its median over the image
MIN_DIFFERENCE = 4.0  # the same in grey values; the larger limit counts
DIFFERENCE_BLUR_PX = 1.5  # of differences and ratios to the background
OPENING_PX = 1  # radius, of the mask of differences
CLOSING_PX = 3  # radius, of the same
SHADOW_PX = 7  # window in which a shadow's ratio to the background is uniform
SHADOW_SCATTER = 0.06  # largest standard deviation of that ratio
MIN_SHADOW_RATIO = 0.6  # part of the light that a shadow leaves
CLOSING_CELLS = (2, 3, 4, 6)  # radii that are tried for closing the measured surface, in units of the contour's spacing
ONE_PIECE = 0.9  # part of the surface within its outline
MIN_VERTICES = 8  # of an outline
MAX_DISTANCE_PX = 8.0  # between a predicted contour and the frame's own outline
AGREEING_PART = 0.95  # of the vertices that must lie within it; otherwise the own outline replaces the contour


OutlinesOfBody = Callable[[int, Camera], list[np.ndarray]]  # closed polylines (M, 2) px of a body in a frame and a camera


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Start:
    """The start of a contour; by default the outline of the measured surface."""

    polygon: np.ndarray | None = None  # (V, 2) px of the first frame
    background: np.ndarray | None = None  # (h, w) image of the view without the person
    body: bool = False  # the outline of the projected skin of the fitted body, from OUT/skin
    outlines: OutlinesOfBody | None = None  # the same, of a body that has no files yet


MEASURED_SURFACE = Start()


class ContourCheckpoints:
    """Checkpoints of the contours of a view, one per frame, with a key of everything on which they depend."""

    def __init__(self, job: Run, view: int, start: Start) -> None:
        self._results, self._stage = job.results, _checkpoints(view)
        start_data = [b"" if a is None else np.ascontiguousarray(a).tobytes() for a in (start.polygon, start.background)]
        body = sorted(job.results.path("skin").glob("*.ply")) if start.body else []
        tracked = "tracked" if job.trajectories is not None else "tracked in the images"
        self._key = store.digest(ALGORITHM, job.keys["track"], repr(job.settings["contour"]), tracked, *start_data, *body)

    def load(self, frame: int) -> Contour | None:
        """The contour of a frame, None if it has no valid checkpoint."""
        arrays = self._results.load_checkpoint(self._stage, f"{frame:04d}", self._key)
        return None if arrays is None else Contour(**{f.name: arrays[f.name] for f in fields(Contour)})

    def save(self, frame: int, contour: Contour) -> None:
        """Write the checkpoint of a frame."""
        arrays = {f.name: getattr(contour, f.name) for f in fields(Contour)}
        self._results.save_checkpoint(self._stage, f"{frame:04d}", self._key, arrays)


def _checkpoints(view: int) -> str:
    return f"contour{view}"


def write_contour(job: Run, name: str, monitor: Monitor, start: Start, folder: str = "contours") -> str:
    """Track the outline in the view of this name and write contours/NAME.csv; a sentence about it. Raises as `track_contour`."""
    view = [v.name for v in job.footage.take.views].index(name)
    path, on_edge = job.results.path(folder, f"{name}.csv"), list[float]()
    checkpoints = ContourCheckpoints(job, view, start) if start.outlines is None else None
    images = drawn_outlines.drawn_on(job.footage, name, job.digests)
    with store.written(path) as file:
        file.write(HEAD.encode())
        for frame, contour in track_contour(job, view, monitor, start, checkpoints):
            file.write(contour_rows(frame, contour).encode())
            on_edge.append(contour.on_edge.mean())
    if folder == drawn_outlines.FOLDER:
        job.record.setdefault(drawn_outlines.ENTRY, {})[name] = drawn_outlines.entry_of(job.results.folder, name, images)
    job.results.remove(f"cache/{_checkpoints(view)}")
    job.results.write_run(job.record)
    return f"{path}: the outline in {len(on_edge)} frames, {100 * float(np.mean(on_edge)):.0f} % of its vertices on an edge."


def track_contour(
    job: Run, view: int, monitor: Monitor, start: Start, checkpoints: ContourCheckpoints | None = None
) -> Iterator[tuple[int, Contour]]:
    """(frame, contour) of one view. Each is predicted from the last one by the projected trajectories inside it, or without trajectories by
    points that are tracked in the images.

    Every frame has an outline of its own: that of the measured surface, of the fitted body, or of the difference from the background. It
    replaces a predicted contour that differs too much from it, except where the contour started from a polygon.

    Raises:
        InputError: there is nothing to start from.
    """
    tracker = _ContourTracker(job, view, start)
    for i, cloud in enumerate(job.clouds):
        monitor.step("contours", i, len(job.clouds))
        contour = checkpoints.load(cloud.frame) if checkpoints is not None else None
        if contour is None:
            contour = tracker.contour_in(i, cloud)
            if checkpoints is not None:
                checkpoints.save(cloud.frame, contour)
        tracker.update(i, cloud.frame, contour)
        yield cloud.frame, contour


class _ContourTracker:
    """The state of a tracked contour: `base` is the contour from which the next is predicted, of frame number `frame` with index `last`."""

    def __init__(self, job: Run, view: int, start: Start) -> None:
        self._job, self._view, self._start = job, view, start
        self._camera, self._tracks, self._settings = job.footage.rig.cameras[view], job.trajectories, job.settings["contour"]
        self._base: Contour | None = None
        self._last, self._frame = 0, 0
        self._image: tuple[int, np.ndarray] | None = None  # the last one read, with its frame

    def update(self, index: int, frame: int, contour: Contour) -> None:
        """Predict the next contour from this one, unless its frame has neither trajectories nor edges."""
        if self._base is None or (contour.on_edge.any() if self._tracks is None else self._tracks.visible[index].any()):
            self._base, self._last, self._frame = contour, index, frame

    def contour_in(self, index: int, cloud: PointCloud) -> Contour:
        """The contour in the frame of a cloud.

        Raises:
            InputError: there is nothing to start from.
        """
        moved = None if self._base is None else self._moved(self._base, index, cloud.frame)
        grey = self._grey(cloud.frame)
        own = self._own(grey, cloud)
        if self._base is not None and moved is not None:
            return relax_contour(_replaced(predict_contour(self._base.xy_px, *moved), own), grey, self._settings)
        predicted = own if self._start.polygon is None else resampled(self._start.polygon, self._settings.spacing_px)
        if len(predicted) < MIN_VERTICES:
            raise InputError(f"There is no outline to start from in frame {cloud.frame}; give one with --polygon.")
        return relax_contour(predicted, grey, self._settings)

    def _moved(self, base: Contour, index: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Points of the view (N, 2) in the frame of the base contour, and the same points (N, 2) in this frame."""
        if self._tracks is not None:
            return self._camera.project(self._tracks.xyz_m[self._last]), self._camera.project(self._tracks.xyz_m[index])
        return carried_points(base.xy_px, self._grey(self._frame), self._grey(frame))

    def _own(self, grey: np.ndarray, cloud: PointCloud) -> np.ndarray:
        """The frame's own outline (V, 2); none where the contour started from a polygon."""
        if self._start.outlines is not None:
            return _of_body(self._start.outlines(cloud.frame, self._camera), self._settings)
        if self._start.body:
            return _of_body(body_outline(self._job.results.folder, cloud.frame, self._camera), self._settings)
        if self._start.background is not None:
            return _before_background(grey, self._start.background, self._settings)
        return _outline(grey, self._camera.project(cloud.xyz_m), self._settings) if self._start.polygon is None else np.zeros((0, 2))

    def _grey(self, frame: int) -> np.ndarray:
        """The view's image in a frame."""
        if self._image is None or self._image[0] != frame:
            footage = self._job.footage
            self._image = frame, footage.take.rows_at(frame).whole(footage.read(frame)[self._view])
        return self._image[1]


def _before_background(grey: np.ndarray, background: np.ndarray, settings: ContourSettings) -> np.ndarray:
    """The outline of the difference from the background, without shadows and without what a camera shift of a pixel explains.

    Raises:
        InputError: the background is of another size.
    """
    if background.shape != grey.shape:
        raise InputError("The background image and the view differ in size; use an image of the same camera.")
    room, neighbours = background.astype(np.float32), np.ones((3, 3), np.uint8)
    beyond = np.maximum(grey - cv2.dilate(room, neighbours), cv2.erode(room, neighbours) - grey)
    difference = cv2.GaussianBlur(np.maximum(beyond, 0.0).astype(np.float32), (0, 0), DIFFERENCE_BLUR_PX)
    limit = max(float(np.median(difference)) * BACKGROUND_MEDIANS, MIN_DIFFERENCE)
    mask = ((difference > limit) & ~_shadow(grey, background)).astype(np.uint8)
    for operation, radius in ((cv2.MORPH_OPEN, OPENING_PX), (cv2.MORPH_CLOSE, CLOSING_PX)):
        mask = cv2.morphologyEx(mask, operation, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2))
    return contour_of_mask(mask, settings.spacing_px)


def _shadow(grey: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Where (h, w) an image shows the background darkened by a locally uniform factor (Horprasert et al. 1999)."""
    ratio = ((grey + 1) / (background + 1)).astype(np.float32)
    mean, square = (cv2.blur(r, (SHADOW_PX, SHADOW_PX)) for r in (ratio, ratio**2))
    even = np.sqrt(np.maximum(square - mean**2, 0.0)) < SHADOW_SCATTER
    smooth = cv2.GaussianBlur(ratio, (0, 0), DIFFERENCE_BLUR_PX)
    return np.asarray(even & (smooth > MIN_SHADOW_RATIO) & (smooth < 1.0))


def _of_body(outlines: list[np.ndarray], settings: ContourSettings) -> np.ndarray:
    """The largest of the outlines of a body's skin; none if there are none."""
    if not outlines:
        return np.zeros((0, 2))
    return resampled(max(outlines, key=lambda o: cv2.contourArea(o.astype(np.float32))), settings.spacing_px)


def _outline(grey: np.ndarray, points: np.ndarray, settings: ContourSettings) -> np.ndarray:
    """The outline of the measured surface; gaps are closed until nearly all of it is in one piece."""
    size = (grey.shape[1], grey.shape[0])
    outline = np.zeros((0, 2))
    for cells in CLOSING_CELLS:
        mask = mask_of_points(points, size, cells * settings.spacing_px)
        outline = contour_of_mask(mask, settings.spacing_px)
        if len(outline) >= MIN_VERTICES:
            inside = np.zeros(mask.shape, dtype=np.uint8)
            cv2.fillPoly(inside, [np.rint(outline).astype(np.int32)], 1)
            if (mask & (inside > 0)).sum() >= ONE_PIECE * mask.sum():
                break
    return outline


def _replaced(predicted: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """The predicted contour, or the frame's own outline where the two differ too much, because limbs crossed or separated."""
    from scipy.spatial import cKDTree

    if len(outline) < MIN_VERTICES:
        return predicted
    there, back = (cKDTree(b).query(a)[0] for a, b in ((predicted, outline), (outline, predicted)))
    return outline if max(np.quantile(there, AGREEING_PART), np.quantile(back, AGREEING_PART)) > MAX_DISTANCE_PX else predicted
