"""The static background of a view: the median of each pixel over time, or over the times at which nobody is near it.

An image shows the background at a pixel where the two differ by no more than the noise in a window around it. The noise is estimated from
the images that the background is made from, most of whose pixels are background (median of absolute differences, Rousseeuw & Croux 1993).
An image that is black, or in another light, shows the background nowhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..foundation.arrays import frozen
from ..geometry.robust import mad_sigma

FEWEST = 5  # images for a background
FEWEST_BARE = 3  # of these, without anybody near the pixel
ROWS = 64  # processed at a time
WINDOW_PX = 7  # side of the window in which two images are compared
LOOSE = 1.6  # times the noise: a window of 7×7 has a root mean square of 1.0 ± 0.1 times it
QUANTISED = 0.5  # grey values: what rounding adds
EMPTY_SHARE = 0.25  # of an image that shows the background, whoever is in front of it
OTHER_ROOM = 20.0  # grey values: noise of an image that does not show this background


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Background:
    """The static background (h, w) of a view, and the standard deviation of an image from it, in grey values.

    `bare` (h, w): where it was visible with nobody near; None if positions of persons are not known.
    """

    grey: np.ndarray
    noise: float
    bare: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "grey", frozen(self.grey, (None, None), np.float32, "grey"))

    def shown_by(self, image: np.ndarray) -> np.ndarray:
        """Where (h, w) an image shows the background."""
        square = cv2.blur((image.astype(np.float32) - self.grey) ** 2, (WINDOW_PX, WINDOW_PX), borderType=cv2.BORDER_REFLECT_101)
        return np.asarray(square < (LOOSE * self.noise + QUANTISED) ** 2)


def empty_view(grey: np.ndarray, image: np.ndarray) -> Background:
    """A given image of the background (h, w), with its noise from another `image` of which at least a quarter shows it."""
    difference = image.astype(np.float32) - grey.astype(np.float32)
    square = cv2.blur(difference**2, (WINDOW_PX, WINDOW_PX), borderType=cv2.BORDER_REFLECT_101)
    return Background(grey=grey, noise=float(np.sqrt(np.quantile(square, EMPTY_SHARE))))


def known_background(grey: np.ndarray, images: Sequence[np.ndarray]) -> Background | None:
    """A given image of the background (h, w), with its noise from those of the `images` that show it; None if none does."""
    noise = [n for n in (empty_view(grey, image).noise for image in images) if n <= OTHER_ROOM]
    return Background(grey=grey, noise=float(np.median(noise)), bare=np.ones(grey.shape, dtype=bool)) if noise else None


def still_background(images: Sequence[np.ndarray], near: Sequence[np.ndarray] | None = None) -> Background | None:
    """The median of images (h, w) spread over time; None if there are too few.

    `near` (h, w) of each: where somebody is near. Pixels that are bare in enough images are taken from these images alone.
    """
    if len(images) < FEWEST:
        return None
    median = np.empty(images[0].shape, np.float32)
    bare = None if near is None else np.zeros(median.shape, dtype=bool)
    for row in range(0, len(median), ROWS):  # piece by piece: a copy of all images would take too much memory
        part = slice(row, row + ROWS)
        stack = np.array([image[part] for image in images], dtype=np.float32)
        median[part] = np.median(stack, axis=0)
        if near is not None and bare is not None:
            stack[np.array([there[part] for there in near])] = np.nan
            bare[part] = np.isfinite(stack).sum(axis=0) >= FEWEST_BARE
            median[part][bare[part]] = np.nanmedian(stack[:, bare[part]], axis=0)
    noise = np.median([mad_sigma(image - median) for image in images])
    return Background(grey=median, noise=float(noise), bare=bare)
