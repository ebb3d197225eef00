"""Robust statistics against numpy's, against known scatter, and where there is nothing to take a median of."""

import numpy as np
import pytest
from scipy.stats import norm

from tricap.core.geometry.robust import MAD_TO_SIGMA, finite_median, fit_polynomial, mad_sigma, masked_median, monomials

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
    assert pytest.approx(1 / norm.ppf(0.75), rel=1e-15) == MAD_TO_SIGMA
    assert float(mad_sigma(residuals)) == pytest.approx(3.0, rel=0.02)
    residuals[:, :20] = 1e3  # a fifth of blunders: the median becomes the quantile of 5/8 of the rest
    expected = 3.0 * norm.ppf(0.5 + 0.5 * 50.5 / 81) / norm.ppf(0.75)
    assert mad_sigma(residuals, 1).mean() == pytest.approx(expected, rel=0.02)
    good = residuals < 1e3
    assert mad_sigma(residuals, 1, good).mean() == pytest.approx(3.0, rel=0.02)
    assert mad_sigma(residuals, 1, np.zeros_like(good)).tolist() == [0.0] * 400


def neighbourhoods(n: int, seed: int, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Offsets a, b and values z (n, 49) of the quadrics c (n, 6) in neighbourhoods of 7×7, with noise."""
    random = np.random.default_rng(seed)
    b, a = (np.tile(d.ravel() * 4.0, (n, 1)) for d in np.mgrid[-3:4, -3:4])
    c = random.normal(0, 1, (n, 6)) * (1, 0.1, 0.1, 0.01, 0.01, 0.01)
    return a, b, np.einsum("nmi,ni->nm", monomials(a, b, 2), c) + random.normal(0, noise, a.shape), c


def test_a_polynomial_without_noise_is_found_again() -> None:
    a, b, z, c = neighbourhoods(50, 3, 0.0)
    fit = fit_polynomial(a, b, z, np.ones_like(z, dtype=bool), degree=2, radius=12.0, min_scale=np.full(50, 0.1))
    off = np.abs(fit.coefficients - c).max(axis=0)  # the ridge takes a curvature about 0.5 % of its size, 0.03 / px²
    assert (off < (0.01, 1e-4, 1e-4, 2e-4, 2e-4, 2e-4)).all() and fit.support.min() > 0.99 and fit.scatter.max() < 0.01


def test_a_polynomial_through_blunders_and_what_its_scatter_says() -> None:
    a, b, z, c = neighbourhoods(300, 4, 0.1)
    blunder = np.random.default_rng(5).random(z.shape) < 0.15
    fit = fit_polynomial(a, b, z + 20.0 * blunder, np.ones_like(blunder), degree=2, radius=12.0, min_scale=np.full(300, 0.01))
    clean = fit_polynomial(a, b, z, ~blunder, degree=2, radius=12.0, min_scale=np.full(300, 0.01))
    assert np.median(np.abs(fit.coefficients - c)[:, 0]) < 1.5 * np.median(np.abs(clean.coefficients - c)[:, 0])
    assert fit.weights[blunder].mean() < 0.15 and np.median(fit.weights[~blunder]) > 0.8  # measured 0.10: some places have a third of them
    assert np.median(clean.scatter) == pytest.approx(0.1 * np.sqrt(1 - 6 / (0.85 * 49)), rel=0.05)


def test_a_polynomial_where_neighbours_are_missing() -> None:
    a, b, z, c = neighbourhoods(3, 6, 0.0)
    there = np.ones_like(z, dtype=bool)
    there[0], there[1, a[1] > 0] = False, False
    z[~there] = np.nan
    fit = fit_polynomial(a, b, z, there, degree=2, radius=12.0, min_scale=np.full(3, 1e-3))
    assert not fit.coefficients[0].any() and fit.scatter[0] == 0 and fit.support[0] == 0
    assert np.abs(fit.coefficients[1:] - c[1:]).max() < 0.02
    line = there & (b == 0)  # along one line: what it does not tell comes out as a plane, not as a wild quadric
    thin = fit_polynomial(a, b, z, line, degree=2, radius=12.0, min_scale=np.full(3, 1e-3))
    assert np.abs(thin.coefficients[2] - c[2])[[0, 1, 3]].max() < 0.02 and np.abs(thin.coefficients[2, [2, 4, 5]]).max() < 1e-6
