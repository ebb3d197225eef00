"""Smoothing that knows the sigmas: a channel moves where it was measured badly and stays where it was measured well.

The smoothed channel x (T,) minimises, of the measured one y with its sigmas σ,

    Σ ((x_t − y_t) / σ_t)² + Σ ((x_{t−1} − 2 x_t + x_{t+1}) / (a Δt²))²                                               (1)

with the acceleration a that is expected of the motion: Whittaker's smoother (Eilers, A perfect smoother, Anal. Chem. 75, 2003), weighted.
"""

import numpy as np

from ..foundation.errors import InputError


def smooth(values: np.ndarray, sigma: np.ndarray, fps: float, acceleration: float) -> np.ndarray:
    """The smoothed channel (T,) of (1), in the unit of `values` (T,).

    `sigma` (T,): of the values, above zero; where either is NaN, the value comes from its neighbours. `acceleration`: a, per s².

    Raises:
        InputError: the acceleration or the frame rate is not above zero.
    """
    from scipy.linalg import solveh_banded

    if not (acceleration > 0 and fps > 0):
        raise InputError("The expected acceleration and the frame rate must be above zero.")
    known = np.isfinite(values) & np.isfinite(sigma) & (sigma > 0)
    if len(values) < 3 or known.sum() < 2:
        return np.array(values, dtype=np.float64)
    scale = float(sigma[known].min())
    weight = np.where(known, (scale / np.where(known, sigma, 1.0)) ** 2, 0.0)
    stiff = (scale * fps**2 / acceleration) ** 2
    bands = np.zeros((3, len(values)))  # diagonal and the two below it, of W + stiff DᵀD
    for offset, k in enumerate((1.0, -2.0, 1.0)):
        bands[0, offset : len(values) - 2 + offset] += stiff * k * k
    bands[0] += weight
    bands[1, :-2] += -2.0 * stiff
    bands[1, 1:-1] += -2.0 * stiff
    bands[2, :-2] += stiff
    found = solveh_banded(bands, weight * np.where(known, values, 0.0), lower=True)
    return np.asarray(found)
