"""Robust statistics against numpy's, against known scatter, and where there is nothing to take a median of."""

import numpy as np
import pytest
from scipy.stats import norm

from tricap.core.geometry.robust import MAD_TO_SIGMA, finite_median, mad_sigma, masked_median

EVEN, ODD = [4.0, 1.0, 3.0, 2.0], [5.0, 1.0, 2.0]


@pytest.mark.parametrize("values", [EVEN, ODD, [7.0], [2.0, 2.0, 2.0, 9.0], [1.0, 2.0, 2.0, 3.0]])
def test_the_masked_median_is_numpys_of_what_the_mask_selects(values: list[float]) -> None:
    padded = np.array([[-50.0, *values, 1e6, np.nan]])
    mask = np.array([[False, *(True for _ in values), False, False]])
    assert masked_median(padded, mask).tolist() == [np.median(values)]


def test_masked_medians_of_rows_of_every_length() -> None:
    random = np.random.default_rng(1)
    values, mask = random.integers(0, 6, (200, 9)).astype(float), random.random((200, 9)) < 0.5
    expected = [np.median(v[m]) if m.any() else 0.0 for v, m in zip(values, mask)]
    assert masked_median(values, mask).tolist() == expected
    assert masked_median(values.T, mask.T, axis=0).tolist() == expected
    three = np.repeat(values[..., None], 3, axis=2)
    assert np.array_equal(masked_median(three, mask[..., None], axis=1), np.repeat(np.array(expected)[:, None], 3, axis=1))


def test_masked_medians_of_nothing() -> None:
    assert masked_median(np.ones((2, 3)), np.zeros((2, 3), dtype=bool)).tolist() == [0.0, 0.0]
    assert masked_median(np.ones((2, 0)), np.zeros((2, 0), dtype=bool)).tolist() == [0.0, 0.0]
    assert masked_median(np.ones((0, 3)), np.zeros((0, 3), dtype=bool)).shape == (0,)


def test_the_median_of_finite_values() -> None:
    assert finite_median([*EVEN, np.nan, np.inf]) == 2.5
    assert np.isnan(finite_median([])) and finite_median(np.array([np.nan]), 0.0) == 0.0


def test_sigma_from_the_median_absolute_deviation() -> None:
    random = np.random.default_rng(2)
    residuals = random.normal(0, 3.0, (400, 101))
    assert pytest.approx(1 / norm.ppf(0.75), rel=1e-4) == MAD_TO_SIGMA
    assert float(mad_sigma(residuals)) == pytest.approx(3.0, rel=0.02)
    residuals[:, :20] = 1e3  # a fifth of blunders: the median becomes the quantile of 5/8 of the rest
    expected = 3.0 * norm.ppf(0.5 + 0.5 * 50.5 / 81) / norm.ppf(0.75)
    assert mad_sigma(residuals, 1).mean() == pytest.approx(expected, rel=0.02)
    good = residuals < 1e3
    assert mad_sigma(residuals, 1, good).mean() == pytest.approx(3.0, rel=0.02)
    assert mad_sigma(residuals, 1, np.zeros_like(good)).tolist() == [0.0] * 400
