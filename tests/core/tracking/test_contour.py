"""Contours on shapes with exact outlines: place, sigma, prediction by points inside, and starting masks."""

from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.tracking.contour import (
    ContourSettings,
    _sample,
    contour_of_mask,
    mask_of_points,
    outward_normals,
    predict_contour,
    relax_contour,
    resampled,
)

SETTINGS = ContourSettings()


def disc(centre: tuple[float, float], radius: float, noise: float, seed: int = 0) -> np.ndarray:
    """A bright, softly textured disc before a dark ground, with an edge of a pixel's width."""
    y, x = np.mgrid[0:200, 0:240].astype(float)
    inside = np.clip(radius - np.hypot(x - centre[0], y - centre[1]) + 0.5, 0, 1)
    grey = 60 + inside * (90 + 10 * np.sin(x / 5) * np.cos(y / 7))
    return (cv2.GaussianBlur(grey, (0, 0), 0.6) + noise * np.random.default_rng(seed).standard_normal(grey.shape)).astype(np.float32)


def circle(centre: tuple[float, float], radius: float, count: int = 90) -> np.ndarray:
    a = np.arange(count) / count * 2 * np.pi
    return np.array(centre) + radius * np.stack([np.cos(a), np.sin(a)], axis=1)


@pytest.mark.parametrize(("noise", "contrast", "texture"), [(1, 90, 10), (2, 40, 5), (4, 90, 10), (4, 40, 5), (8, 90, 10)])
@pytest.mark.parametrize("radius", [20.0, 50.0])
def test_a_rough_start_finds_the_outline(noise: float, contrast: float, texture: float, radius: float) -> None:
    """A start 4 px too large and 2 px off: the outline is found without bias, with calibrated sigmas. Over 40 discs z is 0.91 to 1.18."""
    z, away = [], []
    for seed in range(20):
        image = textured_disc((119.3, 100.6), radius, noise, contrast, texture, seed)
        found = relax_contour(circle((121, 99), radius + 4, round(radius * 1.7)), image, SETTINGS)
        off = (np.linalg.norm(found.xy_px - (119.3, 100.6), axis=1) - radius)[found.on_edge]
        assert found.on_edge.mean() > 0.95 and np.abs(off).max() < 1.2
        z.append(off / found.sigma_px[found.on_edge])
        away.append(off)
    assert np.abs(np.median(np.concatenate(away))) < 0.03
    assert 0.8 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.25


def test_an_outline_of_many_vertices() -> None:
    """1319 of 25 samples each are more than OpenCV looks up in a row; 40,000 vertices are more than it has rows."""
    y, x = np.mgrid[0:900, 0:900].astype(np.float32)
    image = 60 + 90 * np.clip(420.5 - np.hypot(x - 450, y - 450), 0, 1)
    found = relax_contour(circle((450, 450), 423, 400), image, ContourSettings(spacing_px=2.0))
    assert len(found.xy_px) > 32_767 / 25 and found.on_edge.all()
    assert np.abs(np.linalg.norm(found.xy_px - 450, axis=1) - 420).max() < 0.2  # at most 0.11 with OpenCV 4, less with 5
    places = np.random.default_rng(0).uniform(0, 100, (40_000, 2))
    assert np.allclose(_sample(x, places), places[:, 0], atol=0.02)  # it looks up at 1/32 px


def textured_disc(centre: tuple[float, float], radius: float, noise: float, contrast: float, texture: float, seed: int) -> np.ndarray:
    """A disc before a ground, each with a random texture of its own (that of the ground half as strong), and noise (grey values)."""
    y, x = np.mgrid[0:200, 0:240].astype(float)
    random = np.random.default_rng(seed)
    wave = [cv2.GaussianBlur(random.standard_normal(x.shape), (0, 0), blur) * 2 * np.sqrt(np.pi) * blur for blur in (3.0, 4.0)]
    inside = np.clip(radius - np.hypot(x - centre[0], y - centre[1]) + 0.5, 0, 1)
    grey = 60 + texture / 2 * wave[1] + inside * (contrast + texture * wave[0] - texture / 2 * wave[1])
    return (cv2.GaussianBlur(grey, (0, 0), 0.6) + noise * random.standard_normal(x.shape)).astype(np.float32)


@pytest.mark.parametrize("image", ["black", "noise"])
def test_without_an_edge_the_contour_stays(image: str) -> None:
    """Ten frames without an edge: none is reported, and the contour neither shrinks nor wanders."""
    random, start = np.random.default_rng(0), circle((120, 100), 50)
    xy = start
    for _ in range(10):
        flat = np.full((200, 240), 20, np.float32) + (image == "noise") * random.standard_normal((200, 240)).astype(np.float32)
        found = relax_contour(xy, flat, SETTINGS)
        assert found.on_edge.mean() < 0.1 and (found.sigma_px[~found.on_edge] == 3.0).all()
        xy = found.xy_px
    away = np.abs(np.linalg.norm(xy - (120, 100), axis=1) - 50)
    assert away.max() < (0.2 if image == "black" else 3.0) and np.median(away) < 0.3


def test_points_inside_carry_the_contour() -> None:
    """The left half moves by 12 px, the right is still; points outside the contour have no influence."""
    random = np.random.default_rng(0)
    before = random.uniform((75, 55), (165, 145), (400, 2))
    shift = np.where(before[:, :1] < 120, (12.0, -3.0), (0.0, 0.0))
    outside = random.uniform((0, 0), (60, 200), (50, 2))
    moved = predict_contour(circle((120, 100), 48), np.concatenate([before, outside]), np.concatenate([before + shift, outside + 40]))
    u = moved - circle((120, 100), 48)
    x = circle((120, 100), 48)[:, 0]
    assert np.allclose(u[x < 90], (12, -3), atol=0.5) and np.allclose(u[x > 150], 0, atol=0.5)
    assert np.array_equal(predict_contour(x_ := circle((9, 9), 5), np.zeros((0, 2)), np.zeros((0, 2))), x_)


def test_a_disc_is_tracked_through_frames() -> None:
    """It jumps by 9 px a frame, far beyond the range of a snake alone: the points inside predict it."""
    contour, centre = circle((60, 100), 40), np.array([60.0, 100.0])
    inner = circle((60, 100), 20)
    for i in range(8):
        nxt = centre + (9.0, 1.5)
        contour = predict_contour(contour, inner, inner + (9.0, 1.5))
        centre, inner = nxt, inner + (9.0, 1.5)
        found = relax_contour(contour, disc((centre[0], centre[1]), 40, 2.0, i), SETTINGS)
        contour = found.xy_px
        assert np.abs(np.linalg.norm(contour - centre, axis=1) - 40)[found.on_edge].max() < 1.2
    assert found.on_edge.mean() > 0.95


def test_masks_become_contours() -> None:
    y, x = np.mgrid[0:200, 0:240]
    outline = contour_of_mask(np.hypot(x - 100, y - 90) < 50, 4.0)
    assert np.allclose(np.linalg.norm(outline - (100, 90), axis=1), 49.5, atol=1.0)
    steps = np.linalg.norm(np.diff(outline, axis=0), axis=1)
    assert steps.max() < 4.5 and len(contour_of_mask(np.zeros((10, 10), bool), 4.0)) == 0
    points = np.stack(np.meshgrid(np.arange(60, 141, 6), np.arange(50, 131, 6)), axis=-1).reshape(-1, 2).astype(float)
    points = np.concatenate([points, [[np.nan, np.nan], [1e9, 0], [-5, 3]]])
    assert mask_of_points(points, (240, 200), 5).sum() == pytest.approx(79**2, rel=0.06)


def test_normals_point_outwards_in_both_orientations() -> None:
    ring: Any = circle((0, 0), 10)
    for way in (ring, ring[::-1]):
        assert (np.einsum("ni,ni->n", outward_normals(way), way) > 9.9).all()
    assert len(resampled(ring, 1.0)) == round(2 * np.pi * 10)
