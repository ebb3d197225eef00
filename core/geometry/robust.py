"""Robust statistics: medians of masked rows, standard deviations from the median absolute deviation (MAD), and local polynomials.

The MAD of a normal distribution is Φ⁻¹(3/4) σ (Hampel 1974), so that

    σ̂ = median |v| / Φ⁻¹(3/4) ,   v: residuals about their centre                                                          (1)

A local polynomial z(a, b) is fitted by iteratively reweighted least squares with Tukey's biweight (Beaton & Tukey 1974):

    Σ w v² + ridge → min ,   v = z − c · m(a, b) ,   m = 1, a, b [, ½ a², a b, ½ b²]                                         (2)
    w ← (1 − (v / 4.685 σ̂)²)² inside 4.685 σ̂, 0 outside                                                                      (3)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MAD_TO_SIGMA = 1.482602218505602  # 1 / Φ⁻¹(3/4)
TUKEY = 4.685  # of (3), in sigmas: 95 % efficiency for normal errors
REWEIGHTINGS = 3
RIDGE = (1e-9, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2)  # with coordinates in units of the radius: a thin neighbourhood falls back to a plane
POWER = np.array([0, 1, 1, 2, 2, 2])  # of the unit of length in each coefficient of (2)


def masked_median(values: np.ndarray, mask: np.ndarray, axis: int = -1) -> np.ndarray:
    """Median along an axis of the values that the mask selects, zero where it selects none. The mask broadcasts to the values.

    Of an even number it is the mean of the middle two, as numpy's.
    """
    mask = np.broadcast_to(mask, values.shape)
    size, count = values.shape[axis], mask.sum(axis=axis, keepdims=True)
    if not size:
        return np.zeros(count.squeeze(axis).shape)
    ordered = np.sort(np.where(mask, values, np.inf), axis=axis)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis)
    high = np.take_along_axis(ordered, np.minimum(count // 2, size - 1), axis)
    return np.where(count > 0, 0.5 * (low + high), 0.0).squeeze(axis)


def finite_median(values: Sequence[float] | np.ndarray, empty: float = np.nan) -> float:
    """The median of the finite values, `empty` where there are none."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    return float(np.median(finite)) if len(finite) else empty


def mad_sigma(residuals: np.ndarray, axis: int | None = None, mask: np.ndarray | None = None) -> np.ndarray:
    """Standard deviation (1) of residuals about their centre, along an axis or of all of them.

    With a mask: of the residuals that it selects, zero where it selects none."""
    size = np.abs(residuals)
    if mask is not None:
        return MAD_TO_SIGMA * masked_median(size, mask, -1 if axis is None else axis)
    return np.asarray(MAD_TO_SIGMA * np.asarray(np.median(size, axis=axis), dtype=np.float64))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PolynomialFit:
    """The polynomials (2) about N points, each through its M neighbours."""

    coefficients: np.ndarray  # (N, P)
    scatter: np.ndarray  # (N,) sigma (1) of the neighbours about (2)
    weights: np.ndarray  # (N, M) of (3), with which (2) was solved last; 0 where there is no neighbour

    @property
    def support(self) -> np.ndarray:
        """(N,) the share of the places for neighbours that lie on (2); at an outline of grid cells half of them or less."""
        return np.asarray(self.weights.mean(axis=1))


def fit_polynomial(
    a: np.ndarray, b: np.ndarray, z: np.ndarray, there: np.ndarray, *, degree: int, radius: float, min_scale: np.ndarray
) -> PolynomialFit:
    """Fit (2) to the values z (N, M) of neighbours at (a, b) from each point, as far as they are `there`; 0 without neighbours.

    `radius` is the reach of the neighbourhood in the unit of a and b. Residuals below `min_scale` (N,) count fully.
    """
    m = monomials(a / radius, b / radius, degree)
    ridge = np.diag(RIDGE[: m.shape[2]])
    z, weight = np.where(there, z, 0.0), there.astype(np.float64)
    for step in range(REWEIGHTINGS + 1):
        weighted = (weight[:, :, None] * m).transpose(0, 2, 1)
        c = np.linalg.solve(weighted @ m + ridge, weighted @ z[:, :, None])[..., 0]  # (2)
        residual = z - np.einsum("nmi,ni->nm", m, c)
        scatter = mad_sigma(residual, 1, there)
        if step < REWEIGHTINGS:
            ratio = residual / (TUKEY * np.maximum(scatter, min_scale))[:, None]
            weight = there * np.clip(1 - ratio**2, 0, 1) ** 2  # (3)
    return PolynomialFit(coefficients=c / radius ** POWER[: m.shape[2]], scatter=scatter, weights=weight)


def monomials(a: np.ndarray, b: np.ndarray, degree: int) -> np.ndarray:
    """1, a, b (degree 1) and ½ a², a b, ½ b² (degree 2) along a new last axis."""
    return np.stack([np.ones_like(a), a, b] + ([0.5 * a * a, a * b, 0.5 * b * b] if degree == 2 else []), axis=-1)
