"""Sub-pixel sampling against the exact quintic spline and against a known function."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tricap.core.images.sampling import SplineImage, correlated_noise

PHASES = (0.0, 0.003, 0.1, 0.123, 0.25, 0.3701, 0.5, 0.77)


def speckle(blur_px: float, seed: int = 0, size: int = 80) -> np.ndarray:
    white = np.random.default_rng(seed).standard_normal((size, size)).astype(np.float32)
    image = cv2.GaussianBlur(white, (0, 0), blur_px)
    return (127 + 25 * image / image.std()).astype(np.float32)


def shift_error(image: np.ndarray, phase: tuple[float, float]) -> np.ndarray:
    """By how many pixels (2,) samples at one sub-pixel phase seem to be displaced against the exact spline."""
    y, x = np.mgrid[10:70, 10:70].astype(np.float32)
    x, y = x + np.float32(phase[0]), y + np.float32(phase[1])

    def exact(dx: float, dy: float) -> np.ndarray:
        return map_coordinates(image.astype(float), [y + dy, x + dx], order=5, mode="mirror")

    e = 1e-3
    gradient = np.stack([(exact(e, 0) - exact(-e, 0)).ravel(), (exact(0, e) - exact(0, -e)).ravel()], axis=1) / (2 * e)
    return np.linalg.lstsq(gradient, (SplineImage(image).sample(x, y) - exact(0, 0)).ravel(), rcond=None)[0]


def test_grid_points_of_the_fine_image_are_the_exact_spline() -> None:
    image = speckle(1.0)
    y, x = np.mgrid[0:80, 0:80].astype(np.float32)
    for dx in (0, 0.25, 0.5, 0.75):
        xs = np.minimum(x + dx, 79).astype(np.float32)
        got = SplineImage(image).sample(xs, y)
        assert np.abs(got - map_coordinates(image.astype(float), [y, xs], order=5, mode="mirror")).max() < 2e-4


@pytest.mark.parametrize("blur_px", [0.8, 1.5, 3.0])
def test_samples_are_not_displaced(blur_px: float) -> None:
    """All samples at one phase, the worst case: OpenCV 4 looks up in steps of 1/128 px (±0.0039 px), OpenCV 5 exactly, so that only the
    bilinear look-up between quarter pixels is left. Measured worst over three seeds: 0.0030, 0.0033, 0.0034 and 0.0008, 0.0002, 0.0001."""
    errors = [shift_error(speckle(blur_px, seed), (a, b)) for seed in range(2) for a in PHASES for b in (0.0, 0.31)]
    limit = {0.8: 0.0040, 1.5: 0.0040, 3.0: 0.0040} if cv2.__version__.startswith("4") else {0.8: 0.0011, 1.5: 0.0003, 3.0: 0.0003}
    assert np.abs(errors).max() < limit[blur_px]


@pytest.mark.parametrize("wavelength_px", [5.0, 8.0, 20.0])
def test_a_wave_between_its_pixels(wavelength_px: float) -> None:
    """The spline's own error: relative to the amplitude, worst over all phases, with a fourth of the wavelength's power."""
    y, x = np.mgrid[0:64, 0:64].astype(np.float64)
    k = 2 * np.pi / wavelength_px
    image = SplineImage(np.cos(k * x + 0.3 * k * y))
    at = np.random.default_rng(3).uniform(12, 52, (2, 1, 4000)).astype(np.float32)
    error = image.sample(at[0], at[1]) - np.cos(k * at[0] + 0.3 * k * at[1])
    assert np.abs(error).max() < 0.007 * k + 0.02 * k**2 + 0.02 * k**4  # look-up (4.x), bilinear between quarter pixels, spline


def test_beyond_the_border_the_image_is_mirrored() -> None:
    image = speckle(1.5, size=40)
    at = np.linspace(0, 5, 21, dtype=np.float32)[None]
    s, row = SplineImage(image), np.full((1, 21), 7, np.float32)
    assert np.allclose(s.sample(-at, row), s.sample(at, row), atol=1e-3)
    assert np.allclose(s.sample(row, 39 + at), s.sample(row, 39 - at), atol=1e-3)


def test_inside() -> None:
    s = SplineImage(np.zeros((20, 30), np.float32))
    xy = np.array([[0, 0], [29, 19], [29.1, 5], [-0.1, 5], [5, 19.1], [np.nan, 5]])
    assert s.inside(xy, 0.0).tolist() == [True, True, False, False, False, False]
    assert s.inside(np.array([[3.0, 2.0], [2.9, 2.0], [3.0, 1.9]]), np.array([3, 2])).tolist() == [True, False, False]


def test_more_patches_than_opencv_takes_at_once() -> None:
    s = SplineImage(speckle(2.0))
    x = np.random.default_rng(0).uniform(0, 79, (70_000, 2)).astype(np.float32)
    assert np.array_equal(s.sample(x, x)[-5:], s.sample(x[-5:], x[-5:]))
    assert s.sample(x[:0], x[:0]).shape == (0, 2)


def test_mirrored_image_gives_mirrored_samples() -> None:
    image = speckle(1.5)
    at = np.random.default_rng(4).uniform(5, 74, (2, 50, 9)).astype(np.float32)
    a, b = SplineImage(image).sample(at[0], at[1]), SplineImage(image[:, ::-1]).sample(np.float32(79) - at[0], at[1])
    assert np.abs(a - b).max() < 0.35  # OpenCV 4: 1/128 px times a gradient of 20 grey values a pixel


@pytest.mark.parametrize("row_step", [1, 2])
def test_correlated_noise_is_what_smoothing_does(row_step: int) -> None:
    """The variance of Σ f n over a patch, for gradients f and smoothed noise n, over what white noise of the same strength gives."""
    random = np.random.default_rng(3)
    field = SplineImage(random.standard_normal((400, 400)).astype(np.float32)).smoothed(1.0, row_step)
    assert field.smoothing == (1.0, 1.0 / row_step)
    y, x = np.mgrid[0:400, 0:400].astype(np.float32)
    noise = field.sample(x, y)
    f = cv2.GaussianBlur(random.standard_normal((13, 13)).astype(np.float32), (0, 0), 1.5)
    sums = cv2.filter2D(noise, cv2.CV_32F, f)[20:-20, 20:-20]
    factor = correlated_noise(f[None], np.zeros_like(f)[None], field.smoothing)[0]
    assert factor > 2
    assert np.var(sums) / (np.var(noise) * np.sum(f * f)) == pytest.approx(factor, rel=0.1)
    assert correlated_noise(f[None], f[None], (0.0, 0.0)).tolist() == [1.0]
