"""Weak smoothness over time: every DOF's acceleration is zero within a sigma.

a_t = 2/(h1 + h2) · ((θ_{t+1} − θ_t)/h2 − (θ_t − θ_{t−1})/h1) = 0 ± σ ,   h1, h2: the times between the three frames
"""

from dataclasses import dataclass

import numpy as np

from .block_band import NormalEquations

SPAN_S = 0.1  # accelerations of a start are taken over this time, so that its noise does not count
LEAST = 0.1  # of the loosest sigma: however steady a motion was where it was seen


@dataclass(frozen=True, eq=False, kw_only=True)
class Acceleration:
    """Observations of T−2 accelerations for each of D DOFs."""

    time_s: np.ndarray  # (T,)
    sigma: np.ndarray  # (D,) rad/s², m/s²

    def coefficients(self) -> np.ndarray:
        """(T−2, 3) of θ_{t−1}, θ_t, θ_{t+1}."""
        h = np.diff(self.time_s)
        h1, h2 = h[:-1], h[1:]
        return (2 / (h1 + h2))[:, None] * np.stack([1 / h1, -1 / h1 - 1 / h2, 1 / h2], axis=1)

    def cost(self, motion: np.ndarray) -> float:
        """Sum of squares at a motion (T, D)."""
        if len(motion) < 3:
            return 0.0
        c = self.coefficients()
        values = c[:, 0, None] * motion[:-2] + c[:, 1, None] * motion[1:-1] + c[:, 2, None] * motion[2:]
        return float(np.sum((values / self.sigma) ** 2))

    def add_to(self, equations: NormalEquations, motion: np.ndarray) -> None:
        """Add the normal equations of these observations."""
        weight = 1 / self.sigma**2
        for t, c in enumerate(self.coefficients() if len(motion) > 2 else ()):
            value = weight * (c @ motion[t : t + 3])
            for i in range(3):
                equations.diagonal[t + i] += np.diag(c[i] ** 2 * weight)
                equations.g[t + i] -= c[i] * value
            equations.next1[t] += np.diag(c[1] * c[0] * weight)
            equations.next1[t + 1] += np.diag(c[2] * c[1] * weight)
            equations.next2[t] += np.diag(c[2] * c[0] * weight)


def typical_acceleration(motion: np.ndarray, known: np.ndarray, time_s: np.ndarray, loosest: np.ndarray) -> np.ndarray:
    """Sigma (D,) of the accelerations of a motion (T, D), from where it is `known` (T, D); between `LEAST` times and once the `loosest`.

    A hidden limb goes on as that limb moves where it is seen. The root mean square of second differences over `SPAN_S`.
    """
    step = max(1, round(SPAN_S / float(np.median(np.diff(time_s))))) if len(time_s) > 1 else 1
    if len(motion) < 2 * step + 3:
        return loosest
    h = (time_s[2 * step :] - time_s[: -2 * step]) / 2
    a = (motion[2 * step :] - 2 * motion[step:-step] + motion[: -2 * step]) / h[:, None] ** 2
    good = known[2 * step :] & known[step:-step] & known[: -2 * step]
    count = good.sum(axis=0)
    rms = np.sqrt((np.where(good, a, 0.0) ** 2).sum(axis=0) / np.maximum(count, 1))
    return np.where(count >= 3, np.clip(rms, LEAST * loosest, loosest), loosest)
