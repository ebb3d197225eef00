"""Close-ups: the part of a view about the person, in one size for all frames, and the camera of that part.

Pictures of a report show the person as large as they can, in the same size and to the same scale in all frames of a view.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..geometry.camera import Camera

MARGIN = 1.2  # of a window about the largest extent of the person
LEAST_POINTS = 5  # that show where the person is
TAILS = (0.5, 99.5)  # percentiles of the points, between which the person is
NARROWEST, BROADEST = 0.75, 1.5  # width by height of a window
SIDE_PX = 640  # of a picture's longer side


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Detail:
    """A part of one image: its corner [px of the image], the camera of the part, and how much larger it is than in the image."""

    camera: Camera
    corner_px: np.ndarray  # (2,) of the part's first pixel, whole numbers
    part_px: tuple[int, int]  # width, height in the image
    scale: float

    def image(self, grey: np.ndarray) -> np.ndarray:
        """The part (h, w) of an image, resized."""
        (x, y), (w, h) = self.corner_px, self.part_px
        way = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(grey[y : y + h, x : x + w].astype(np.float32), self.camera.size_px, interpolation=way))

    def pixels(self, xy_px: np.ndarray) -> np.ndarray:
        """Pixels (…, 2) of the image as pixels of the part."""
        return np.asarray((xy_px - self.corner_px + 0.5) * (np.array(self.camera.size_px) / self.part_px) - 0.5)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CloseUp:
    """Windows of one size in one view."""

    camera: Camera
    part_px: tuple[int, int]
    side_px: int = SIDE_PX

    def around(self, xyz_m: np.ndarray) -> Detail:
        """The window about points (N, 3), within the image; in its middle if too few are visible."""
        (w, h), size = self.part_px, np.array(self.camera.size_px)
        box = _box(self.camera, xyz_m)
        middle = size / 2 if box is None else box.mean(axis=0) + 0.5
        corner = np.clip(np.rint(middle - np.array([w, h]) / 2), 0, size - (w, h)).astype(int)
        matrix = self.camera.matrix.copy()
        matrix[:2, 2] -= corner
        scale = self.side_px / max(w, h)
        part = replace(self.camera, size_px=(w, h), matrix=matrix).resized((max(1, round(w * scale)), max(1, round(h * scale))))
        return Detail(camera=part, corner_px=corner, part_px=(w, h), scale=scale)


def close_up(camera: Camera, frames: Sequence[np.ndarray], side_px: int = SIDE_PX) -> CloseUp:
    """Windows in which the points (N, 3) of any of the frames find room; the whole image if no frame has points in it."""
    boxes = [box for xyz in frames if (box := _box(camera, xyz)) is not None]
    width, height = camera.size_px
    if not boxes:
        return CloseUp(camera=camera, part_px=(width, height), side_px=side_px)
    w, h = MARGIN * np.max([np.ptp(box, axis=0) for box in boxes], axis=0) + 1
    wanted = float(np.clip(w / h, NARROWEST, BROADEST))
    w, h = max(w, wanted * h), max(h, w / wanted)
    return CloseUp(camera=camera, part_px=(min(width, int(np.ceil(w))), min(height, int(np.ceil(h)))), side_px=side_px)


def alike(views: Sequence[CloseUp]) -> list[CloseUp]:
    """Windows of one size in views whose images are of one size: their pictures are beside each other."""
    if len({view.camera.size_px for view in views}) > 1:
        return list(views)
    w, h = np.max([view.part_px for view in views], axis=0).tolist()
    return [replace(view, part_px=(w, h)) for view in views]


def _box(camera: Camera, xyz_m: np.ndarray) -> np.ndarray | None:
    """The box (2, 2) of points in the image: its least and its greatest pixel; None for too few."""
    xy = camera.project(xyz_m).reshape(-1, 2)
    xy = xy[camera.sees(xy)]
    return np.percentile(xy, TAILS, axis=0) if len(xy) >= LEAST_POINTS else None
