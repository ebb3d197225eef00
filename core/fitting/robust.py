"""Robust weights of residuals x in units of their robust scale: Geman-McClure or Huber."""

import numpy as np

MAD_TO_SIGMA = 1.4826
SMALLEST_SCALE = 0.05


def robust_scale(residuals: np.ndarray, fallback: float = 1.0) -> float:
    """Standard deviation of the good residuals from the median of their absolute values."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(residuals))), SMALLEST_SCALE) if len(residuals) > 4 else fallback


def robust_weights(x: np.ndarray, kind: str, width: float) -> np.ndarray:
    """Weights in (0, 1]; Geman-McClure's is ¼ at `width`, so that √w, a residual's pull, is ½ there."""
    return 1 / (1 + (x / width) ** 2) ** 2 if kind == "geman-mcclure" else np.minimum(1.0, width / np.maximum(np.abs(x), 1e-12))


def variance_factor(x: np.ndarray, kind: str, width: float) -> float:
    """By how much the inverse of the weighted normal equations understates the covariance: E[ψ²] E[w] / E[ψ']² (Huber 1981, §7.6)."""
    if len(x) < 20:
        return 1.0
    w = robust_weights(x, kind, width)
    slope: np.ndarray
    if kind == "geman-mcclure":
        u = (x / width) ** 2
        slope = (1 - 3 * u) / (1 + u) ** 3
    else:
        slope = (np.abs(x) < width).astype(float)
    least = max(float(np.mean(slope)), 0.05)
    return float(np.clip(np.mean((w * x) ** 2) * np.mean(w) / least**2, 0.5, 10.0))
