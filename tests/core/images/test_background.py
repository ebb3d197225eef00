"""The still background: found from images of a passing square, and where it shows."""

import numpy as np
import pytest

from tricap.core.images.background import FEWEST, still_background


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
def test_a_passing_square_hides_the_background(noise: float) -> None:
    rng = np.random.default_rng(3)
    wall = 110 + 8 * rng.standard_normal((90, 160)).astype(np.float32)
    square = 150 + 25 * rng.standard_normal((20, 20)).astype(np.float32)
    images = []
    for i in range(11):
        image = wall + noise * rng.standard_normal(wall.shape).astype(np.float32)
        image[30:50, 5 + 12 * i : 25 + 12 * i] = square
        images.append(np.rint(image))
    background = still_background(images)
    assert background is not None and np.abs(background.grey - wall).mean() < 0.5 + 0.6 * noise
    there = background.shown_by(images[5])
    assert not there[32:48, 67:83].any()  # inside the square, though its mean is near the wall's
    away = np.ones_like(there)
    away[25:55, 60:90] = False
    assert there[away].mean() > 0.995
    assert not background.shown_by(np.zeros_like(wall)).any()  # a black image shows nothing


def test_too_few_images_tell_nothing() -> None:
    assert still_background([np.zeros((9, 9))] * (FEWEST - 1)) is None


def test_where_somebody_is_near_most_of_the_time_the_background_is_what_the_other_images_show() -> None:
    rng, noise = np.random.default_rng(4), 2.0
    wall = 110 + 8 * rng.standard_normal((60, 90)).astype(np.float32)
    images, near = [], []
    for i in range(11):
        image, there = wall + noise * rng.standard_normal(wall.shape).astype(np.float32), np.zeros(wall.shape, dtype=bool)
        x = 20 if i < 8 else 55  # stands, and goes aside at last
        image[20:40, x : x + 15], there[15:45, x - 5 : x + 20] = 170.0, True
        image[5:10, 5:10], there[0:15, 0:15] = 200.0, True  # a shelf, or a hand that never moves: near all the time
        images.append(image)
        near.append(there)
    plain, told = still_background(images), still_background(images, near)
    assert plain is not None and told is not None and plain.bare is None and told.bare is not None
    stood = np.s_[22:38, 22:33]
    assert np.abs(plain.grey - wall)[stood].mean() > 40  # she is taken for the wall
    assert np.abs(told.grey - wall)[stood].mean() < 1.5 * noise and told.bare[stood].all()
    assert not told.bare[0:15, 0:15].any() and (told.grey[5:10, 5:10] == 200.0).all()
    assert not told.shown_by(images[0])[stood].any()
