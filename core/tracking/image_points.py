"""Points of the person followed in the images of one view by themselves, from frame to frame.

They need no second view, and so are what there is between cameras all around a person, whose pictures are not alike. Corners (Shi & Tomasi
1994) are followed by pyramidal Lucas-Kanade matching (Bouguet 2000; both OpenCV's), forwards and back again; a point that does not return
to where it was is given up, and new corners take its place.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..foundation.progress import Monitor

MOST = 300  # points of a view
APART_PX, PATCH_PX, LEVELS = 7, 15, 4
QUALITY = 0.02  # of the best corner's smaller eigenvalue
RETURN_PX = 0.4
SIGMA_PX = 0.3  # of a step


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ImageStep:
    """N points that were followed from one frame to the next, full-frame pixels."""

    from_px: np.ndarray  # (N, 2) float32
    to_px: np.ndarray  # (N, 2) float32


def followed(
    read: Callable[[int], np.ndarray], frames: Sequence[int], person: Callable[[int], np.ndarray], monitor: Monitor
) -> Iterator[ImageStep]:
    """The steps from each of T frames to the next (T − 1). `read` gives the grey image (h, w) of a frame, `person` where (h, w) the person
    is in it.

    Raises:
        Cancelled: the user asked to stop.
    """
    before, points = _eight_bits(read(frames[0])), np.zeros((0, 2), np.float32)
    for i, frame in enumerate(frames[1:]):
        monitor.step("follow points", i, len(frames) - 1)
        points = _renewed(before, points, person(frames[i]))
        now = _eight_bits(read(frame))
        there, back_again = _there_and_back(before, now, points)
        yield ImageStep(from_px=points[back_again], to_px=there[back_again])
        before, points = now, there[back_again]


def _renewed(image: np.ndarray, points: np.ndarray, person: np.ndarray) -> np.ndarray:
    """The points (N, 2) on the person, and new corners between them."""
    free = person.astype(np.uint8)
    at = np.rint(points).astype(int)
    inside = (at >= 0).all(axis=1) & (at < image.shape[::-1]).all(axis=1)
    inside[inside] = free[at[inside, 1], at[inside, 0]] > 0
    points, at = points[inside], at[inside]
    for x, y in at.tolist():
        cv2.circle(free, (x, y), APART_PX, 0, -1)
    wanted = MOST - len(points)
    found = cv2.goodFeaturesToTrack(image, wanted, QUALITY, APART_PX, mask=free, blockSize=APART_PX) if wanted > 0 else None
    return points if found is None else np.concatenate([points, found.reshape(-1, 2)])


def _there_and_back(before: np.ndarray, now: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points (N, 2) are in the next image, and whether (N,) they return from there."""
    if not len(points):
        return points, np.zeros(0, dtype=bool)
    given = {"winSize": (PATCH_PX, PATCH_PX), "maxLevel": LEVELS}
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, points, None, **given)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None, **given)
    near = np.linalg.norm(back - points, axis=1) < RETURN_PX
    return there, near & (found.ravel() == 1) & (returned.ravel() == 1)


def _eight_bits(image: np.ndarray) -> np.ndarray:
    return np.clip(image, 0, 255).astype(np.uint8)
