"""The solid noise: normalised, band-limited, periodic, reproducible."""

import numpy as np

from tricap.core.synthetic.film import SolidNoise, solid_noise


def test_noise_is_normalised_band_limited_and_reproducible() -> None:
    noise = solid_noise(3, cells=64, pitch_m=0.002, shortest_m=0.012, longest_m=0.040)
    assert abs(noise.values.std() - 1) < 1e-4 and abs(noise.values.mean()) < 1e-4
    power = np.abs(np.fft.fftn(noise.values)) ** 2
    k = np.fft.fftfreq(64, 0.002)
    radius = np.sqrt(k[:, None, None] ** 2 + k[None, :, None] ** 2 + k[None, None, :] ** 2)
    assert power[(radius < 1 / 0.041) | (radius > 1 / 0.0119)].sum() < 1e-6 * power.sum()
    octaves = [power[(radius > low) & (radius <= 1.3 * low)].sum() for low in (30.0, 60.0)]
    assert 0.7 < octaves[0] / octaves[1] < 1.4  # equal power in bands of equal ratio
    assert np.array_equal(noise.values, solid_noise(3, cells=64, pitch_m=0.002, shortest_m=0.012, longest_m=0.040).values)
    assert not np.array_equal(noise.values, solid_noise(4, cells=64, pitch_m=0.002, shortest_m=0.012, longest_m=0.040).values)


def test_noise_between_cells_and_beyond_the_volume() -> None:
    noise = SolidNoise(values=np.random.default_rng(0).normal(size=(8, 8, 8)), pitch_m=0.5)
    at = np.array([[1.0, 0.5, 2.0], [1.25, 0.5, 2.0], [-3.0, 4.5, 6.0]])
    a, b = noise.values[2, 1, 4], noise.values[3, 1, 4]
    assert np.allclose(noise(at), [a, (a + b) / 2, a], atol=1e-6)
