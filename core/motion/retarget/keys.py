"""Keyframes: resampling a motion at another frame rate, and key reduction.

Key reduction keeps those keys of a motion keyed in every frame from which linear interpolation gives the others within a tolerance: Ramer
(1972), Douglas and Peucker (1973), with the distance along
the values, of one channel or of all channels of a bone at once.
"""

from dataclasses import replace

import numpy as np

from ...geometry.rotation import between
from ...images.interlace import frame_time_s
from .rig import Motion


def resampled(motion: Motion, fps: float, first_frame: float) -> Motion:
    """The motion at `fps` frames per second beginning at `first_frame`: rotations by the shortest path, positions linearly."""
    frames = motion.frames
    time = frame_time_s(frames - frames[0], motion.fps)
    count = max(int(np.floor(time[-1] * fps + 1e-6)) + 1, 1)
    wanted = frame_time_s(np.arange(count), fps)
    after = np.clip(np.searchsorted(time, wanted - 1e-9), 1, max(len(time) - 1, 1)) if len(time) > 1 else np.zeros(count, dtype=np.intp)
    before = np.maximum(after - 1, 0)
    span = np.where(time[after] > time[before], time[after] - time[before], 1.0)
    part = np.clip((wanted - time[before]) / span, 0.0, 1.0)
    head = motion.head_m[before] + part[:, None, None] * (motion.head_m[after] - motion.head_m[before])
    R = between(motion.R[before], motion.R[after], np.broadcast_to(part[:, None], head.shape[:2]))
    return replace(motion, fps=fps, frames=first_frame + np.arange(count), R=R, head_m=head, residual=None)


def needed_keys(times: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """Indices (n,) of the keys to keep, of values (T,) or (T, C) at times (T,), in order.

    Linear interpolation between them is nowhere off by more than `tolerance`, all channels together (Euclidean). The first and the last
    are always among them, unless all values lie within the tolerance of the first.
    """
    t = len(times)
    values = np.asarray(values, dtype=np.float64)
    values = values[:, None] if values.ndim == 1 else values
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
