"""Background regions of the views, frame by frame, as observations of a body: no limb is there.

Only limbs whose pose must be observed take part; and, with a larger sigma, the middle of a hand, whose prior is a straight wrist: the tip
of a bent one would pull its forearm.

A pixel is background when it shows what the view's `background` image in take.toml shows; without such an image, what it shows when no
measured point is near, or most of the time (`images.background`). A person may stand still most of the time, too: so without the image
nothing near a measured point is background. Nor is anything along clicked limbs where the pixels have not changed since the click.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path

import cv2
import numpy as np

from ...body.model_file import read_model
from ...body.skeleton import Skeleton
from ...foundation.errors import InputError
from ...foundation.progress import Monitor
from ...geometry.camera import Camera
from ...images.background import Background, known_background, still_background
from ...surface.cloud import PointCloud
from ...take.sources import read_picture
from ...take.take import Footage, FrameClicks
from ..observations import BackgroundExclusion
from ..observations.background import DistanceMap
from ..settings import FitSettings
from ..state import ShapeParameters, free_bones
from .fit_input import BackgroundDistances, FitInput, Packed

FRACTIONS = (0.2, 0.5, 0.8, 1.0)  # of a bone's axis, where its places are
SAMPLES = 11  # frames for a view's background
STEP_PX, UNIT_PX = 4, 0.5  # size of a square, unit of stored distances
SPECK = 9  # squares: noise in one window of the comparison affects no more
STILL = 0.25  # of a limb's line looks like the background, if the limb stands still
LIMB_M = 0.06  # nothing so near to a measured point or a clicked limb is background
BAND = 0.5  # width of a clicked limb over the mean length of the limbs
HAND_FRACTION, HAND_SIGMA = 0.5, 3.0  # of a hand's axis; its sigma over that of the outline


class BackgroundRegions:
    """The background regions of all views in all frames."""

    def __init__(self, given: FitInput, parameters: ShapeParameters, settings: FitSettings) -> None:
        skeleton = parameters.skeleton
        names = {joint: i for i, joint in enumerate(skeleton.joint_names)}
        free = free_bones(parameters)
        ends = ~free & free[skeleton.parents] & ~np.isin(np.arange(len(free)), skeleton.parents)
        places = [(bone, along, 1.0) for bone, observed in zip(skeleton.bones, free) if observed for along in FRACTIONS]
        places += [(bone, HAND_FRACTION, HAND_SIGMA) for bone, last in zip(skeleton.bones, ends) if last and bone.dofs]
        self._head = np.array([names[bone.head_joint] for bone, _, _ in places], dtype=np.intp)
        self._tail = np.array([names[bone.tail_joint] for bone, _, _ in places], dtype=np.intp)
        self._fraction = np.array([along for _, along, _ in places])
        self._sigma_px = settings.background_sigma_px * np.array([wider for _, _, wider in places])
        self._given = given.background if settings.use_background else ()
        self._rig, self._frames = given.rig, given.frames

    def stretch(self, frames: Sequence[int]) -> "BackgroundRegions":
        """Those of some of the frames."""
        part = copy(self)
        part._frames = [self._frames[t] for t in frames]
        return part

    def observe(self, t: int) -> list[BackgroundExclusion]:
        """The observations of frame index `t`; none where no background is known."""
        views = [
            DistanceMap(camera=self._rig[v.view], values_px=d * v.unit_px, step_px=v.step_px, first_px=(v.step_px - 1) / 2)
            for v in self._given
            if (d := v.of_frame(self._frames[t])) is not None
        ]
        if not views:
            return []
        return [BackgroundExclusion(views=views, head=self._head, tail=self._tail, fraction=self._fraction, sigma_px=self._sigma_px)]


def find_background(footage: Footage, clouds: Sequence[PointCloud], monitor: Monitor) -> list[BackgroundDistances]:
    """The background regions in the frames of the clouds, of the views whose background is known.

    Raises:
        InputError: an image cannot be read, or the background in take.toml is not that of the view.
        Cancelled: the user asked to stop.
    """
    frames = np.array([cloud.frame for cloud in clouds])
    known = {k: b for k, b in enumerate(still_backgrounds(footage, frames, clouds)) if b is not None}
    distances = {k: Packed() for k in known}
    if not known:
        return []
    persons = _clicked_limbs(footage, known)
    bare = {k: _coarse(b.bare) if b.bare is not None else np.False_ for k, b in known.items()}
    for t, cloud in enumerate(clouds):
        monitor.step("background", t, len(clouds))
        images = footage.read(cloud.frame)
        for k, background in known.items():
            away = bare[k] | ~_near(footage.rig.cameras[k], cloud.xyz_m, persons[k].shape)
            background_px = _shown(background, images[k]) & ~persons[k] & away
            squares = cv2.distanceTransform(background_px.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)  # infinite if all is background
            distances[k].append((np.minimum(squares, 255 * UNIT_PX / STEP_PX) * (STEP_PX / UNIT_PX)).astype(np.uint8))
    return [
        BackgroundDistances(view=footage.take.views[k].name, frame=frames, distance=d, step_px=STEP_PX, unit_px=UNIT_PX)
        for k, d in distances.items()
    ]


def still_backgrounds(footage: Footage, frames: np.ndarray, clouds: Sequence[PointCloud] | None = None) -> list[Background | None]:
    """The still background of every view: the image of it in take.toml, or from some of the frames (T,); None where they are too few.

    `clouds` (T,): the measured points of the person. A frame without points does not show where the background is.

    Raises:
        InputError: an image cannot be read, or the one in take.toml is not that of the view.
    """
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(SAMPLES, len(frames))).round().astype(int)).tolist()
    persons = [] if clouds is None else [clouds[t].xyz_m for t in chosen]
    found = list[Background | None]()
    for k, (s, camera, view) in enumerate(zip(footage.sequences, footage.rig.cameras, footage.take.views)):
        images = [s.read(footage.number(k, int(frames[t]))) for t in chosen]
        if view.background is not None:
            found.append(_background_of(footage.take.folder / view.background, view.name, images))
            continue
        near = [_near_pixels(camera, xyz_m, images[0].shape) for xyz_m in persons] if any(map(len, persons)) else None
        found.append(still_background(images, near))
    return found


def _background_of(path: Path, view: str, images: Sequence[np.ndarray]) -> Background:
    """The background of a view by the user's own image of it.

    Raises:
        InputError: it cannot be read, is of another size, or none of the images shows it.
    """
    known = known_background(read_picture(path, view, (images[0].shape[1], images[0].shape[0])), images)
    if known is None:
        raise InputError(f"The background image {path} is nothing like view {view} in any frame; take it with the same camera and light.")
    return known


def _coarse(mask: np.ndarray) -> np.ndarray:
    """The squares of `STEP_PX` that lie wholly in a mask (h, w)."""
    h, w = (n // STEP_PX * STEP_PX for n in mask.shape)
    return np.asarray(mask[:h, :w].reshape(h // STEP_PX, STEP_PX, w // STEP_PX, STEP_PX).all(axis=(1, 3)))


def _shown(background: Background, image: np.ndarray) -> np.ndarray:
    """The squares (h, w) in which an image shows the background, and the specks between them, smaller than a hand."""
    whole = _coarse(background.shown_by(image))
    _, label, stats, _ = cv2.connectedComponentsWithStats((~whole).astype(np.uint8), connectivity=8)
    small = stats[:, cv2.CC_STAT_AREA] < SPECK
    return np.asarray(whole | small[label])


def _near(camera: Camera, xyz_m: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Squares (h, w) near the images of points (N, 3)."""
    hit = np.zeros(shape, np.uint8)
    if not len(xyz_m):
        return hit.astype(bool)
    xy = camera.project(xyz_m)
    at = np.floor(xy[camera.sees(xy)] / STEP_PX).astype(int)
    at = at[(at >= 0).all(axis=1) & (at[:, 0] < shape[1]) & (at[:, 1] < shape[0])]
    hit[at[:, 1], at[:, 0]] = 1
    radius = max(1, round(LIMB_M * camera.focal_px / float(np.median(camera.to_camera(xyz_m)[:, 2])) / STEP_PX))
    return cv2.dilate(hit, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))).astype(bool)


def _near_pixels(camera: Camera, xyz_m: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Pixels (h, w) near the images of points (N, 3); all pixels if there are no points."""
    if not len(xyz_m):
        return np.ones(shape, dtype=bool)
    squares = _near(camera, xyz_m, tuple(-(-n // STEP_PX) for n in shape))
    return squares.repeat(STEP_PX, axis=0).repeat(STEP_PX, axis=1)[: shape[0], : shape[1]]


def _clicked_limbs(footage: Footage, backgrounds: Mapping[int, Background]) -> dict[int, np.ndarray]:
    """Squares (h, w) of every view along those clicked limbs that look like the background in the click's frame."""
    take = footage.take
    masks = {k: np.zeros(_coarse(b.grey > 0).shape, bool) for k, b in backgrounds.items()}
    skeleton = read_model(str(take.body_model)).skeleton
    for clicked in (take.clicks, *take.keyframes):
        if clicked.joints and clicked.frame in footage.frames:
            images = footage.read(clicked.frame)
            for k, background in backgrounds.items():
                _add_still(masks[k], _lines(skeleton, clicked, take.views[k].name), _shown(background, images[k]))
    return masks


def _lines(skeleton: Skeleton, clicked: FrameClicks, view: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """The lines from clicked joint to clicked joint, in squares."""
    at = {joint: pixels[view] / STEP_PX for joint, pixels in clicked.joints.items() if view in pixels}
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
