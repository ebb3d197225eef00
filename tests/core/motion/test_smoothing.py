"""Smoothing that knows the sigmas, against the dense solution and a known motion."""

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.motion.smoothing import smooth

FPS, ACCELERATION = 30.0, 20.0


def test_it_solves_its_equation() -> None:
    random = np.random.default_rng(1)
    y, sigma = random.normal(size=12), random.uniform(0.01, 0.3, 12)
    y[5] = np.nan
    D = np.diff(np.eye(12), n=2, axis=0) * FPS**2 / ACCELERATION
    W = np.diag(np.where(np.isfinite(y), sigma**-2, 0.0))
    dense = np.linalg.solve(W + D.T @ D, W @ np.nan_to_num(y))
    np.testing.assert_allclose(smooth(y, sigma, FPS, ACCELERATION), dense, atol=1e-9)


def test_uncertain_values_move_and_certain_ones_stay() -> None:
    random, t = np.random.default_rng(2), np.arange(200) / FPS
    truth, sigma = np.sin(2 * t), np.where((np.arange(200) // 25) % 2, 0.2, 0.002)
    y = truth + sigma * random.normal(size=200)
    x = smooth(y, sigma, FPS, ACCELERATION)
    bad = sigma > 0.1
    assert np.sqrt(np.mean((x - truth)[bad] ** 2)) < 0.35 * np.sqrt(np.mean((y - truth)[bad] ** 2))
    assert np.abs(x - y)[~bad].max() < 3 * 0.002


def test_what_cannot_be_smoothed() -> None:
    y = np.array([1.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(smooth(y, np.ones(4), FPS, ACCELERATION), y)
    with pytest.raises(InputError, match="above zero"):
        smooth(np.zeros(4), np.ones(4), FPS, 0.0)
