"""Solid texture: band-limited noise in space, which sticks to a moving body through its rest-pose coordinates (Perlin 1985; Peachey 1985).

The noise is white noise filtered in the Fourier domain to wavelengths between two limits, with equal power in every octave:
amplitude ∝ |k|^(−3/2) in three dimensions. It repeats after the volume's width.
"""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from scipy.ndimage import map_coordinates

from ..values import frozen


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SolidNoise:
    """Noise of mean 0 and standard deviation 1 on a cubic grid of N³ cells, `pitch_m` apart, continued periodically."""

    values: np.ndarray  # (N, N, N) float32
    pitch_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", frozen(self.values, (None, None, None), np.float32, "values"))

    def __call__(self, xyz_m: np.ndarray) -> np.ndarray:
        """The noise (N,) at points (N, 3), trilinear between the grid's cells."""
        at = np.asarray(xyz_m).T / self.pitch_m
        return map_coordinates(self.values, at, order=1, mode="grid-wrap", output=np.float32)


def solid_noise(seed: int, *, cells: int = 160, pitch_m: float = 0.002, shortest_m: float = 0.012, longest_m: float = 0.080) -> SolidNoise:
    """Noise with wavelengths from `shortest_m` to `longest_m`. A seed gives the same noise everywhere; 160³ cells take 0.3 s."""
    white = np.random.default_rng(seed).standard_normal((cells, cells, cells), dtype=np.float32)
    k = scipy.fft.fftfreq(cells, pitch_m)
    k2 = k[:, None, None] ** 2 + k[None, :, None] ** 2 + scipy.fft.rfftfreq(cells, pitch_m) ** 2
    band = (k2 >= longest_m**-2) & (k2 <= shortest_m**-2)
    amplitude = np.where(band, np.where(band, k2, 1.0) ** -0.75, 0.0).astype(np.float32)
    values = scipy.fft.irfftn(scipy.fft.rfftn(white) * amplitude, s=white.shape)
    return SolidNoise(values=values / values.std(), pitch_m=pitch_m)
