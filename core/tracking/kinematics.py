"""Velocity and acceleration of trajectories, raw and smoothed, with their sigmas.

    v_i = (X_{i+1} − X_{i−1}) / 2 dt ,   a_i = (X_{i+1} − 2 X_i + X_{i−1}) / dt²                            (1)
    σ_v = √(σ²_{i+1} + σ²_{i−1}) / 2 dt ,   σ_a = √(σ²_{i+1} + 4 σ²_i + σ²_{i−1}) / dt²                     (2)

Of single differences the noise is large: with σ = 1 mm at 25 frames/s, σ_a is 1.5 m/s². Smoothed values come from a cubic, by least
squares, through the frames that are nearest in time (Savitzky & Golay 1964, doi:10.1021/ac60214a047): at the ends of a trajectory they lie
on one side. With the coefficients c of the estimate, σ² = Σ c_j² σ_j². Beyond a gap nothing is taken, so gaps stay gaps.

Sigmas here are those of the whole vector (root of the summed variances), as `sigma_m` is, with errors of different frames independent; what
they have in common (calibration, the place on the body) does not move.
"""

from dataclasses import dataclass

import numpy as np

DEGREE = 3


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Kinematics:
    """Derivatives of N trajectories over T frames. NaN where the frames do not suffice."""

    velocity_m_s: np.ndarray  # (T, N, 3)
    acceleration_m_s2: np.ndarray  # (T, N, 3)
    sigma_velocity_m_s: np.ndarray  # (T, N)
    sigma_acceleration_m_s2: np.ndarray  # (T, N)


def differences(xyz_m: np.ndarray, sigma_m: np.ndarray, dt: float) -> Kinematics:
    """Raw values of positions (T, N, 3), (1) and (2); at the ends of a trajectory v is the one-sided difference, a NaN."""
    velocity, acceleration = np.full(xyz_m.shape, np.nan), np.full(xyz_m.shape, np.nan)
    sigma_v, sigma_a = np.full(sigma_m.shape, np.nan), np.full(sigma_m.shape, np.nan)
    if len(xyz_m) > 1:
        step, none = np.diff(xyz_m, axis=0) / dt, np.full((1, *xyz_m.shape[1:]), np.nan)
        forward, backward = np.concatenate([step, none]), np.concatenate([none, step])
        velocity = np.where(np.isnan(forward), backward, np.where(np.isnan(backward), forward, 0.5 * (forward + backward)))
        acceleration = (forward - backward) / dt
        after, before = np.concatenate([sigma_m[1:], none[:, :, 0]]), np.concatenate([none[:, :, 0], sigma_m[:-1]])
        one_sided = np.hypot(sigma_m, np.where(np.isnan(after), before, after)) / dt
        both = np.isfinite(after) & np.isfinite(before)
        sigma_v = np.where(both & np.isfinite(sigma_m), np.hypot(after, before) / (2 * dt), one_sided)
        velocity[np.isnan(sigma_m)] = np.nan
        sigma_a = np.sqrt(after**2 + 4 * sigma_m**2 + before**2) / dt**2
    return Kinematics(velocity_m_s=velocity, acceleration_m_s2=acceleration, sigma_velocity_m_s=sigma_v, sigma_acceleration_m_s2=sigma_a)


def smoothed(xyz_m: np.ndarray, sigma_m: np.ndarray, dt: float, frames: int) -> Kinematics:
    """Smoothed values over `frames` frames (odd, 5 at least), of trajectories that have a frame more than the cubic needs."""
    T, N = sigma_m.shape
    most = 2 * max(2, frames // 2) + 1
    half = most - 1
    window = np.arange(-half, half + 1)
    nearest = np.argsort(np.abs(window), kind="stable")
    values = np.pad(np.nan_to_num(xyz_m), ((half, half), (0, 0), (0, 0)))
    variance = np.pad(np.nan_to_num(sigma_m) ** 2, ((half, half), (0, 0)))
    seen = np.pad(np.isfinite(xyz_m[..., 0]), ((half, half), (0, 0)))
    basis = (window[:, None] * dt) ** np.arange(DEGREE + 1)  # (w, 4)
    result = Kinematics(
        velocity_m_s=np.full((T, N, 3), np.nan),
        acceleration_m_s2=np.full((T, N, 3), np.nan),
        sigma_velocity_m_s=np.full((T, N), np.nan),
        sigma_acceleration_m_s2=np.full((T, N), np.nan),
    )
    for t in range(T):
        there = _unbroken(seen[t : t + len(window)], half)
        there[nearest] &= np.cumsum(there[nearest], axis=0) <= most
        rows = np.flatnonzero(there.sum(axis=0) > DEGREE + 1)
        patterns, which = np.unique(there[:, rows], axis=1, return_inverse=True)
        for p, pattern in enumerate(patterns.T):  # few: whole windows, and the ends of trajectories
            n = rows[which.reshape(-1) == p]
            c = np.linalg.pinv(basis[pattern])  # (4, frames seen)
            X, s2 = values[t : t + len(window)][pattern][:, n], variance[t : t + len(window)][pattern][:, n]
            result.velocity_m_s[t, n] = np.tensordot(c[1], X, axes=1)
            result.acceleration_m_s2[t, n] = 2 * np.tensordot(c[2], X, axes=1)
            result.sigma_velocity_m_s[t, n] = np.sqrt(c[1] ** 2 @ s2)
            result.sigma_acceleration_m_s2[t, n] = 2 * np.sqrt(c[2] ** 2 @ s2)
    return result


def _unbroken(seen: np.ndarray, middle: int) -> np.ndarray:
    """Of windows (w, N), the frames that are seen without a gap from the middle one."""
    ahead = np.logical_and.accumulate(seen[middle:], axis=0)
    behind = np.logical_and.accumulate(seen[middle::-1], axis=0)[::-1]
    return np.concatenate([behind[:-1], ahead])
