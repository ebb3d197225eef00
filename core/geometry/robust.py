"""Robust statistics: medians of masked rows, standard deviations from the median absolute deviation (MAD).

The MAD of a normal distribution is Φ⁻¹(3/4) σ (Hampel 1974), so that

    σ̂ = median |v| / Φ⁻¹(3/4) ,   v: residuals about their centre                                                          (1)
"""

from collections.abc import Sequence

import numpy as np

MAD_TO_SIGMA = 1.4826  # 1 / Φ⁻¹(3/4)


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
