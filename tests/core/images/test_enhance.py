"""Wallis enhancement: its formula, its window in fields, and its judgement of noise and texture."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tricap.core.images.enhance import EnhanceSettings, enhanced, texture_strength, wallis, without_shading
from tricap.core.images.sampling import noise_sigma


def textured(contrast: float, noise: float, seed: int = 0, blur: float = 1.5) -> np.ndarray:
    random = np.random.default_rng(seed)
    g = gaussian_filter(random.standard_normal((160, 200)), blur)
    return np.rint(120 + contrast * g / g.std() + noise * random.standard_normal(g.shape))


def test_formula_at_a_pixel() -> None:
    image, s = textured(20, 1.0), EnhanceSettings(window_px=21)
    window = image[60:81, 90:111]
    m, sd = window.mean(), window.std()
    c, b = s.contrast_share, s.mean_share
    expected = (image[70, 100] - m) * c * s.contrast / (c * sd + (1 - c) * s.contrast) + b * s.mean + (1 - b) * m
    assert wallis(image, s)[70, 100] == pytest.approx(expected, abs=0.02)


def test_without_shading_texture_is_left() -> None:
    """A ramp vanishes, and fine texture keeps its grey values but for the mean over the window, which has half as many rows in a field."""
    texture = textured(20, 0.0, blur=1.0) - 120
    ramp = np.add.outer(0.3 * np.arange(160), 0.5 * np.arange(200))
    level = without_shading(texture + ramp, 13)[20:140, 20:180]
    assert np.abs(level - without_shading(texture, 13)[20:140, 20:180]).max() < 1e-3
    assert level[10, 10] == pytest.approx(texture[30, 30] - texture[24:37, 24:37].mean(), abs=1e-3)
    assert without_shading(texture, 13, row_step=2)[30, 30] == pytest.approx(texture[30, 30] - texture[27:34, 24:37].mean(), abs=1e-3)


def test_contrast_and_mean_become_alike() -> None:
    x = np.linspace(0, 1, 200)
    image = 60 + 120 * x + (textured(15, 0.5) - 120) * (0.2 + 0.8 * x)
    g = wallis(image, EnhanceSettings(contrast_share=1.0))
    left, right = g[20:140, 20:60], g[20:140, 140:180]
    assert abs(left.mean() - right.mean()) < 6
    assert 0.75 < left.std() / right.std() < 1.3
    # the window of 31 px sees the ramp of contrast, and random texture varies: 0.75–1.3
    before = image[20:140, 20:60].std() / image[20:140, 140:180].std()
    assert before < 0.65


def test_a_field_has_half_as_many_rows_in_the_window() -> None:
    """A structure that is tall in the frame is as tall in half the rows of its field: the enhanced field is the enhanced frame's field."""
    frame = np.repeat(textured(20, 0.0, blur=4.0), 2, axis=0)
    whole = wallis(frame, EnhanceSettings())[::2]
    field = wallis(frame[::2], EnhanceSettings(), row_step=2)
    assert np.abs(field - whole)[20:-20, 20:-20].mean() < 1.5
    assert np.abs(wallis(frame[::2], EnhanceSettings()) - whole)[20:-20, 20:-20].mean() > 3.0


def test_a_flat_image_stays_flat() -> None:
    noise = textured(0.0, 1.0)
    assert wallis(noise, EnhanceSettings()).std() < 27  # not forced to the full contrast of 55
    assert np.ptp(wallis(np.full((50, 60), 80.0), EnhanceSettings())) < 1e-3


@pytest.mark.parametrize("noise", [1.0, 2.0, 4.0])
def test_noise_is_measured(noise: float) -> None:
    measured = [noise_sigma(textured(20, noise, seed, blur=3.0)) for seed in range(4)]
    assert np.mean(measured) == pytest.approx(noise, rel=0.08)


def test_strength_tells_weak_from_strong_texture() -> None:
    strong, skin = texture_strength(textured(20, 2.0)), texture_strength(textured(2, 2.0, blur=3.0))
    assert strong > 20 > EnhanceSettings().weak_texture > skin > 0.9
    assert 1.0 < texture_strength(textured(0, 2.0)) < 2.0  # the stronger half of pure noise


def test_choice() -> None:
    strong, weak = [textured(20, 1.5, s) for s in (0, 1)], [textured(20, 1.5, 0), textured(2, 1.5, 1, blur=3.0)]
    assert enhanced(strong, EnhanceSettings()) is strong
    assert enhanced(strong, EnhanceSettings(wallis="auto")) is strong
    assert enhanced(weak, EnhanceSettings(wallis="auto"))[1].std() > 2 * weak[1].std()
    assert enhanced(strong, EnhanceSettings(wallis="on"))[0].std() > 1.25 * strong[0].std()
