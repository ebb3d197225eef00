"""Video fields: full-frame coordinates there and back, and a blob found at its true place in either field."""

import numpy as np
import pytest

from tricap.core.images.interlace import BOTH, INTERLACE, field_layout, row_grid


@pytest.mark.parametrize("interlaced", INTERLACE)
@pytest.mark.parametrize("height", [11, 12])
def test_coordinates_there_and_back(interlaced: str, height: int) -> None:
    grid = row_grid(interlaced)
    frame = np.arange(height * 5, dtype=np.float32).reshape(height, 5)
    rows = grid.rows(frame)
    assert rows.flags.c_contiguous
    for j in range(len(rows)):
        x, y = grid.to_frame(np.array([3.0, j]))
        assert rows[j, 3] == frame[int(y), int(x)] and x == 3
    xy = np.random.default_rng(0).uniform(0, 9, (4, 6, 2))
    assert np.allclose(grid.from_frame(grid.to_frame(xy)), xy, atol=1e-15)


def test_odd_lines_are_the_first_third_and_fifth() -> None:
    frame = np.arange(6.0)[:, None] * np.ones(3)
    assert row_grid("odd").rows(frame)[:, 0].tolist() == [0, 2, 4]
    assert row_grid("even").rows(frame)[:, 0].tolist() == [1, 3, 5]
    assert row_grid("none").rows(frame)[:, 0].tolist() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("interlaced", INTERLACE)
def test_a_blob_is_found_at_its_place_in_the_frame(interlaced: str) -> None:
    grid = row_grid(interlaced)
    y, x = np.mgrid[0:60, 0:60]
    for cx, cy in np.random.default_rng(1).uniform(25, 35, (20, 2)):
        rows = grid.rows(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 3.0**2)))
        v, u = np.mgrid[0 : rows.shape[0], 0:60]
        centre = np.array([(rows * u).sum(), (rows * v).sum()]) / rows.sum()
        assert np.abs(grid.to_frame(centre) - [cx, cy]).max() < 1e-3


def test_covariances_scale_with_the_rows() -> None:
    noise = np.random.default_rng(2).multivariate_normal([0, 0], [[0.2, 0.05], [0.05, 0.1]], 20000)
    for interlaced in INTERLACE:
        grid = row_grid(interlaced)
        frame = grid.to_frame(noise)
        assert np.allclose(np.cov(frame.T), grid.covariance_to_frame(np.cov(noise.T)), rtol=1e-9)


def test_both_fields_are_two_instants_of_an_image() -> None:
    frame = np.arange(6.0)[:, None] * np.ones(3)
    for first, expected in (("odd", [[0, 2, 4], [1, 3, 5]]), ("even", [[1, 3, 5], [0, 2, 4]])):
        both = field_layout(BOTH, first)
        assert [both.rows(n).rows(frame)[:, 0].tolist() for n in range(4)] == expected * 2
        assert [both.image(n) for n in range(4)] == [0, 0, 1, 1] and both.per_image == 2
    assert [field_layout("even").image(n) for n in range(3)] == [0, 1, 2] and field_layout("even").rows(1) == row_grid("even")


@pytest.mark.parametrize("height", [11, 12])
def test_rows_of_the_other_field_are_interpolated(height: int) -> None:
    """A ramp is its own interpolation, but where an outermost row has one neighbour only."""
    ramp = np.arange(float(height))[:, None] * np.ones(4)
    for interlaced in ("odd", "even"):
        woven = ramp.copy()
        grid = row_grid(interlaced)
        woven[1 - grid.offset :: 2] = 999.0
        assert np.array_equal(grid.whole(woven)[1:-1], ramp[1:-1]) and np.abs(grid.whole(woven) - ramp).max() <= 1
    assert row_grid("none").whole(ramp) is ramp
