"""Least squares matching of one point, as D'Apuzzo et al. 1999 (Fig. 3) and 2000 (Fig. 2) show it: its patch in every view, at the start of
matching in black and as it was found in white."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from .drawing import GROUND, with_strip, with_title
from .pictures import colour

SIDE_PX = 300  # of a view's part
AROUND = 2.4  # size of the part that is shown, by that of the patch
LETTERS = 1.3  # their size
MOST_VIEWS = 3
START, FOUND = (0, 0, 0), (255, 255, 255)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MatchedPatch:
    """A point's patch in some views, the template first. Full-frame pixels."""

    frame: int
    views: tuple[int, ...]
    start_px: np.ndarray  # (K, 4, 2) corners
    found_px: np.ndarray  # (K, 4, 2)
    px_per_m: np.ndarray  # (K,) of the views where the point is


def patch_picture(patch: MatchedPatch, images: Sequence[np.ndarray], names: Sequence[str]) -> tuple[str, np.ndarray]:
    """The caption and the picture. `images` (h, w) and `names` are those of all views."""
    both = np.concatenate([patch.start_px, patch.found_px], axis=1)
    zoom = SIDE_PX / (AROUND * float(np.ptp(both, axis=1).max()))
    panels = [
        _panel(images[k], patch.start_px[n], patch.found_px[n], zoom, patch.px_per_m[n], f"view {names[k]}")
        for n, k in enumerate(patch.views)
    ]
    caption = (
        f"Frame {patch.frame}: least squares matching of one point. Black: its patch at the start, as on a surface that faces view "
        f"{names[patch.views[0]]}; white: the patch that was found"
    )
    return caption, np.hstack(panels)


def _panel(image: np.ndarray, start: np.ndarray, found: np.ndarray, zoom: float, px_per_m: float, name: str) -> np.ndarray:
    """The part of an image around a patch, enlarged, with both outlines (4, 2)."""
    middle = found.mean(axis=0)
    shift = SIDE_PX / 2 - zoom * middle
    to_part = np.array([[zoom, 0, shift[0]], [0, zoom, shift[1]]])
    size, image = (SIDE_PX, SIDE_PX), np.asarray(image, np.float32)
    grey = cv2.warpAffine(image, to_part, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    panel = colour(np.clip(grey, 0, 255))
    for corners, tint in ((start, START), (found, FOUND)):
        outline = np.rint(8 * (corners * zoom + shift)).astype(np.int32)
        cv2.polylines(panel, [outline], True, tint, 2, cv2.LINE_AA, 3)
    panel = with_title(with_strip(panel, zoom * px_per_m, size=LETTERS), name, LETTERS)
    panel[:, -1] = GROUND
    return panel
