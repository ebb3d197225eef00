"""Fewer keys: which frames of a curve must keep theirs so that straight lines between them stay within a tolerance.

The method of Ramer (1972) and Douglas & Peucker (1973), with the distance measured along the value: split where the straight line is
farthest off, until it is nowhere more than the tolerance off. No Blender in here.
"""

import numpy as np


def kept_keys(frames: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """Indices, in order, of the keys (T,) to keep; between them the straight line is within `tolerance` of every value."""
    frames, values = np.asarray(frames, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if len(frames) < 3:
        return np.arange(len(frames))
    keep, pending = {0, len(frames) - 1}, [(0, len(frames) - 1)]
    while pending:
        a, b = pending.pop()
        if b - a < 2:
            continue
        line = values[a] + (values[b] - values[a]) * (frames[a + 1 : b] - frames[a]) / (frames[b] - frames[a])
        off = np.abs(values[a + 1 : b] - line)
        worst = int(off.argmax())
        if off[worst] > tolerance:
            keep.add(a + 1 + worst)
            pending += [(a, a + 1 + worst), (a + 1 + worst, b)]
    return np.array(sorted(keep))
