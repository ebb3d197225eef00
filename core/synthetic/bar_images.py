"""Pictures of a waved bar: two bright round targets, the dim bar between them, reflections that stand still, blur and noise.

Targets are drawn as hard discs on a grid eight times as fine, averaged over the pixels and blurred: nothing of the measuring model is used.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from .. import store
from .bar import WavedBar

FINE = 8


@dataclass(frozen=True, kw_only=True, slots=True)
class BarPictures:
    """How the pictures look."""

    radius_m: float = 0.011
    background: float = 14.0
    target: float = 220.0
    bar: float = 30.0
    blur_px: float = 0.7
    noise: float = 1.0
    reflections: int = 3


def draw_disc(image: np.ndarray, xy_px: np.ndarray, radius_px: float, grey: float, blur_px: float, squeeze: float = 1.0) -> None:
    """Draw a disc, `squeeze` as high as wide, into an image (h, w) float32; only within the image."""
    reach = int(np.ceil(radius_px + 4 * blur_px)) + 2
    x0, y0 = np.round(xy_px).astype(int) - reach
    n = 2 * reach + 1
    grid = (np.arange(n * FINE) + 0.5) / FINE - 0.5
    dx, dy = grid[None, :] - (xy_px[0] - x0), (grid[:, None] - (xy_px[1] - y0)) / squeeze
    cover = (dx**2 + dy**2 <= radius_px**2).astype(np.float32).reshape(n, FINE, n, FINE).mean(axis=(1, 3))
    cover = cv2.GaussianBlur(cover, (0, 0), blur_px) if blur_px else cover
    h, w = image.shape
    top, left, bottom, right = max(y0, 0), max(x0, 0), min(y0 + n, h), min(x0 + n, w)
    if top < bottom and left < right:
        part = cover[top - y0 : bottom - y0, left - x0 : right - x0]
        image[top:bottom, left:right] += part * (grey - image[top:bottom, left:right])


def picture(waved: WavedBar, position: int, camera: int, look: BarPictures, rng: np.random.Generator) -> np.ndarray:
    """The picture (h, w) uint8 of one position; ends that are missing in `waved.xy_px` are hidden."""
    seen = waved.cameras[camera]
    w, h = seen.size_px
    image = np.full((h, w), look.background, np.float32)
    still = np.random.default_rng(camera)
    for _ in range(look.reflections):
        draw_disc(image, still.uniform((20, 20), (w - 20, h - 20)), still.uniform(1.0, 2.5), still.uniform(40, 200), look.blur_px)
    ends = waved.ends_m[position]
    line = seen.project(np.linspace(ends[0], ends[1], 40))
    cv2.polylines(image, [np.round(line * 16).astype(np.int32)], False, look.bar, 2, cv2.LINE_AA, 4)
    for end in range(2):
        if np.isfinite(waved.xy_px[position, camera, end]).all():
            depth = seen.to_camera(ends[end])[2]
            draw_disc(image, seen.project(ends[end]), look.radius_m * seen.focal_px / depth, look.target, look.blur_px)
    return np.clip(np.round(image + rng.normal(0, look.noise, image.shape)), 0, 255).astype(np.uint8)


def write_bar_folder(folder: Path, waved: WavedBar, look: BarPictures, seed: int = 0) -> None:
    """Write BARDIR: a folder of PNG files per camera."""
    rng = np.random.default_rng(seed)
    for c, camera in enumerate(waved.cameras):
        for n in range(len(waved.ends_m)):
            _, data = cv2.imencode(".png", picture(waved, n, c, look, rng))
            store.write_bytes(folder / camera.name / f"{n:04d}.png", data.tobytes())
