"""Combing: whether images that are taken as progressive consist of two fields, exposed one after the other, and which came first.

Where something moves, the rows of the other field show it elsewhere. Neighbouring rows (from different fields) then differ more than rows
at a distance of two (from one field). In a progressive image it is the reverse, as its structure function grows with distance, and noise
alone makes both equal. So with the differences of the rows summed over the pixels M that move,

    comb = Σ_M (I_r − I_{r+1})² / Σ_M (I_r − I_{r+2})²                                                                  (1)

is above one only for interlaced images. The field of image t that is nearer in time to the other field of image t + 1 was exposed second.
"""

from dataclasses import dataclass

import cv2
import numpy as np

MOVING = 12.0  # grey values between two images, of 0…255: more than noise and compression
FEWEST_PIXELS = 300  # that move, for a judgement
COMBED = 1.3  # (1) above this: interlaced
BLUR_PX = 9
CLEAR = 1.1  # between the differences of the two orders of the fields


@dataclass(frozen=True, kw_only=True, slots=True)
class Combing:
    """`ratio`: (1), the median over pairs of images, NaN where too little moves; `first`: the field exposed first (“odd”: the lines
    1, 3, 5, … counted from one), "" where that is not clear."""

    ratio: float
    first: str = ""

    @property
    def found(self) -> bool:
        """Whether the images consist of two fields."""
        return bool(self.ratio > COMBED)


def combing(pairs: list[tuple[np.ndarray, np.ndarray]]) -> Combing:
    """The combing in pairs of successive images, (h, w) each, grey values 0…255."""
    ratios, differences = [], []
    for now, following in pairs:
        now, following = (image[: len(image) // 2 * 2].astype(np.float64) for image in (now, following))
        moving = np.abs(now - following) > MOVING
        inside = moving[:-2] & moving[1:-1] & moving[2:]
        if inside.sum() < FEWEST_PIXELS:
            continue
        near, far = np.diff(now, axis=0)[:-1][inside], (now[:-2] - now[2:])[inside]
        ratios.append(float(np.sum(near**2) / max(np.sum(far**2), 1e-9)))
        differences.append([_difference(now, following, moving, parity) for parity in (1, 0)])
    if not ratios:
        return Combing(ratio=float("nan"))
    odd_first, even_first = np.sum(differences, axis=0)  # small where the fields are neighbours in time
    first = "odd" if even_first > CLEAR * odd_first else "even" if odd_first > CLEAR * even_first else ""
    return Combing(ratio=float(np.median(ratios)), first=first)


def _difference(now: np.ndarray, following: np.ndarray, moving: np.ndarray, parity: int) -> float:
    """The sum of squared differences where something moves: rows of this parity now, against the other rows in the next image. They are
    blurred along the rows first, so that what moves by several pixels is still like itself."""
    now, following = (cv2.blur(image, (BLUR_PX, 1)) for image in (now, following))
    between = 0.5 * (following[:-2] + following[2:])  # at rows 1, 2, …
    rows = slice(1 - parity, None, 2)  # those of `parity` among them
    return float(np.sum(((now[1:-1] - between) ** 2)[rows][moving[1:-1][rows]]))
