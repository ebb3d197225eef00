"""Background regions of the views, frame by frame, as observations of a body: no limb is there.

Only limbs whose pose must be observed take part; and, with a larger sigma, the middle of a hand, whose prior is a straight wrist: the tip
of a bent one would pull its forearm.

The person is what the user's masks of every image say, or what covers the background (`images.foreground`): the view's `background` image
in take.toml, or else what stays the same when no measured point is near. The images are averaged in square cells of about a centimetre at
the person. Nobody is outside a mask for all images. Cells with measured points are the person's. So are those along clicked limbs that look
like the background where they were clicked: such a limb stands still, and the background is not known there.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from ...body.model_file import read_model
from ...body.skeleton import Skeleton
from ...foundation.errors import InputError
from ...foundation.progress import Monitor
from ...foundation.threads import in_threads
from ...geometry.camera import Camera
from ...geometry.intersection import intersect_clicks
from ...geometry.rig import Rig
from ...images.foreground import FEWEST, CellBackground, cells, given_background, person, still_background
from ...surface.cloud import PointCloud
from ...take.footage import Footage
from ...take.person_masks import WHITE, silhouette_file
from ...take.sources import read_picture
from ...take.take import FrameClicks
from ..observations import BackgroundExclusion
from ..observations.background import DistanceMap
from ..settings import FitSettings
from ..state import ShapeParameters, free_bones
from .fit_input import UNKNOWN, BackgroundDistances, FitInput, Packed

FRACTIONS = (0.2, 0.5, 0.8, 1.0)  # of a bone's axis, where its places are
SAMPLES = 21  # frames for a view's background
CELL_M, CELLS, LARGEST_CELL_PX = 0.008, 384, 8  # at the person; of an image without measured points; of a cell
UNIT_PX = 0.5  # of stored distances
MOST_CELLS = 600  # of a view, for a search
HALF = 0.5  # of a cell is the person's, if the cell is
STILL = 0.25  # of a limb's line looks like the background, if the limb stands still
NEAR_M = 0.025  # nothing so near to a measured point shows the background
ROUGHLY_M = 0.06  # … and to a body whose place is known about
BAND = 0.5  # width of a clicked limb over the mean length of the limbs
CACHED_BYTES = 64_000_000  # of the frames whose distances are unpacked


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonCells:
    """Cells of one view in one frame that show the person, thinned."""

    camera: Camera
    xy_px: np.ndarray  # (M, 2)
    directions: np.ndarray  # (M, 3) unit rays in the world
    area_px: float  # of the image for which each of them stands
    distance: DistanceMap

    def take(self, rows: np.ndarray | slice) -> "PersonCells":
        """Some of the cells."""
        return replace(self, xy_px=self.xy_px[rows], directions=self.directions[rows])


class BackgroundRegions:
    """The background regions of all views in all frames."""

    def __init__(self, given: FitInput, parameters: ShapeParameters, settings: FitSettings) -> None:
        skeleton = parameters.skeleton
        names = {joint: i for i, joint in enumerate(skeleton.joint_names)}
        free = free_bones(parameters)
        places = [(bone, along) for bone, observed in zip(skeleton.bones, free) if observed for along in FRACTIONS]
        self._head = np.array([names[bone.head_joint] for bone, _ in places], dtype=np.intp)
        self._tail = np.array([names[bone.tail_joint] for bone, _ in places], dtype=np.intp)
        self._fraction = np.array([along for _, along in places])
        self._sigma_px = settings.background_sigma_px
        self._given = given.background if settings.use_background else ()
        self._rig, self._frames = given.rig, given.frames
        self._cells: dict[int, list[PersonCells]] = {}
        self._unpacked: dict[int, list[DistanceMap]] = {}

    def stretch(self, frames: Sequence[int]) -> "BackgroundRegions":
        """Those of some of the frames."""
        part = copy(self)
        part._frames, part._cells, part._unpacked = [self._frames[t] for t in frames], {}, {}
        return part

    def observe(self, t: int) -> list[BackgroundExclusion]:
        """The observations of frame index `t`; none where no background is known."""
        views = self._maps(t)
        if not views:
            return []
        return [BackgroundExclusion(views=views, head=self._head, tail=self._tail, fraction=self._fraction, sigma_px=self._sigma_px)]

    @property
    def known(self) -> bool:
        """Whether the background of any view is known."""
        return bool(self._given)

    def cells(self, t: int) -> list[PersonCells]:
        """The person's cells in frame index `t`, of the views whose background is known; those of the last frames are cached."""
        maps = self._maps(t)
        if t not in self._cells:
            self._cells[t] = [_person_cells(view) for view in maps if view.table.any() and not view.table.all()]
        return self._cells[t]

    def _maps(self, t: int) -> list[DistanceMap]:
        """Those of one frame; of the last frames they are cached, and so are the cells."""
        if t not in self._unpacked:
            found = [
                DistanceMap(camera=self._rig[v.view], table=d, step_px=v.step_px, first_px=(v.step_px - 1) / 2, unit_px=v.unit_px)
                for v in self._given
                if (d := v.of_frame(self._frames[t])) is not None
            ]
            if len(self._unpacked) * sum(view.table.nbytes for view in found) > CACHED_BYTES:
                oldest = next(iter(self._unpacked))
                del self._unpacked[oldest]
                self._cells.pop(oldest, None)
            self._unpacked[t] = found
        return self._unpacked[t]


def _person_cells(view: DistanceMap) -> PersonCells:
    j, i = np.nonzero(view.table == 0)
    every = 1 + (len(i) - 1) // MOST_CELLS
    xy = view.first_px + view.step_px * np.stack([i, j], axis=1)[::every]
    rays = view.camera.rays(xy)
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return PersonCells(camera=view.camera, xy_px=xy, directions=directions, area_px=float(every * view.step_px**2), distance=view)


def find_background(
    footage: Footage,
    clouds: Sequence[PointCloud],
    monitor: Monitor,
    rows: Sequence[int] | None = None,
    bodies: Sequence[np.ndarray] | None = None,
) -> list[BackgroundDistances]:
    """Where the views show the person and where the background, in the frames of the clouds, or of those in `rows`; of the views in which
    that is known. `bodies`: points (P, 3) on the person's surface in each frame, about, where nothing was measured.

    Raises:
        InputError: an image or a mask cannot be read, or the background in take.toml is not that of the view.
        Cancelled: the user asked to stop.
    """
    frames = np.array([cloud.frame for cloud in clouds])
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(SAMPLES, len(frames))).round().astype(int)).tolist()
    sizes = _cell_sizes(footage, clouds, chosen)
    known = {k: b for k, b in enumerate(_backgrounds(footage, clouds, chosen, sizes, monitor, bodies)) if b is not None}
    masked = {k for k in range(len(sizes)) if has_silhouettes(footage, k)}
    if not known and not masked:
        return []
    limits = {k: cells(_mask_of(footage, k, int(frames[0])), sizes[k]) > 0 for k in known if footage.take.views[k].mask is not None}
    persons = _clicked_limbs(footage, known, clouds, frames.tolist())
    found = {k: Packed() for k in sorted({*known, *masked})}

    def distances(cloud: PointCloud, images: Sequence[np.ndarray], k: int) -> np.ndarray:
        camera, size = footage.rig.cameras[k], sizes[k]
        if k in known:
            image = cells(images[k], size)
            seen = near_points(camera, cloud.xyz_m, image.shape, size, CELL_M)
            shown = person(known[k], image, seen)
            shown = np.ones(image.shape, dtype=bool) if shown is None else (shown | seen | persons[k]) & limits.get(k, True)
        else:
            shown = cells(_mask_of(footage, k, cloud.frame), size) > HALF
        unknown = (known[k].known == 0) & ~shown if k in known else np.zeros(shown.shape, dtype=bool)
        beyond = (~(shown | unknown)).astype(np.uint8)
        far = cv2.distanceTransform(beyond, cv2.DIST_L2, cv2.DIST_MASK_5)  # infinite if all is background
        steps = np.minimum(far, 255 * UNIT_PX / size) * (size / UNIT_PX)
        return np.where(unknown, UNKNOWN, steps).astype(np.uint8)

    wanted = range(len(clouds)) if rows is None else rows
    for i, t in enumerate(wanted):
        monitor.step("background", i, len(wanted))
        cloud = clouds[t]
        images = footage.read(cloud.frame) if known else []
        for k, of_view in zip(found, in_threads(partial(distances, cloud, images), [*found])):
            found[k].append(of_view)
    views, frames = footage.take.views, frames[list(wanted)]
    return [
        BackgroundDistances(
            view=views[k].name,
            frame=frames,
            distance=d,
            step_px=sizes[k],
            unit_px=UNIT_PX,
            estimated=k in known and views[k].background is None,
        )
        for k, d in found.items()
    ]


def has_silhouettes(footage: Footage, k: int) -> bool:
    """Whether the masks of a view are the person's silhouettes: one for all of many images only says where the person moves."""
    view = footage.take.views[k]
    return view.masks is not None or (view.mask is not None and footage.sequences[k].count == 1)


def _mask_of(footage: Footage, k: int, frame: int) -> np.ndarray:
    """The user's mask (h, w) of a view for a frame."""
    path, camera = silhouette_file(footage, k, frame), footage.rig.cameras[k]
    assert path is not None
    return np.asarray(read_picture(path, camera.name, camera.size_px) > WHITE)


def _cell_sizes(footage: Footage, clouds: Sequence[PointCloud], chosen: Sequence[int]) -> list[int]:
    """The size of a view's cells in pixels: about `CELL_M` at the person; without measured points as in a picture of `CELLS` cells."""
    measured = [clouds[t].xyz_m for t in chosen if len(clouds[t].xyz_m)]
    sizes = []
    for camera in footage.rig.cameras:
        if measured:
            depth = float(np.median(np.concatenate([camera.to_camera(xyz_m)[:, 2] for xyz_m in measured])))
            size = CELL_M * camera.focal_px / max(depth, CELL_M)
        else:
            size = max(camera.size_px) / CELLS
        sizes.append(int(np.clip(round(size), 1, LARGEST_CELL_PX)))
    return sizes


def _backgrounds(
    footage: Footage,
    clouds: Sequence[PointCloud],
    chosen: Sequence[int],
    sizes: Sequence[int],
    monitor: Monitor,
    bodies: Sequence[np.ndarray] | None = None,
) -> list[CellBackground | None]:
    """The background of every view: the user's image of it, or what stays the same in the chosen frames; None where they are too few."""
    points, numbers = [clouds[t].xyz_m for t in chosen], [clouds[t].frame for t in chosen]
    footage.read(numbers[0])  # of the cameras' size

    def background(k: int) -> CellBackground | None:
        camera, view, size = footage.rig.cameras[k], footage.take.views[k], sizes[k]
        if view.background is None and (has_silhouettes(footage, k) or len(chosen) < FEWEST):
            return None
        images = []
        for frame in numbers:
            monitor.check()
            images.append(cells(footage.sequences[k].read(footage.number(k, frame)), size))
        if view.background is not None:
            return _given_background(footage, k, images, size)
        everywhere = any(map(len, points))  # a frame without points does not show where the person is
        if bodies is not None:
            near = [near_points(camera, bodies[t], images[0].shape, size, ROUGHLY_M) for t in chosen]
        else:
            near = [
                near_points(camera, xyz_m, images[0].shape, size, NEAR_M) if len(xyz_m) else np.full(images[0].shape, everywhere)
                for xyz_m in points
            ]
        seen = [near_points(camera, xyz_m, images[0].shape, size, CELL_M) for xyz_m in points]
        return still_background(images, near, seen, size)

    monitor.step("background", 0, len(clouds))
    return in_threads(background, range(len(sizes)))


def _given_background(footage: Footage, k: int, images: Sequence[np.ndarray], size: int) -> CellBackground:
    """The background of a view by the user's own image of it.

    Raises:
        InputError: it cannot be read, is of another size, or none of the images shows it.
    """
    view, camera = footage.take.views[k], footage.rig.cameras[k]
    assert view.background is not None
    path = footage.take.folder / view.background
    background = given_background(cells(read_picture(path, view.name, camera.size_px), size), images, size)
    if background is None:
        raise InputError(
            f"The background image {path} is nothing like view {view.name} in any frame; take it with the same camera and light."
        )
    return background


def near_points(camera: Camera, xyz_m: np.ndarray, shape: tuple[int, ...], size: int, reach_m: float) -> np.ndarray:
    """Cells (h, w) of `size` pixels within reach of the images of points (N, 3), the next ones at least."""
    hit = np.zeros(shape, np.uint8)
    if not len(xyz_m):
        return hit.astype(bool)
    xy = camera.project(xyz_m)
    at = np.floor(xy[camera.sees(xy)] / size).astype(int)
    at = at[(at >= 0).all(axis=1) & (at[:, 0] < shape[1]) & (at[:, 1] < shape[0])]
    hit[at[:, 1], at[:, 0]] = 1
    depth = max(float(np.median(camera.to_camera(xyz_m)[:, 2])), reach_m)
    radius = max(1, round(reach_m * camera.focal_px / depth / size))
    return cv2.dilate(hit, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))).astype(bool)


def _clicked_limbs(
    footage: Footage, backgrounds: Mapping[int, CellBackground], clouds: Sequence[PointCloud], frames: list[int]
) -> dict[int, np.ndarray]:
    """Cells (h, w) of every view along those clicked limbs that look like the background in the click's frame, and were not measured."""
    take = footage.take
    masks = {k: np.zeros(b.grey.shape, bool) for k, b in backgrounds.items()}
    skeleton = read_model(str(take.joints_model)).skeleton
    for clicked in (take.clicks, *take.keyframes):
        if clicked.joints and clicked.frame in footage.frames:
            images = footage.read(clicked.frame)
            points = clouds[frames.index(clicked.frame)].xyz_m if clicked.frame in frames else np.zeros((0, 3))
            for k, background in backgrounds.items():
                size = background.cell_px
                seen = near_points(footage.rig.cameras[k], points, background.grey.shape, size, CELL_M)
                shown = person(background, cells(images[k], size), seen)
                if shown is not None:
                    _add_still(masks[k], _lines(skeleton, clicked, footage.rig, take.views[k].name, size), ~(shown | seen))
    return masks


def _lines(skeleton: Skeleton, clicked: FrameClicks, rig: Rig, view: str, size: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The lines from clicked joint to clicked joint in a view, in cells; a joint clicked in two other views is projected into it."""
    at = {}
    for joint, pixels in clicked.joints.items():
        if view in pixels:
            at[joint] = pixels[view] / size
        elif len(pixels) > 1:
            place = intersect_clicks([rig[v] for v in pixels], np.array([list(pixels.values())])).xyz_m
            xy = rig[view].project(place)[0]
            if np.isfinite(xy).all():
                at[joint] = xy / size
    return [(at[b.head_joint], at[b.tail_joint]) for b in skeleton.bones if b.head_joint in at and b.tail_joint in at]


def _add_still(mask: np.ndarray, lines: Sequence[tuple[np.ndarray, np.ndarray]], shown: np.ndarray) -> None:
    """Add to a mask (h, w) the lines along which the image looks like the background, as bands (`BAND`)."""
    if not lines:
        return
    width = max(2, round(BAND * float(np.mean([np.linalg.norm(a - b) for a, b in lines]))))
    for line in lines:
        a, b = (np.rint(end).astype(int).tolist() for end in line)
        middle, band = (cv2.line(np.zeros(mask.shape, np.uint8), a, b, 1, thickness) > 0 for thickness in (1, width))
        if (shown & middle).sum() > STILL * middle.sum():
            mask |= band
