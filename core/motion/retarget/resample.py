"""The same motion at another frame rate."""

from dataclasses import replace

import numpy as np

from ...images.fields import frame_time_s
from .rig import Motion
from .turns import between


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
