"""Images of a view with a time offset, interpolated to the moment of the other views along the motion of every pixel.

    d(x) = −τ (f₊ − f₋) / 2 + τ² (f₊ + f₋) / 2 ,   J(x + d(x)) = I(x)                          (1)

f₊, f₋: optical flow from the image I to the next one and to the one before (Kroeger et al. 2016, doi:10.1007/978-3-319-46493-0_29); τ:
delay of I in frames, |τ| ≤ ½ or so; the parabola through three positions models acceleration. At the ends of the recording the only flow is
extrapolated linearly. Surfaces that are uncovered between two images cannot be interpolated; they are at outlines, where nothing is
measured.
"""

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..foundation.settings import knob
from .sampling import SplineImage
from .sequence import ImageSequence

LARGEST = 0.75  # frames: larger offsets are not corrected
STEPS = 4  # of the inversion of (1)
CACHED = 4  # images


@dataclass(frozen=True, kw_only=True, slots=True)
class TimingSettings:
    """Views that are not synchronised."""

    correct: bool = knob(
        False, "Estimate the time offset of each view, and interpolate its images to the moment of the others along the motion."
    )


def retimed(grey: np.ndarray, before: np.ndarray | None, after: np.ndarray | None, delay_frames: float | np.ndarray) -> np.ndarray:
    """The image (h, w) float32 as it was `delay_frames` earlier, all of it or each of its rows (h,), which a rolling shutter exposes one
    after another; `before` and `after` are its neighbours in time.  (1)"""
    delay_frames = np.asarray(delay_frames, dtype=np.float32).reshape(-1, 1, 1)
    forward, back = (None if other is None else _flow(grey, other) for other in (after, before))
    if forward is None or back is None:
        only = forward if forward is not None else -back if back is not None else np.zeros((*grey.shape, 2), np.float32)
        d = -delay_frames * only
    else:
        d = -delay_frames * (forward - back) / 2 + delay_frames**2 * (forward + back) / 2
    h, w = grey.shape
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    u, v = x, y
    for _ in range(STEPS):
        at = cv2.remap(d.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        u, v = x - at[..., 0], y - at[..., 1]
    return np.asarray(SplineImage(grey).sample(np.clip(u, 0, w - 1), np.clip(v, 0, h - 1)))


def _flow(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    low, high = np.percentile(here, [0.5, 99.5])
    scale = 255.0 / max(float(high - low), 1.0)
    eight_bits = [np.clip((p - low) * scale, 0, 255).astype(np.uint8) for p in (here, there)]
    method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    method.setFinestScale(0)
    return np.asarray(method.calc(eight_bits[0], eight_bits[1], None))


class Recent:
    """A sequence that caches its last images, so that neighbours in time are not decoded again."""

    def __init__(self, sequence: ImageSequence) -> None:
        self._sequence = sequence
        self._cache: OrderedDict[int, np.ndarray] = OrderedDict()

    @property
    def behind(self) -> ImageSequence:
        """The underlying sequence."""
        return self._sequence

    @property
    def count(self) -> int:
        """Number of frames."""
        return self._sequence.count

    @property
    def source(self) -> str:
        """Where the frames come from."""
        return self._sequence.source

    def files(self) -> tuple[Path, ...]:
        """The files behind the frames."""
        return self._sequence.files()

    def read_colour(self, index: int) -> np.ndarray:
        """RGB values (h, w, 3) float32 of frame `index`."""
        return self._sequence.read_colour(index)

    def read(self, index: int) -> np.ndarray:
        """Grey values (h, w) float32 of frame `index`."""
        if index not in self._cache:
            self._cache[index] = self._sequence.read(index)
            while len(self._cache) > CACHED:
                self._cache.popitem(last=False)
        return self._cache[index]
