"""The empty background of a view by the user's image of it, and where another image shows it.

An image shows the background at a pixel where the two differ by no more than the noise in a window around it. The noise is that of the
quarter of the image that differs least. An image that is black, or in another light, shows the background nowhere.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ..foundation.arrays import frozen

WINDOW_PX = 7  # side of the window in which two images are compared
LOOSE = 1.6  # times the noise: a window of 7×7 has a root mean square of 1.0 ± 0.1 times it
QUANTISED = 0.5  # grey values: what rounding adds
EMPTY_SHARE = 0.25  # of an image that shows the background, whoever is in front of it
OTHER_ROOM = 20.0  # grey values: noise of an image that does not show this background


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Background:
    """The static background (h, w) of a view, and the standard deviation of an image from it, in grey values."""

    grey: np.ndarray
    noise: float

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
