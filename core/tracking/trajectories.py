"""Trajectories: position, velocity and acceleration of every tracked point, and why it ended.

    v_i = (X_{i+1} − X_{i−1}) / 2 dt ,   a_i = (X_{i+1} − 2 X_i + X_{i−1}) / dt²                      (1)

At the ends of a trajectory v is the one-sided difference and a is NaN. Gaps stay gaps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..values import frozen
from .step import TrackedFrame, TrackingSettings, TrackStatus


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Trajectories:
    """N points over T frames, world metres and seconds. NaN = not seen; `status` (T, N) is a TrackStatus."""

    frames: np.ndarray  # (T,)
    time_s: np.ndarray  # (T,)
    xyz_m: np.ndarray  # (T, N, 3)
    velocity_m_s: np.ndarray  # (T, N, 3)
    acceleration_m_s2: np.ndarray  # (T, N, 3)
    sigma_m: np.ndarray  # (T, N)
    status: np.ndarray  # (T, N)

    def __post_init__(self) -> None:
        t, n = self.sigma_m.shape
        object.__setattr__(self, "frames", frozen(self.frames, (t,), np.int32, "frames"))
        object.__setattr__(self, "status", frozen(self.status, (t, n), np.int8, "status"))
        for name, shape in dict(time_s=(t,), xyz_m=(t, n, 3), velocity_m_s=(t, n, 3), acceleration_m_s2=(t, n, 3), sigma_m=(t, n)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))

    @property
    def seen(self) -> np.ndarray:
        """(T, N) where a position was measured."""
        return np.isfinite(self.xyz_m[..., 0])


def assemble(steps: Sequence[TrackedFrame], fps: float) -> Trajectories:
    """The trajectories of consecutive tracked frames, in the order of their identities."""
    T, N = len(steps), 1 + max((int(s.identity.max()) for s in steps if len(s.identity)), default=-1)
    xyz, sigma = np.full((T, N, 3), np.nan), np.full((T, N), np.nan)
    status = np.zeros((T, N), dtype=np.int8)
    for t, s in enumerate(steps):
        xyz[t, s.identity] = s.xyz_m
        sigma[t, s.identity] = np.sqrt(np.trace(s.covariance_m2, axis1=1, axis2=2))
        status[t, s.identity] = TrackStatus.MEASURED
        status[t, s.ended] = s.reason
    frames = np.array([s.frame for s in steps], dtype=np.int32)
    return _with_kinematics(frames, frames / fps, xyz, sigma, status)


def filter_by_thresholds(trajectories: Trajectories, settings: TrackingSettings) -> Trajectories:
    """Filter 1 of the papers: cut a trajectory where it is too fast or accelerates too much, and remove what is short.

    A cut trajectory keeps its longest piece; the frames that went carry the reason. Trajectories without any frame left are dropped.
    """
    xyz, status = trajectories.xyz_m.copy(), trajectories.status.copy()
    sigma, seen = trajectories.sigma_m.copy(), trajectories.seen
    dt = float(np.median(np.diff(trajectories.time_s))) if len(trajectories.time_s) > 1 else 1.0
    with np.errstate(invalid="ignore"):
        noise = np.nan_to_num(sigma)
        fast = np.linalg.norm(trajectories.velocity_m_s, axis=2) > settings.max_speed + 3 * noise / (np.sqrt(2) * dt)
        jerky = np.linalg.norm(trajectories.acceleration_m_s2, axis=2) > settings.max_acceleration + 3 * np.sqrt(6) * noise / dt**2
    status[seen & jerky], status[seen & fast] = TrackStatus.ACCELERATES, TrackStatus.TOO_FAST
    kept = _longest_run(status == TrackStatus.MEASURED)
    short = kept & (kept.sum(axis=0) < settings.min_length)
    status[short] = TrackStatus.TOO_SHORT
    kept &= ~short
    xyz[~kept], sigma[~kept] = np.nan, np.nan
    alive = kept.any(axis=0)
    return _with_kinematics(trajectories.frames, trajectories.time_s, xyz[:, alive], sigma[:, alive], status[:, alive])


def _longest_run(mask: np.ndarray) -> np.ndarray:
    """Of each column of mask (T, N), only its longest run of True (the first, where several are as long)."""
    T, N = mask.shape
    length = np.zeros((T + 1, N), dtype=np.int32)
    for step in range(T):
        length[step + 1] = (length[step] + 1) * mask[step]
    end, longest = length.argmax(axis=0), length.max(axis=0)
    t = np.arange(1, T + 1)[:, None]
    return (t <= end) & (t > end - longest)


def _with_kinematics(frames: np.ndarray, time_s: np.ndarray, xyz: np.ndarray, sigma: np.ndarray, status: np.ndarray) -> Trajectories:
    dt = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    velocity, acceleration = np.full(xyz.shape, np.nan), np.full(xyz.shape, np.nan)
    if len(xyz) > 1:
        step = np.diff(xyz, axis=0) / dt
        forward, backward = np.concatenate([step, step[:1] * np.nan]), np.concatenate([step[:1] * np.nan, step])
        velocity = np.where(np.isnan(forward), backward, np.where(np.isnan(backward), forward, 0.5 * (forward + backward)))  # (1)
        acceleration = (forward - backward) / dt
    return Trajectories(
        frames=frames, time_s=time_s, xyz_m=xyz, velocity_m_s=velocity, acceleration_m_s2=acceleration, sigma_m=sigma, status=status
    )
