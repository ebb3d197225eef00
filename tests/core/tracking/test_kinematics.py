"""Velocities and accelerations: exact on cubics, their sigmas against the observed scatter, gaps stay gaps."""

import numpy as np
import pytest

from tricap.core.tracking.trajectories import differences, smoothed

DT = 1 / 25


def cubic(frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration (T, 1, 3) of a cubic."""
    t = (np.arange(frames) * DT)[:, None, None]
    c = np.array([0.3, -0.2, 0.1])
    return c * (1 + 2 * t - 4 * t**2 + 5 * t**3), c * (2 - 8 * t + 15 * t**2), c * (-8 + 30 * t)


def test_a_cubic_is_smoothed_exactly_up_to_its_ends() -> None:
    x, v, a = cubic(12)
    result = smoothed(x, np.full((12, 1), 1e-3), DT, 7)
    assert np.allclose(result.velocity_m_s, v, atol=1e-9) and np.allclose(result.acceleration_m_s2, a, atol=1e-7)


@pytest.mark.parametrize("frames", [0, 5, 7, 11])
def test_sigmas_are_the_observed_scatter(frames: int) -> None:
    """5,000 noisy still points, single differences (0) and windows: RMS of error over sigma within 5 %."""
    random = np.random.default_rng(frames)
    sigma = np.array([1.0, 2.0, 0.5, 1.0, 1.5, 1.0, 2.0, 1.0, 1.0, 3.0, 1.0, 1.0, 1.0])[:, None].repeat(5_000, 1) * 1e-3
    x = random.standard_normal((13, 5_000, 3)) * sigma[:, :, None] / np.sqrt(3)
    result = smoothed(x, sigma, DT, frames) if frames else differences(x, sigma, DT)
    for value, s in ((result.velocity_m_s, result.sigma_velocity_m_s), (result.acceleration_m_s2, result.sigma_acceleration_m_s2)):
        z = np.linalg.norm(value, axis=2) / s
        there = np.isfinite(z).all(axis=1)
        assert there.sum() >= 11 and np.allclose(np.sqrt((z[there] ** 2).mean(axis=1)), 1.0, atol=0.05)


def test_smoothing_reduces_noise() -> None:
    """Seven frames instead of three: a fifth of the acceleration's noise."""
    sigma = np.full((15, 1), 1e-3)
    x = np.zeros((15, 1, 3))
    raw, smooth = differences(x, sigma, DT), smoothed(x, sigma, DT, 7)
    assert raw.sigma_acceleration_m_s2[7, 0] == pytest.approx(np.sqrt(6) * 1e-3 / DT**2)
    assert smooth.sigma_acceleration_m_s2[7, 0] < 0.2 * raw.sigma_acceleration_m_s2[7, 0]


def test_gaps_stay_gaps() -> None:
    x, v, _ = cubic(20)
    x[9] = np.nan
    x[16:19] = np.nan  # what follows is alone
    sigma = np.where(np.isnan(x[..., 0]), np.nan, 1e-3)
    result = smoothed(x, sigma, DT, 7)
    assert np.isnan(result.velocity_m_s[[9, 16, 17, 18, 19]]).all()
    assert np.allclose(result.velocity_m_s[[0, 8, 10, 15]], v[[0, 8, 10, 15]], atol=1e-8)
    raw = differences(x, sigma, DT)
    assert np.isnan(raw.velocity_m_s[9]).all() and np.isnan(raw.acceleration_m_s2[[8, 9, 10]]).all()
    assert np.isnan(raw.sigma_velocity_m_s[9]).all() and np.isfinite(raw.sigma_velocity_m_s[8]).all()


def test_one_frame_has_no_motion() -> None:
    result = differences(np.zeros((1, 2, 3)), np.ones((1, 2)), 1.0)
    assert np.isnan(result.velocity_m_s).all() and np.isnan(smoothed(np.zeros((1, 2, 3)), np.ones((1, 2)), 1.0, 7).velocity_m_s).all()
