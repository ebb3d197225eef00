"""Combing of synthetic interlaced and progressive images."""

import cv2
import numpy as np
import pytest

from tricap.core.images.combing import combing


def moving(time: float, noise: np.random.Generator) -> np.ndarray:
    """A textured patch that moves sideways over a textured ground, with noise."""
    random = np.random.default_rng(3)
    ground = cv2.GaussianBlur(random.normal(128, 90, (120, 200)), (0, 0), 1.5)
    patch = cv2.GaussianBlur(random.normal(128, 180, (80, 60)), (0, 0), 2.0)
    shift = np.array([[1.0, 0, 30 + 8 * time], [0, 1, 20]])
    over = cv2.warpAffine(patch, shift, (200, 120), flags=cv2.INTER_LINEAR, borderValue=-1.0)
    return np.clip(np.where(over >= 0, over, ground) + noise.normal(0, 2, ground.shape), 0, 255)


def images(first: str, count: int = 4) -> list[np.ndarray]:
    noise, made = np.random.default_rng(4), []
    for t in range(count):
        early, late = moving(t, noise), moving(t + 0.5, noise)
        odd, even = {"odd": (early, late), "even": (late, early), "none": (early, early)}[first]
        image = odd.copy()
        image[1::2] = even[1::2]
        made.append(image)
    return made


@pytest.mark.parametrize("first", ["odd", "even"])
def test_fields_and_their_order_are_found(first: str) -> None:
    made = images(first)
    found = combing(list(zip(made, made[1:])))
    assert found.found and found.first == first and found.ratio > 2


def test_progressive_still_and_noisy_images_are_not_combed() -> None:
    made = images("none")
    assert not combing(list(zip(made, made[1:]))).found
    still = images("odd")[:1] * 2
    assert np.isnan(combing([(still[0], still[1])]).ratio)
    noise = np.random.default_rng(5).normal(128, 40, (2, 100, 100))
    assert 0.8 < combing([(noise[0], noise[1])]).ratio < 1.2
