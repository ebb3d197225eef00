"""A waved reference bar in front of synthetic cameras: its image points with noise, gaps and gross errors, for tests and benchmarks.

The wave is a Lissajous figure through the volume with the bar turning through all directions; cameras are those of CALIBRATION's
benchmark (a row of three) or drawn at random: in a row, exactly in a row, parallel, in a triangle, wide apart.

Pictures of a waved bar: two bright round targets, the dim bar between them, reflections that stand still, blur and noise.

Targets are drawn as hard discs on a grid eight times as fine, averaged over the pixels and blurred: nothing of the measuring model is used.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..foundation import store
from ..foundation.arrays import frozen
from ..geometry.camera import Camera, camera_of

RIG_KINDS = ("row", "exact row", "parallel", "triangle", "wide")
SIZE_PX = (768, 576)
VOLUME_CENTRE_M, VOLUME_SIZE_M = np.array([0.0, 0.0, 2.5]), np.array([1.0, 1.5, 1.0])


@dataclass(frozen=True, kw_only=True, slots=True)
class BarNoise:
    """The errors of the image points."""

    sigma_px: float = 0.05
    missing: float = 0.10  # fraction of the image points
    gross: float = 0.02  # fraction displaced by 5 … 200 px
    unlabelled: bool = False  # ends in random order in each camera


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class WavedBar:
    """The truth and the image points."""

    cameras: tuple[Camera, ...]
    length_m: float
    ends_m: np.ndarray  # (N, 2, 3)
    xy_px: np.ndarray  # (N, C, 2, 2), NaN: missing
    wrong: np.ndarray  # (N, C, 2) displaced
    swapped: np.ndarray  # (N, C) ends in the other order

    def __post_init__(self) -> None:
        N, C = len(self.ends_m), len(self.cameras)
        for name, shape, dtype in (
            ("ends_m", (N, 2, 3), np.float64),
            ("xy_px", (N, C, 2, 2), np.float64),
            ("wrong", (N, C, 2), bool),
            ("swapped", (N, C), bool),
        ):
            object.__setattr__(self, name, frozen(getattr(self, name), shape, dtype, name))


def benchmark_cameras(simple_lens: bool = False) -> tuple[Camera, ...]:
    """Three cameras of 768×576 in a row of 1.5 m; with `simple_lens` only f and k1 differ from a pinhole in the image's middle."""
    rng = np.random.default_rng(42)
    f, k1 = (760.0, 775.0, 752.0), (-0.15, -0.16, -0.145)
    pp = ((7.3, -4.2), (-5.1, 6.0), (3.4, 2.5))
    rest = (
        (0.05, -0.008, 5e-4, -3e-4, 3e-4, 1e-4),
        (0.06, -0.008, -4e-4, 6e-4, -2e-4, 2e-4),
        (0.045, -0.008, 3e-4, 8e-4, 4e-4, -1e-4),
    )
    cameras = []
    for i, x in enumerate((-0.75, 0.0, 0.75)):
        k2, k3, p1, p2, b1, b2 = (0.0,) * 6 if simple_lens else rest[i]
        cx, cy = (0.0, 0.0) if simple_lens else pp[i]
        interior = np.array([f[i], (SIZE_PX[0] - 1) / 2 + cx, (SIZE_PX[1] - 1) / 2 + cy, k1[i], k2, k3, p1, p2, b1, b2])
        centre = np.array([x, 0.0, 0.0]) + rng.uniform(-0.03, 0.03, 3)
        R = _looking_at(centre, VOLUME_CENTRE_M + rng.uniform(-0.04, 0.04, 3), np.radians(rng.uniform(-1, 1)))
        cameras.append(camera_of("LCR"[i], SIZE_PX, interior, R, -R @ centre))
    return tuple(cameras)


def random_cameras(rng: np.random.Generator, kind: str) -> tuple[Camera, ...]:
    """Three cameras about the same volume, focal lengths 500–1500 px that differ by up to ±25 %, a lens with all distortions."""
    places = {
        "row": [[-0.75, 0, 0], [0, 0, 0], [0.75, 0, 0]],
        "exact row": [[-0.75, 0, 0], [0, 0, 0], [0.75, 0, 0]],
        "parallel": [[-0.3, 0, 0], [0, 0, 0], [0.3, 0, 0]],
        "triangle": [[-0.6, 0, 0], [0.6, 0, 0], [0, -0.6, 0]],
        "wide": [[-2.0, 0, 1.0], [0, -0.3, 0], [2.0, 0, 1.0]],
    }[kind]
    f0 = rng.uniform(500, 1500)
    cameras = []
    for name, place in zip("LCR", np.array(places, dtype=np.float64)):
        f = f0 * rng.uniform(0.75, 1.25)
        rho = 480.0 / f  # half the diagonal in units of f
        k1, k2, k3 = rng.uniform(-0.10, 0.03) / rho**2, rng.uniform(-0.02, 0.02) / rho**4, rng.uniform(-0.004, 0.004) / rho**6
        small = rng.uniform(-6e-4, 6e-4, 2), rng.uniform(-4e-4, 4e-4, 2)
        interior = np.array([f, 383.5, 287.5, k1, k2, k3, *small[0], *small[1]]) + np.r_[0, rng.uniform(-8, 8, 2), np.zeros(7)]
        exact = kind == "exact row"
        distance = 2.5 * max(f, 600.0) / 760.0  # longer lenses stand further back
        centre = place * distance / 2.5 + [0, 0, 2.5 - distance] + (0 if exact else rng.uniform(-0.03, 0.03, 3))
        aim = VOLUME_CENTRE_M + (0 if exact else rng.uniform(-0.05, 0.05, 3))
        if kind == "parallel":
            aim = centre + [0, 0, 1]
        R = _looking_at(centre, aim, 0.0 if exact else np.radians(rng.uniform(-3, 3)))
        cameras.append(camera_of(name, SIZE_PX, interior, R, -R @ centre))
    return tuple(cameras)


def fisheye_cameras(rng: np.random.Generator, count: int = 3) -> tuple[Camera, ...]:
    """Cameras with fisheye lenses of about 150° across, in a row close to the volume."""
    cameras = []
    for i in range(count):
        centre = VOLUME_CENTRE_M + [0.6 * (i - (count - 1) / 2), rng.uniform(-0.1, 0.1), rng.uniform(-0.5, -0.4)]
        R = _looking_at(centre, VOLUME_CENTRE_M + rng.uniform(-0.05, 0.05, 3), rng.uniform(-0.05, 0.05))
        k = np.array([0.06, -0.02, 0.008, -0.0015]) * rng.uniform(0.5, 1.5, 4)
        middle = (np.array(SIZE_PX) - 1) / 2 + rng.uniform(-6, 6, 2)
        interior = np.array([300 * rng.uniform(0.95, 1.05), *middle, *k, 0, 0, 0])
        cameras.append(camera_of("LCRABCDE"[i], SIZE_PX, interior, R, -R @ centre, fisheye=True))
    return tuple(cameras)


def waved_bar(
    cameras: Sequence[Camera],
    positions: int,
    rng: np.random.Generator,
    noise: BarNoise,
    length_m: float = 0.5,
    delay_images: Sequence[float] = (),
    pace: float = 1.0,
) -> WavedBar:
    """Wave a bar through the volume and take its image points; camera c takes its images `delay_images[c]` later, if given."""
    wave = rng.bit_generator.state
    seen = []
    for delay in delay_images or [0.0] * len(cameras):
        rng.bit_generator.state = wave
        seen.append(bar_ends(positions, rng, length_m, delay, pace))
    rng.bit_generator.state = wave
    ends = bar_ends(positions, rng, length_m, 0.0, pace)
    xy = np.stack([c.project(at) for c, at in zip(cameras, seen)], axis=1)
    inside = np.stack([c.sees(xy[:, i]) for i, c in enumerate(cameras)], axis=1)
    wrong = rng.random(inside.shape) < noise.gross
    angle, far = rng.uniform(0, 2 * np.pi, inside.shape), rng.uniform(5, 200, inside.shape)
    xy = xy + rng.normal(0, noise.sigma_px, xy.shape)
    xy += wrong[..., None] * far[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    xy[~inside | (rng.random(inside.shape) < noise.missing)] = np.nan
    swapped = (rng.random(inside.shape[:2]) < 0.5) & noise.unlabelled
    xy = np.where(swapped[..., None, None], xy[:, :, ::-1], xy)
    return WavedBar(cameras=tuple(cameras), length_m=length_m, ends_m=ends, xy_px=xy, wrong=wrong, swapped=swapped)


def bar_ends(positions: int, rng: np.random.Generator, length_m: float, delay_images: float = 0.0, pace: float = 1.0) -> np.ndarray:
    """Ends (N, 2, 3) of a bar on a Lissajous wave that fills the volume, turning through all directions."""
    time = pace * (np.arange(positions) + delay_images)
    rates = np.array([0.1831, 0.2827, 0.1319]) * rng.uniform(0.85, 1.15, 3)
    reach = (VOLUME_SIZE_M / 2) * 0.98 - length_m / 4
    centre = VOLUME_CENTRE_M + reach * np.sin(rates * time[:, None] + rng.uniform(0, 2 * np.pi, 3))
    azimuth = 0.231 * rng.uniform(0.85, 1.15) * time + rng.uniform(0, 2 * np.pi)
    tilt = 0.1673 * rng.uniform(0.85, 1.15) * time + rng.uniform(0, 2 * np.pi)  # through the upright and on, as smoothly as a hand turns
    direction = np.stack([np.cos(tilt) * np.cos(azimuth), np.sin(tilt), np.cos(tilt) * np.sin(azimuth)], axis=-1)
    return np.stack([centre + direction * length_m / 2, centre - direction * length_m / 2], axis=1)


def _looking_at(centre: np.ndarray, aim: np.ndarray, roll: float) -> np.ndarray:
    """R_cam_world of a camera at `centre` that looks at `aim`; y of the world is down."""
    z = (aim - centre) / np.linalg.norm(aim - centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * x + s * y, c * y - s * x, z])


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
