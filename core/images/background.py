"""The still background of a view: what each pixel shows most of the time, and where an image shows it again.

A pixel shows the background when the images around it differ from the background's by no more than the noise; that noise is found from the
differences themselves, since most of an image is background (Rousseeuw & Croux 1993, the median of absolute differences).
"""

from collections.abc import Sequence

import cv2
import numpy as np

FEWEST = 5  # images that tell what stands still
WINDOW_PX = 7  # side of the window in which two images are compared
LOOSE = 1.6  # times the noise: a window of 7×7 has a root mean square of 1.0 ± 0.1 times it
QUANTISED = 0.5  # grey values: what rounding adds


def still_background(images: Sequence[np.ndarray]) -> np.ndarray | None:
    """The median (h, w) float32 of images (h, w) spread over time; None if they are too few to tell."""
    return np.median(np.stack(images), axis=0).astype(np.float32) if len(images) >= FEWEST else None


def shows(background: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Where (h, w) an image shows the background."""
    difference = image.astype(np.float32) - background
    noise = 1.4826 * float(np.median(np.abs(difference)))
    square = cv2.blur(difference**2, (WINDOW_PX, WINDOW_PX), borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(square < (LOOSE * noise + QUANTISED) ** 2)
