"""Filming a scene: the images that each camera's sensor stores, with optics, interlace and noise.

L = (m + s · noise(X_rest)) · (ambient + (1 − ambient) max(0, n·l))          grey value on the surface, Lambert        (1)
μ = offset + gain · (PSF ∗ L)                                              the camera's own gain and offset           (2)
σ² = σ_dark² + K μ + 1/12                                                  EMVA 1288's linear model, in grey values   (3)

Solid texture: band-limited noise in space, which sticks to a moving body through its rest-pose coordinates (Perlin 1985; Peachey 1985).

The noise is white noise filtered in the Fourier domain to wavelengths between two limits, with equal power in every octave:
amplitude ∝ |k|^(−3/2) in three dimensions. It repeats after the volume's width.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..foundation.arrays import frozen
from ..geometry.camera import Camera
from ..geometry.raster import Raster, rasterize
from .figure import Part, Scene, joined


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SolidNoise:
    """Noise of mean 0 and standard deviation 1 on a cubic grid of N³ cells, `pitch_m` apart, continued periodically."""

    values: np.ndarray  # (N, N, N) float32
    pitch_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", frozen(self.values, (None, None, None), np.float32, "values"))

    def scaled(self, factor: float) -> "SolidNoise":
        """The same noise with another standard deviation."""
        return replace(self, values=self.values * np.float32(factor))

    def __call__(self, xyz_m: np.ndarray) -> np.ndarray:
        """The noise (N,) at points (N, 3), trilinear between the grid's cells."""
        from scipy.ndimage import map_coordinates

        at = np.asarray(xyz_m).T / self.pitch_m
        return map_coordinates(self.values, at, order=1, mode="grid-wrap", output=np.float32)


def solid_noise(seed: int, *, cells: int = 160, pitch_m: float = 0.002, shortest_m: float = 0.012, longest_m: float = 0.080) -> SolidNoise:
    """Noise with wavelengths from `shortest_m` to `longest_m`. A seed gives the same noise everywhere; 160³ cells take 0.3 s."""
    import scipy.fft

    white = np.random.default_rng(seed).standard_normal((cells, cells, cells), dtype=np.float32)
    k = scipy.fft.fftfreq(cells, pitch_m)
    k2 = k[:, None, None] ** 2 + k[None, :, None] ** 2 + scipy.fft.rfftfreq(cells, pitch_m) ** 2
    band = (k2 >= longest_m**-2) & (k2 <= shortest_m**-2)
    amplitude = np.where(band, np.where(band, k2, 1.0) ** -0.75, 0.0).astype(np.float32)
    values = scipy.fft.irfftn(scipy.fft.rfftn(white) * amplitude, s=white.shape)
    return SolidNoise(values=values / values.std(), pitch_m=pitch_m)


SAMPLES = 2  # per pixel and direction
OUTLINE_STEP_M = 0.006  # a pixel whose samples differ more in depth is on an outline
AMBIENT = 0.45  # fraction of the light without direction in (1)
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
    """The image of some parts: light (H, W) float32 of each pixel, its colour (H, W, 3) as factors of blue, green and red, None if all is
    grey, and depth z_cam [m] of `SAMPLES`² samples a pixel (H · SAMPLES, W · SAMPLES) float32, inf where there is no surface."""

    light: np.ndarray
    depth_m: np.ndarray
    bgr: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("light", "depth_m"):
            object.__setattr__(self, name, frozen(getattr(self, name), (None, None), np.float32, name))
        if self.bgr is not None:
            object.__setattr__(self, "bgr", frozen(self.bgr, (*self.light.shape, 3), np.float32, "bgr"))


def paint(camera: Camera, parts: Sequence[Part], noise: SolidNoise, behind: Layer | None = None) -> Layer:
    """The image of the parts in front of the layer `behind`.

    Pixels inside a part are shaded at their centres, which suffices for textures that are smooth over a pixel; pixels on an outline are the
    mean of their samples.
    """
    scene = joined(parts)
    raster = rasterize(camera, scene.vertices_m, scene.triangles, factor=SAMPLES)
    light = np.zeros(camera.size_px[::-1], np.float32) if behind is None else behind.light.copy()
    depth = np.full(raster.shape, np.inf, np.float32) if behind is None else behind.depth_m.copy()
    nearer = np.flatnonzero(raster.depth_m < depth.ravel()[raster.sample])
    depth.reshape(-1)[raster.sample[nearer]] = raster.depth_m[nearer]
    hit = np.full(raster.shape, -1)
    hit.reshape(-1)[raster.sample[nearer]] = nearer
    pixel, outline = _inner_and_outline(hit, depth, scene.owner[raster.triangle])
    centre = np.stack([pixel % light.shape[1], pixel // light.shape[1]], axis=1)
    within = hit[::SAMPLES, ::SAMPLES].ravel()[pixel]
    here = np.stack([plane.ravel()[outline] for plane in _planes(hit)], axis=1)
    on_edge = here[here >= 0]

    def put(plane: np.ndarray, inner: np.ndarray, edge: np.ndarray) -> None:
        """Values of the inner pixels, and of the samples of parts on outlines, into a plane (H, W, …)."""
        flat = plane.reshape(-1, *plane.shape[2:])
        flat[pixel] = inner
        samples = np.repeat(flat[outline][:, None], SAMPLES**2, axis=1)
        samples[here >= 0] = edge
        flat[outline] = samples.mean(axis=1)

    put(light, _reflected(scene, raster, within, centre, noise), _reflected(scene, raster, on_edge, raster.xy_px[on_edge], noise))
    bgr = behind.bgr if behind is not None else None
    if any(material.tint for material in scene.materials):
        bgr = np.ones((*light.shape, 3), np.float32) if bgr is None else bgr.copy()
        colours = np.array([material.bgr for material in scene.materials], dtype=np.float32)[scene.owner[raster.triangle]]
        put(bgr, colours[within], colours[on_edge])
    return Layer(light=light, depth_m=depth, bgr=bgr)


def _planes(samples: np.ndarray) -> list[np.ndarray]:
    """Samples (H · SAMPLES, W · SAMPLES) as SAMPLES² pictures (H, W), one for each place within a pixel."""
    return [samples[i::SAMPLES, j::SAMPLES] for i in range(SAMPLES) for j in range(SAMPLES)]


def _inner_and_outline(hit: np.ndarray, depth: np.ndarray, part_of_hit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (flat) whose samples all show one smooth piece of one part, and the other pixels of parts."""
    part = np.append(part_of_hit, -1).astype(np.int8)[hit]  # −1: the layer behind
    touched, alike = np.zeros(_planes(part)[0].shape, dtype=bool), np.ones(_planes(part)[0].shape, dtype=bool)
    first, near, far = _planes(part)[0], _planes(depth)[0], _planes(depth)[0]
    for p, d in zip(_planes(part), _planes(depth)):
        touched |= p >= 0
        alike &= p == first
        near, far = np.minimum(near, d), np.maximum(far, d)
    inner = touched & alike & (near > far - OUTLINE_STEP_M)
    return np.flatnonzero(inner), np.flatnonzero(touched & ~inner)


def _reflected(scene: Scene, raster: Raster, which: np.ndarray, xy_px: np.ndarray, noise: SolidNoise) -> np.ndarray:
    """Light (K,) of the surfaces at the raster's samples `which`, at pixels (K, 2).  (1)"""
    at = raster.interpolate_at(which, xy_px, np.concatenate([scene.rest_m, scene.normals], axis=1), scene.triangles)
    rest, normal = at[:, :3], at[:, 3:]
    length = np.sqrt(np.einsum("ni,ni->n", normal, normal) * (LIGHT @ LIGHT))
    lambert = np.clip(normal @ LIGHT / np.maximum(length, 1e-12), 0, None)
    owner, texture = scene.owner[raster.triangle[which]], np.zeros(len(which), np.float32)
    for i, m in enumerate(scene.materials):
        here = np.flatnonzero(owner == i)
        texture[here] = m.mean + m.contrast * noise(rest[here] / m.stretch + m.offset_m)
    return texture * (AMBIENT + (1 - AMBIENT) * lambert).astype(np.float32)


def expose(layer: Layer, sensor: Sensor) -> np.ndarray:
    """The expected values of an image without noise, (H, W) or, of a layer with colours, (H, W, 3).  (2)"""
    light = layer.light if layer.bgr is None else layer.light[..., None] * layer.bgr
    return sensor.offset + sensor.gain * cv2.GaussianBlur(light, (0, 0), sensor.blur_px, borderType=cv2.BORDER_REPLICATE)


def digitize(expected: np.ndarray, sensor: Sensor, noise_level: float, rng: np.random.Generator) -> np.ndarray:
    """The stored image uint8, of the same shape; `noise_level` multiplies the sensor's noise (0: none).  (3)"""
    sigma = noise_level * np.sqrt(sensor.dark_sigma**2 + sensor.noise_per_grey * np.maximum(expected, 0))
    noisy = expected + sigma * rng.standard_normal(expected.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def visible_vertices(camera: Camera, vertices_m: np.ndarray, normals: np.ndarray, layer: Layer, tolerance_m: float = 0.006) -> np.ndarray:
    """The vertices (V,) visible in a camera: inside the frame, facing it, and not occluded by more than the tolerance."""
    xy = camera.project(vertices_m)
    inside = camera.sees(xy)
    at = np.zeros((len(xy), 2), dtype=np.intp)
    at[inside] = np.rint((xy[inside] + 0.5) * SAMPLES - 0.5).astype(np.intp)
    at = np.clip(at, 0, np.array(layer.depth_m.shape[::-1]) - 1)
    facing = np.einsum("ni,ni->n", normals, camera.centre_m - vertices_m) > 0
    return np.asarray(inside & facing & (camera.to_camera(vertices_m)[:, 2] < layer.depth_m[at[:, 1], at[:, 0]] + tolerance_m))
