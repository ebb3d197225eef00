"""Filming a scene: what each camera's sensor would have stored, frame after frame, with optics, interlace and noise.

    L = (m + s · noise(X_rest)) · (ambient + (1 − ambient) max(0, n·l))          grey value on the surface, Lambert        (1)
    μ = offset + gain · (PSF ∗ L)                                              the camera's own gain and offset           (2)
    σ² = σ_dark² + K μ + 1/12                                                  EMVA 1288's linear model, in grey values   (3)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.raster import rasterize, vertex_normals
from ..values import frozen
from .figure import Part, joined
from .texture import SolidNoise

SAMPLES = 2  # per pixel and direction
AMBIENT = 0.45
LIGHT = np.array([-0.40, -0.75, 0.53])  # towards the light: from the left, the front and above


@dataclass(frozen=True, kw_only=True, slots=True)
class Sensor:
    """One camera's electronics and optics; noise as in (3)."""

    gain: float = 1.0
    offset: float = 0.0
    blur_px: float = 0.6
    dark_sigma: float = 0.8
    noise_per_grey: float = 0.022


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Layer:
    """What a camera sees of some parts, `SAMPLES`² samples a pixel: light (H, W) float32 and depth z_cam [m] float32, inf: nothing."""

    light: np.ndarray
    depth_m: np.ndarray

    def __post_init__(self) -> None:
        for name in ("light", "depth_m"):
            object.__setattr__(self, name, frozen(getattr(self, name), (None, None), np.float32, name))


def paint(camera: Camera, parts: Sequence[Part], noise: SolidNoise, behind: Layer | None = None) -> Layer:
    """The parts before what lies behind them.  (1)"""
    vertices, triangles, owner = joined(parts)
    raster = rasterize(camera, vertices, triangles, factor=SAMPLES)
    nearer = np.ones(len(raster.sample), dtype=bool) if behind is None else raster.depth_m < behind.depth_m.ravel()[raster.sample]
    normals = np.concatenate([vertex_normals(p.vertices_m, p.triangles) for p in parts])
    rest = np.concatenate([p.rest_m for p in parts])
    light = np.zeros(raster.shape, np.float32) if behind is None else behind.light.copy()
    depth = np.full(raster.shape, np.inf, np.float32) if behind is None else behind.depth_m.copy()
    depth.reshape(-1)[raster.sample[nearer]] = raster.depth_m[nearer]
    for i, part in enumerate(parts):
        shown = np.flatnonzero(nearer & (owner[raster.triangle] == i))
        weights, corners = raster.barycentric[shown], triangles[raster.triangle[shown]]
        at, normal = (np.einsum("nk,nkc->nc", weights, values[corners]) for values in (rest, normals))
        light.reshape(-1)[raster.sample[shown]] = _reflected(part, at, normal, noise)
    return Layer(light=light, depth_m=depth)


def _reflected(part: Part, rest_m: np.ndarray, normal: np.ndarray, noise: SolidNoise) -> np.ndarray:
    m = part.material
    texture = m.mean + m.contrast * noise(rest_m / m.stretch + m.offset_m)
    lambert = np.clip(normal @ LIGHT / np.maximum(np.linalg.norm(normal, axis=1) * np.linalg.norm(LIGHT), 1e-12), 0, None)
    return texture * (AMBIENT + (1 - AMBIENT) * lambert)


def expose(layer: Layer, sensor: Sensor) -> np.ndarray:
    """The expected grey values (H, W) of a picture without noise.  (2)"""
    h, w = layer.light.shape
    pixels = cv2.resize(layer.light, (w // SAMPLES, h // SAMPLES), interpolation=cv2.INTER_AREA)
    return sensor.offset + sensor.gain * cv2.GaussianBlur(pixels, (0, 0), sensor.blur_px, borderType=cv2.BORDER_REPLICATE)


def digitize(expected: np.ndarray, sensor: Sensor, noise_level: float, rng: np.random.Generator) -> np.ndarray:
    """The stored picture (H, W) uint8; `noise_level` multiplies the sensor's noise (1 as it is, 0 none).  (3)"""
    sigma = noise_level * np.sqrt(sensor.dark_sigma**2 + sensor.noise_per_grey * np.maximum(expected, 0))
    noisy = expected + sigma * rng.standard_normal(expected.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def seen_vertices(camera: Camera, vertices_m: np.ndarray, normals: np.ndarray, layer: Layer, tolerance_m: float = 0.006) -> np.ndarray:
    """Which vertices (V,) the camera sees: inside the frame, facing it, and not behind anything by more than the tolerance."""
    xy = camera.project(vertices_m)
    inside = camera.sees(xy)
    at = np.zeros((len(xy), 2), dtype=np.intp)
    at[inside] = np.rint((xy[inside] + 0.5) * SAMPLES - 0.5).astype(np.intp)
    at = np.clip(at, 0, np.array(layer.depth_m.shape[::-1]) - 1)
    facing = np.einsum("ni,ni->n", normals, camera.centre_m - vertices_m) > 0
    return np.asarray(inside & facing & (camera.to_camera(vertices_m)[:, 2] < layer.depth_m[at[:, 1], at[:, 0]] + tolerance_m))
