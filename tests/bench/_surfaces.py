"""Textured surfaces seen by three cameras in a row, rendered pixel by pixel from their equations: the truth is exact."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter1d

from tricap.core.geometry.camera import Camera
from tricap.core.images.sampling import SplineImage

WIDTH, HEIGHT, FOCAL_PX, DISTANCE_M, BASE_M = 320, 240, 700.0, 1.4, 0.30  # 2 mm per pixel
TEXELS, TEXEL_M = 700, 0.001
BACKGROUND = 90.0
Hit = tuple[np.ndarray, np.ndarray, np.ndarray]  # depth along the ray (…,), NaN where missed; texture coordinates (…,) each


@dataclass(frozen=True)
class Surface:
    """A surface by its rays' hits, and the signed distance of points from it, outwards positive."""

    hit: Callable[[np.ndarray, np.ndarray], Hit]
    distance_m: Callable[[np.ndarray], np.ndarray]
    normal: Callable[[np.ndarray], np.ndarray]


def cameras(focal_px: float = FOCAL_PX) -> list[Camera]:
    """Left, centre, right, turned towards a point DISTANCE_M before the centre; with distortion."""
    made = []
    for name, x in (("L", -BASE_M), ("C", 0.0), ("R", BASE_M)):
        centre = np.array([x, 0.0, 0.0])
        z = np.array([0.0, 0.0, DISTANCE_M]) - centre
        z /= np.linalg.norm(z)
        side = np.cross([0.0, 1.0, 0.0], z)
        R = np.stack([side / np.linalg.norm(side), np.cross(z, side / np.linalg.norm(side)), z])
        matrix = np.array([[focal_px, 0, WIDTH / 2 + 3.3], [0, focal_px, HEIGHT / 2 - 2.1], [0, 0, 1]])
        made.append(
            Camera(
                name=name,
                size_px=(WIDTH, HEIGHT),
                matrix=matrix,
                distortions=np.array([-0.1, 0.03, 4e-4, -3e-4, 0.0]),
                R_cam_world=R,
                t_cam_world_m=-R @ centre,
            )
        )
    return made


def plane(slope: float = 0.6) -> Surface:
    """A plane that recedes to the right."""
    n = np.array([slope, 0.1, -1.0]) / np.linalg.norm([slope, 0.1, -1.0])
    d = n @ np.array([0.0, 0.0, DISTANCE_M])
    across = np.array([1.0, 0.0, slope]) / np.hypot(1, slope)

    def hit(origin: np.ndarray, rays: np.ndarray) -> Hit:
        t = (d - origin @ n) / (rays @ n)
        X = origin + rays * t[..., None]
        along = (X - (0.0, 0.0, DISTANCE_M)) @ across
        inside = (np.abs(along) < 0.25) & (np.abs(X[..., 1]) < 0.2)
        return np.where(inside, t, np.nan), along, X[..., 1]

    return Surface(hit=hit, distance_m=lambda X: X @ n - d, normal=lambda X: np.broadcast_to(n, X.shape))


def cylinder(radius_m: float) -> Surface:
    """An upright cylinder whose front is DISTANCE_M away."""
    axis = np.array([0.0, DISTANCE_M + radius_m])

    def hit(origin: np.ndarray, rays: np.ndarray) -> Hit:
        o, r = origin[[0, 2]] - axis, rays[..., [0, 2]]
        a, b, c = (r * r).sum(-1), r @ o, o @ o - radius_m**2
        under = b * b - a * c
        t = np.where(under > 0, (-b - np.sqrt(np.maximum(under, 0))) / a, np.nan)
        X = origin + rays * t[..., None]
        return t, radius_m * np.arctan2(X[..., 0], axis[1] - X[..., 2]), X[..., 1]

    def normal(X: np.ndarray) -> np.ndarray:
        n = X * (1, 0, 1) - (0, 0, axis[1])
        return n / np.linalg.norm(n, axis=-1, keepdims=True)

    return Surface(hit=hit, distance_m=lambda X: np.hypot(X[..., 0], X[..., 2] - axis[1]) - radius_m, normal=normal)


def sphere(radius_m: float) -> Surface:
    """A sphere whose front is DISTANCE_M away."""
    centre = np.array([0.0, 0.0, DISTANCE_M + radius_m])

    def hit(origin: np.ndarray, rays: np.ndarray) -> Hit:
        o = origin - centre
        a, b = (rays * rays).sum(-1), rays @ o
        under = b * b - a * (o @ o - radius_m**2)
        t = np.where(under > 0, (-b - np.sqrt(np.maximum(under, 0))) / a, np.nan)
        n = (origin + rays * t[..., None] - centre) / radius_m
        return t, radius_m * np.arctan2(n[..., 0], -n[..., 2]), radius_m * np.arcsin(np.clip(n[..., 1], -1, 1))

    def distance_m(X: np.ndarray) -> np.ndarray:
        return np.linalg.norm(X - centre, axis=-1) - radius_m

    def normal(X: np.ndarray) -> np.ndarray:
        return (X - centre) / np.linalg.norm(X - centre, axis=-1, keepdims=True)

    return Surface(hit=hit, distance_m=distance_m, normal=normal)


def texture(kind: str | float, seed: int) -> np.ndarray:
    """Grey values (TEXELS, TEXELS): "strong" cloth, "weak" skin, "repetitive" checks of 16 mm with a little of their own; or cloth whose
    contrast (standard deviation over mean) is a number."""
    random = np.random.default_rng(seed)

    def blurred(sigma: float) -> np.ndarray:
        g = gaussian_filter(random.standard_normal((TEXELS, TEXELS)), sigma, mode="wrap")
        return g / g.std()

    if not isinstance(kind, str):
        return 120 * (1 + kind * blurred(3.0))
    if kind == "strong":
        return 120 + 25 * blurred(3.0)
    if kind == "weak":
        return 120 + 6 * blurred(5.0)
    i = np.arange(TEXELS) * 2 * np.pi / 16
    return 120 + 25 * (np.sin(i)[:, None] + np.sin(i)[None, :]) / np.sqrt(2) + 5 * blurred(4.0)


def render(
    surface: Surface, kind: str | float, *, noise: float = 2.0, seed: int = 0, focal_px: float = FOCAL_PX, blur_px: int = 1
) -> tuple[list[Camera], list[np.ndarray]]:
    """The cameras and their images (h, w) of whole grey values, with unlike gains and offsets. The texture's grain is one in pixels; by
    `blur_px` everything moves to the right during the exposure."""
    rig, look, texel_m = cameras(focal_px), SplineImage(texture(kind, seed)), TEXEL_M * FOCAL_PX / focal_px
    random = np.random.default_rng(seed + 1000)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    images = []
    for camera, gain, offset in zip(rig, (0.9, 1.0, 1.1), (8.0, 0.0, -6.0)):
        depth, a, b = surface.hit(camera.centre_m, camera.rays(np.stack([x, y], axis=-1)))
        grey = look.sample(*(np.nan_to_num(c / texel_m + TEXELS / 2).astype(np.float32) for c in (a, b)))
        grey = uniform_filter1d(np.where(np.isfinite(depth), grey, BACKGROUND), blur_px, axis=1)
        images.append(np.rint(np.clip(gain * grey + offset + noise * random.standard_normal(grey.shape), 0, 255)).astype(np.float32))
    return rig, images
