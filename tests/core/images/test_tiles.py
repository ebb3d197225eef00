"""The spline is computed in tiles, where it is sampled: with the same values, whoever samples first."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tricap.core.images.sampling import TILE, SplineImage

IMAGE = np.random.default_rng(4).uniform(0, 255, (3 * TILE + 7, 2 * TILE + 1)).astype(np.float32)


def every_pixel(dx: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[0 : IMAGE.shape[0], 0 : IMAGE.shape[1]].astype(np.float32)
    return x + np.float32(dx), y


def test_only_the_tiles_that_are_sampled_are_computed() -> None:
    image = SplineImage(IMAGE)
    image.sample(np.full((1, 1), 3.0, np.float32), np.full((1, 1), TILE + 3.0, np.float32))
    assert image._ready.sum() == 1 and image._ready[1, 0]
    image.sample_patches(np.array([[TILE - 2.0, 5.0]]), np.eye(2)[None], np.array([[1, 1], [-3, 3], [-3, 3]], dtype=np.float32))
    assert image._ready.sum() == 4 and image._ready[:2, :2].all()


def test_no_tiles_are_computed_between_patches() -> None:
    image, basis = SplineImage(np.zeros((200, 200), np.float32)), np.array([[1, 1], [-6, 6], [-6, 6]], dtype=np.float32)
    far_apart, shapes = np.array([[8.0, 8.0], [190.0, 190.0], [100.0, 100.0]]), np.stack([np.eye(2), np.eye(2), 4 * np.eye(2)])
    image.sample_patches(far_apart[:2], shapes[:2], basis)
    assert image._ready.sum() == 8
    image.sample_patches(far_apart, shapes, basis)  # one that is larger than usual
    assert image._ready[2:4, 2:4].all() and image._ready.sum() == 12


def test_patches_have_the_values_of_the_whole_spline() -> None:
    """Wherever they are and however large, inside the image or across its border."""
    rng, basis = (
        np.random.default_rng(1),
        np.mgrid[:1, -8:9, -8:9].reshape(3, -1).astype(np.float32) + np.array([[1], [0], [0]], np.float32),
    )
    for size in (0.1, 0.8):
        parts, whole = SplineImage(IMAGE), SplineImage(IMAGE)
        whole.sample(*every_pixel())
        centre, shape = (
            rng.uniform((-5, -5), (IMAGE.shape[1] + 5, IMAGE.shape[0] + 5), (40, 2)),
            np.eye(2) + rng.normal(0, size, (40, 2, 2)),
        )
        assert np.array_equal(parts.sample_patches(centre, shape, basis), whole.sample_patches(centre, shape, basis))


def test_the_order_changes_no_bit() -> None:
    whole, parts = SplineImage(IMAGE), SplineImage(IMAGE)
    x, y = every_pixel(0.37)
    for rows in (slice(60, 90), slice(0, 8), slice(30, 70)):
        parts.sample(x[rows], y[rows])
    assert (whole.sample(x, y) == parts.sample(x, y)).all()


def test_tiles_meet_without_a_seam() -> None:
    """Noise is the worst case: the exact spline at quarter pixels, also across the borders of tiles."""
    x, y = every_pixel(0.25)
    x = np.minimum(x, IMAGE.shape[1] - 1)
    exact = map_coordinates(IMAGE.astype(float), [y, x], order=5, mode="mirror")
    assert np.abs(SplineImage(IMAGE).sample(x, y) - exact).max() < 1e-3


@pytest.mark.parametrize("outside", [(-4.3, 5.0), (5.0, -9.7), (IMAGE.shape[1] + 3.2, 9.0), (20.0, IMAGE.shape[0] + 30.5)])
def test_what_lies_beyond_the_border_is_mirrored(outside: tuple[float, float]) -> None:
    h, w = IMAGE.shape
    mirrored = [abs(v) if v < n else 2 * (n - 1) - v for v, n in zip(outside, (w, h))]
    at, same = (np.array(v, dtype=np.float32).reshape(2, 1, 1) for v in (outside, mirrored))
    assert abs(SplineImage(IMAGE).sample(at[0], at[1])[0, 0] - SplineImage(IMAGE).sample(same[0], same[1])[0, 0]) < 2e-3


def test_positions_that_are_no_numbers_do_no_harm() -> None:
    at = np.array([[np.nan, 3.0, 1e9, -1e9]], dtype=np.float32)
    assert SplineImage(IMAGE).sample(at, at[:, ::-1].copy()).shape == (1, 4)
