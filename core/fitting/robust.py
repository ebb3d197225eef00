"""Robust weights of residuals x in units of their robust scale: Geman-McClure or Huber."""

import numpy as np

from ..geometry.robust import mad_sigma

SMALLEST_SCALE = 0.05  # of unit-weight residuals: perfect data must not make infinite weights
ENOUGH_FOR_SCALE = 5  # residuals for a median
ENOUGH = 20  # residuals for a variance factor
LEAST_SLOPE = 0.05  # of E[ψ']: mostly outliers, and the factor would be unbounded
FACTOR_RANGE = (0.5, 10.0)


def robust_scale(residuals: np.ndarray, fallback: float = 1.0) -> float:
    """Standard deviation of the good residuals from the median of their absolute values."""
    return max(float(mad_sigma(residuals)), SMALLEST_SCALE) if len(residuals) >= ENOUGH_FOR_SCALE else fallback


def robust_weights(x: np.ndarray, kind: str, width: float) -> np.ndarray:
    """Weights in (0, 1]; Geman-McClure's is ¼ at `width`, so that √w, a residual's pull, is ½ there."""
    return 1 / (1 + (x / width) ** 2) ** 2 if kind == "geman-mcclure" else np.minimum(1.0, width / np.maximum(np.abs(x), 1e-12))


def variance_factor(x: np.ndarray, kind: str, width: float) -> float:
    """Factor from the inverse of the weighted normal equations to the covariance: E[ψ²] E[w] / E[ψ']² (Huber 1981, §7.6)."""
    if len(x) < ENOUGH:
        return 1.0
    w = robust_weights(x, kind, width)
    slope: np.ndarray
    if kind == "geman-mcclure":
        u = (x / width) ** 2
        slope = (1 - 3 * u) / (1 + u) ** 3
    else:
        slope = (np.abs(x) < width).astype(float)
    mean_slope = max(float(np.mean(slope)), LEAST_SLOPE)
    return float(np.clip(np.mean((w * x) ** 2) * np.mean(w) / mean_slope**2, *FACTOR_RANGE))
