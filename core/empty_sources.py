"""Where the views show the still background and so no part of the person, for the fit.

A pixel is empty when it shows what it shows most of the time (`images.background`). What stands still may also be the person: nothing
is empty near a measured point, nor along the clicked limbs if the pixels there have not changed since the click.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from .body.model_file import read_model
from .body.skeleton import Skeleton
from .fitting.fit_input import EmptyView, Packed
from .geometry.camera import Camera
from .images.background import Background, still_background
from .progress import Monitor
from .surface.cloud import PointCloud
from .take import Footage, Seeds

SAMPLES = 11  # frames for the background
STEP_PX, UNIT_PX = 4, 0.5
LIMB_M = 0.06  # nothing is empty so near to a measured point or a clicked limb


def find_empty(footage: Footage, clouds: Sequence[PointCloud], monitor: Monitor) -> list[EmptyView]:
    """The empty parts of all views in the frames of the clouds; none if the frames are too few to tell the background.

    Raises:
        InputError: an image cannot be read.
        Cancelled: the user asked to stop.
    """
    frames = np.array([cloud.frame for cloud in clouds])
    backgrounds = still_backgrounds(footage, frames)
    distances = [Packed() for _ in backgrounds]
    if any(b is None for b in backgrounds):
        return []
    known = [b for b in backgrounds if b is not None]
    persons = _clicked_limbs(footage, known)
    for t, cloud in enumerate(clouds):
        monitor.step("background", t, len(clouds))
        for k, (camera, image) in enumerate(zip(footage.rig.cameras, footage.read(cloud.frame))):
            empty = _coarse(known[k].shown_by(image)) & ~persons[k] & ~_near(camera, cloud.xyz_m, persons[k].shape)
            far = cv2.distanceTransform(empty.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) * (STEP_PX / UNIT_PX)
            distances[k].append(np.minimum(far, 255).astype(np.uint8))
    return [EmptyView(view=view.name, frame=frames, distance=d, step_px=STEP_PX, unit_px=UNIT_PX)
            for view, d in zip(footage.take.views, distances)]


def still_backgrounds(footage: Footage, frames: np.ndarray) -> list[Background | None]:
    """The still background of every view, from some of the frames (T,); None where they are too few to tell.

    Raises:
        InputError: an image cannot be read.
    """
    chosen = frames[np.unique(np.linspace(0, len(frames) - 1, min(SAMPLES, len(frames))).round().astype(int))].tolist()
    return [still_background([s.read(footage.number(k, frame)) for frame in chosen]) for k, s in enumerate(footage.sequences)]


def _coarse(mask: np.ndarray) -> np.ndarray:
    """The squares of `STEP_PX` that lie wholly in a mask (h, w), less single specks of what does not."""
    whole = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    h, w = (n // STEP_PX * STEP_PX for n in mask.shape)
    return np.asarray(whole[:h, :w].reshape(h // STEP_PX, STEP_PX, w // STEP_PX, STEP_PX).all(axis=(1, 3)))


def _near(camera: Camera, xyz_m: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Squares (h, w) near the images of points (N, 3)."""
    seen = np.zeros(shape, np.uint8)
    if not len(xyz_m):
        return seen.astype(bool)
    xy = camera.project(xyz_m)
    at = np.floor(xy[camera.sees(xy)] / STEP_PX).astype(int)
    at = at[(at >= 0).all(axis=1) & (at[:, 0] < shape[1]) & (at[:, 1] < shape[0])]
    seen[at[:, 1], at[:, 0]] = 1
    radius = max(1, round(LIMB_M * camera.focal_px / float(np.median(camera.to_camera(xyz_m)[:, 2])) / STEP_PX))
    return cv2.dilate(seen, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))).astype(bool)


def _clicked_limbs(footage: Footage, backgrounds: Sequence[Background]) -> list[np.ndarray]:
    """Squares (h, w) of every view along clicked limbs that look in the click's frame as they do most of the time."""
    take = footage.take
    masks = [np.zeros(_coarse(b.grey > 0).shape, bool) for b in backgrounds]
    skeleton = read_model(str(take.body_model)).skeleton
    for clicked in (take.seeds, *take.keyframes):
        if clicked.joints and clicked.frame in footage.frames:
            for mask, view, background, image in zip(masks, take.views, backgrounds, footage.read(clicked.frame)):
                mask |= _limbs(skeleton, clicked, view.name, mask.shape) & _coarse(background.shown_by(image))
    return masks


def _limbs(skeleton: Skeleton, clicked: Seeds, view: str, shape: tuple[int, ...]) -> np.ndarray:
    """Squares along the lines between clicked joints; a quarter of the mean line's length wide."""
    at = {joint: pixels[view] / STEP_PX for joint, pixels in clicked.joints.items() if view in pixels}
    lines = [(at[b.head_joint], at[b.tail_joint]) for b in skeleton.bones if b.head_joint in at and b.tail_joint in at]
    drawn = np.zeros(shape, np.uint8)
    width = max(2, round(0.5 * float(np.mean([np.linalg.norm(a - b) for a, b in lines])))) if lines else 1
    for a, b in lines:
        cv2.line(drawn, tuple(np.rint(a).astype(int).tolist()), tuple(np.rint(b).astype(int).tolist()), 1, width)
    return drawn.astype(bool)
