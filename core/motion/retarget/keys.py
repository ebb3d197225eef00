"""Fewer keys: of a motion keyed in every frame, those from which straight lines give the rest within a tolerance.

Ramer (1972), Douglas and Peucker (1973), on all channels of a bone at once.
"""

import numpy as np


def needed_keys(times: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """Indices of the keys to keep, of values (T, C) at times (T,): linear interpolation between them is nowhere off by more than
    `tolerance`, all channels together (Euclidean). The first and the last are always kept, unless one key says all."""
    t = len(times)
    if t < 2 or tolerance <= 0:
        return np.arange(t)
    if np.linalg.norm(values - values[0], axis=1).max() <= tolerance:
        return np.array([0])
    keep = np.zeros(t, dtype=bool)
    keep[[0, -1]] = True
    stack = [(0, t - 1)]
    while stack:
        a, b = stack.pop()
        if b - a < 2:
            continue
        part = ((times[a : b + 1] - times[a]) / (times[b] - times[a]))[:, None]
        off = np.linalg.norm(values[a : b + 1] - (values[a] + part * (values[b] - values[a])), axis=1)
        worst = a + int(np.argmax(off))
        if off[worst - a] > tolerance:
            keep[worst] = True
            stack += [(a, worst), (worst, b)]
    return np.flatnonzero(keep)
