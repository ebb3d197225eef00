"""Trajectories: position, velocity and acceleration of every tracked point, raw and smoothed, with sigmas, and why it ended.

    v_i = (X_{i+1} − X_{i−1}) / 2 dt ,   a_i = (X_{i+1} − 2 X_i + X_{i−1}) / dt²                            (1)
    σ_v = √(σ²_{i+1} + σ²_{i−1}) / 2 dt ,   σ_a = √(σ²_{i+1} + 4 σ²_i + σ²_{i−1}) / dt²                     (2)

Single differences are noisy: with σ = 1 mm at 25 frames/s, σ_a is 1.5 m/s². Smoothed values come from a cubic fitted by least squares to
the frames that are nearest in time (Savitzky & Golay 1964, doi:10.1021/ac60214a047), which lie on one side at the ends of a trajectory.
With the coefficients c of the estimate, σ² = Σ c_j² σ_j². Frames beyond a gap are not used, so gaps stay gaps.

Sigmas here are those of the whole vector (root of the summed variances), like `sigma_m`. Errors of different frames count as independent;
errors that they share (calibration, the point's place on the body) are constant and cancel.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation import store
from ..foundation.arrays import frozen
from ..foundation.progress import Monitor
from ..images.interlace import frame_time_s
from ..motion.formats.ply import write_tracked
from .filters import against_neighbours, against_voxels, cut, over_thresholds
from .settings import TrackingSettings, TrackStatus
from .tracked import TrackedFrame, rows_of

DEGREE = 3


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Kinematics:
    """Derivatives of N trajectories over T frames. NaN where there are too few frames."""

    velocity_m_s: np.ndarray  # (T, N, 3)
    acceleration_m_s2: np.ndarray  # (T, N, 3)
    sigma_velocity_m_s: np.ndarray  # (T, N)
    sigma_acceleration_m_s2: np.ndarray  # (T, N)


def differences(xyz_m: np.ndarray, sigma_m: np.ndarray, dt: float) -> Kinematics:
    """Raw derivatives of positions (T, N, 3), (1) and (2); at the ends of a trajectory v is the one-sided difference and a is NaN."""
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
    """Derivatives smoothed over `frames` frames (odd, at least 5), where a trajectory has one frame more than the cubic needs."""
    T, N = sigma_m.shape
    most = 2 * max(2, frames // 2) + 1
    half = most - 1
    window = np.arange(-half, half + 1)
    nearest = np.argsort(np.abs(window), kind="stable")
    values = np.pad(np.nan_to_num(xyz_m), ((half, half), (0, 0), (0, 0)))
    variance = np.pad(np.nan_to_num(sigma_m) ** 2, ((half, half), (0, 0)))
    visible = np.pad(np.isfinite(xyz_m[..., 0]), ((half, half), (0, 0)))
    basis = (window[:, None] * dt) ** np.arange(DEGREE + 1)  # (w, 4)
    result = Kinematics(
        velocity_m_s=np.full((T, N, 3), np.nan),
        acceleration_m_s2=np.full((T, N, 3), np.nan),
        sigma_velocity_m_s=np.full((T, N), np.nan),
        sigma_acceleration_m_s2=np.full((T, N), np.nan),
    )
    for t in range(T):
        there = _unbroken(visible[t : t + len(window)], half)
        there[nearest] &= np.cumsum(there[nearest], axis=0) <= most
        rows = np.flatnonzero(there.sum(axis=0) > DEGREE + 1)
        patterns, which = np.unique(there[:, rows], axis=1, return_inverse=True)
        for p, pattern in enumerate(patterns.T):  # few patterns: whole windows, and the ends of trajectories
            n = rows[which.reshape(-1) == p]
            c = np.linalg.pinv(basis[pattern])  # (4, frames)
            X, s2 = values[t : t + len(window)][pattern][:, n], variance[t : t + len(window)][pattern][:, n]
            result.velocity_m_s[t, n] = np.tensordot(c[1], X, axes=1)
            result.acceleration_m_s2[t, n] = 2 * np.tensordot(c[2], X, axes=1)
            result.sigma_velocity_m_s[t, n] = np.sqrt(c[1] ** 2 @ s2)
            result.sigma_acceleration_m_s2[t, n] = 2 * np.sqrt(c[2] ** 2 @ s2)
    return result


def _unbroken(visible: np.ndarray, middle: int) -> np.ndarray:
    """The frames of windows (w, N) that are visible without a gap from the middle one."""
    ahead = np.logical_and.accumulate(visible[middle:], axis=0)
    behind = np.logical_and.accumulate(visible[middle::-1], axis=0)[::-1]
    return np.concatenate([behind[:-1], ahead])


SMOOTH_FRAMES = 7  # the default of `tracking.smooth_frames`


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FramePositions:
    """The part of a tracked frame from which trajectories are assembled."""

    frame: int
    identity: np.ndarray  # (N,) ascending
    xyz_m: np.ndarray  # (N, 3)
    sigma_m: np.ndarray  # (N,)
    ended: np.ndarray  # (M,) identities of the points that were lost in this frame
    reason: np.ndarray  # (M,) TrackStatus


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Trajectories:
    """N points over T frames, world metres and seconds. NaN where a point is not visible; `status` (T, N) is a TrackStatus."""

    frames: np.ndarray  # (T,)
    time_s: np.ndarray  # (T,)
    xyz_m: np.ndarray  # (T, N, 3)
    velocity_m_s: np.ndarray  # (T, N, 3)
    acceleration_m_s2: np.ndarray  # (T, N, 3)
    sigma_m: np.ndarray  # (T, N)
    status: np.ndarray  # (T, N)
    raw: Kinematics | None = None  # the same velocities and accelerations with their sigmas
    smooth: Kinematics | None = None  # smoothed ones with theirs
    track: np.ndarray | None = None  # (T, N) number of the trajectory, −1 for none, where several share a column (long_tracks.py)
    omitted: int = 0  # trajectories that the table has no room for

    def __post_init__(self) -> None:
        t, n = self.sigma_m.shape
        object.__setattr__(self, "frames", frozen(self.frames, (t,), np.int32, "frames"))
        object.__setattr__(self, "status", frozen(self.status, (t, n), np.int8, "status"))
        for name, shape in dict(time_s=(t,), xyz_m=(t, n, 3), velocity_m_s=(t, n, 3), acceleration_m_s2=(t, n, 3), sigma_m=(t, n)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays by their names in trajectories.npz."""
        arrays = {n: getattr(self, n) for n in ("frames", "time_s", "xyz_m", "velocity_m_s", "acceleration_m_s2", "sigma_m", "status")}
        for prefix, kinematics in (("", self.raw), ("smooth_", self.smooth)):
            if kinematics is not None:
                arrays |= {f"{prefix}{f.name}": getattr(kinematics, f.name) for f in fields(Kinematics)}
        return arrays if self.track is None else arrays | {"track": self.track}

    @property
    def visible(self) -> np.ndarray:
        """(T, N) where a position was measured."""
        return np.isfinite(self.xyz_m[..., 0])


def assemble(steps: Iterable[TrackedFrame], fps: float, smooth_frames: int = SMOOTH_FRAMES) -> Trajectories:
    """The trajectories of consecutive tracked frames, by ascending identity; derivatives smoothed over `smooth_frames` (or 0)."""
    return assembled([positions_of(step) for step in steps], fps, smooth_frames)[0]


def positions_of(step: TrackedFrame) -> FramePositions:
    """The positions of a tracked frame."""
    sigma = np.sqrt(np.trace(step.covariance_m2, axis1=1, axis2=2))
    return FramePositions(frame=step.frame, identity=step.identity, xyz_m=step.xyz_m, sigma_m=sigma, ended=step.ended, reason=step.reason)


def assembled(positions: Sequence[FramePositions], fps: float, smooth_frames: int) -> tuple[Trajectories, np.ndarray]:
    """The trajectories of these frames, and their identities (N,) in ascending order."""
    identities = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(p.identity for p in positions)]))
    T, N = len(positions), len(identities)
    xyz, sigma = np.full((T, N, 3), np.nan), np.full((T, N), np.nan)
    status = np.zeros((T, N), dtype=np.int8)
    for t, p in enumerate(positions):
        here, gone = rows_of(identities, p.identity), rows_of(identities, p.ended)
        xyz[t, here], sigma[t, here], status[t, here] = p.xyz_m, p.sigma_m, TrackStatus.MEASURED
        status[t, gone[gone >= 0]] = p.reason[gone >= 0]
    frames = np.array([p.frame for p in positions], dtype=np.int32)
    return with_kinematics(frames, frame_time_s(frames, fps), xyz, sigma, status, smooth_frames), identities


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Filtered:
    """Trajectories after the filters, and all trajectories before them with the verdict on each frame."""

    kept: Trajectories  # pieces, M
    source: np.ndarray  # (M,) the column of `raw` to which a piece belongs; −1 where columns are shared
    raw: Trajectories  # N; status: MEASURED, or why the frame was removed, or why the trajectory ended there

    @property
    def reason(self) -> np.ndarray:
        """(N,) a TrackStatus for each raw trajectory: why it ended, or if it was removed, the most frequent reason.

        MEASURED: it lasts to the end of the recording. Of a column that several share, that of the last one.
        """
        status, visible = self.raw.status, self.raw.visible
        against = np.stack([(status == s).sum(axis=0) for s in TrackStatus])
        against[[TrackStatus.ABSENT, TrackStatus.MEASURED]] = 0
        last = np.where(status != TrackStatus.ABSENT, np.arange(len(status))[:, None], -1).max(axis=0, initial=-1)
        end = status[last, np.arange(status.shape[1])]
        kept = (visible & (status == TrackStatus.MEASURED)).any(axis=0)
        return np.where(kept, end, against.argmax(axis=0)).astype(np.int8)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of trajectories_raw.npz."""
        raw = self.raw
        arrays = {"frames": raw.frames, "xyz_m": raw.xyz_m, "status": raw.status, "reason": self.reason}
        return arrays if raw.track is None else arrays | {"track": raw.track}


def filter_trajectories(
    raw: Trajectories, settings: TrackingSettings, monitor: Monitor | None = None, left_out: np.ndarray | None = None
) -> Filtered:
    """The trajectories after the filters (filters.py), in pieces; every removed frame has the reason as its status.

    Positions that the user removed, `left_out` (T, N), become gaps before the filters.
    """
    monitor, unchanged = monitor or Monitor(), raw
    if left_out is not None and left_out.any():
        raw = _without(raw, left_out)
    dt = float(np.median(np.diff(raw.time_s))) if len(raw.time_s) > 1 else 1.0
    verdict = over_thresholds(raw.velocity_m_s, raw.acceleration_m_s2, raw.sigma_m, dt, settings)
    if settings.uniformity == "voxels":
        more = against_voxels(raw.xyz_m, raw.velocity_m_s, settings)
    elif settings.uniformity == "rigid":
        more = against_neighbours(raw.xyz_m, raw.sigma_m, settings, lambda done, total: monitor.step("filters", done, total))
    else:
        more = verdict
    verdict = np.where(verdict == TrackStatus.MEASURED, more, verdict)
    status = np.where(raw.visible, verdict, raw.status)
    pieces = cut(raw.visible, status, settings)
    xyz, sigma = raw.xyz_m[:, pieces.source].copy(), raw.sigma_m[:, pieces.source].copy()
    xyz[~pieces.kept], sigma[~pieces.kept] = np.nan, np.nan
    kept = with_kinematics(raw.frames, raw.time_s, xyz, sigma, pieces.status, settings.smooth_frames)
    return Filtered(kept=kept, source=pieces.source, raw=replace(unchanged, status=pieces.verdict))


def _without(raw: Trajectories, gone: np.ndarray) -> Trajectories:
    xyz, sigma = (np.where(gone if a.ndim == 2 else gone[..., None], np.nan, a) for a in (raw.xyz_m, raw.sigma_m))
    status = np.where(gone, TrackStatus.REMOVED_BY_USER, raw.status)
    return with_kinematics(raw.frames, raw.time_s, xyz, sigma, status, 0)


def picked(trajectories: Trajectories, columns: np.ndarray) -> Trajectories:
    """Only these trajectories (a mask or indices)."""
    names = ("xyz_m", "velocity_m_s", "acceleration_m_s2", "sigma_m", "status")
    values: dict[str, Any] = {n: getattr(trajectories, n)[:, columns] for n in names}
    for name, k in (("raw", trajectories.raw), ("smooth", trajectories.smooth)):
        values[name] = k and Kinematics(**{f.name: getattr(k, f.name)[:, columns] for f in fields(Kinematics)})
    return replace(trajectories, **values)


def with_kinematics(
    frames: np.ndarray, time_s: np.ndarray, xyz_m: np.ndarray, sigma_m: np.ndarray, status: np.ndarray, smooth_frames: int
) -> Trajectories:
    """Trajectories of these positions (T, N, 3), with their velocities and accelerations."""
    dt = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    raw = differences(xyz_m, sigma_m, dt)
    return Trajectories(
        frames=frames,
        time_s=time_s,
        xyz_m=xyz_m,
        velocity_m_s=raw.velocity_m_s,
        acceleration_m_s2=raw.acceleration_m_s2,
        sigma_m=sigma_m,
        status=status,
        raw=raw,
        smooth=smoothed(xyz_m, sigma_m, dt, smooth_frames) if smooth_frames else raw,
    )


def write_trajectories(out: Path, filtered: Filtered, fps: float) -> None:
    """Write OUT/trajectories.npz, and OUT/trajectories_raw.npz with those that the filters or the user removed."""
    kept = filtered.kept.arrays() | ({"source": filtered.source} if filtered.kept.track is None else {})
    for name, arrays in (("", kept), ("_raw", filtered.arrays())):
        single = {n: a.astype(np.float32) if a.dtype == np.float64 and n != "time_s" else a for n, a in arrays.items()}
        store.save(out / f"trajectories{name}.npz", single, {"format": f"tricap-trajectories{name}", "version": 1, "fps": fps})


def read_trajectories(out: Path) -> Trajectories | None:
    """The positions in OUT/trajectories.npz, with their velocities and accelerations; None without the file.

    Raises:
        InputError: the file is damaged.
    """
    path = out / "trajectories.npz"
    if not path.is_file():
        return None
    arrays, _ = store.load(path)
    vectors = ("xyz_m", "velocity_m_s", "acceleration_m_s2")
    layout = dict(
        frames=("iu", "T"), time_s=("f", "T"), sigma_m=("f", "TN"), status=("iu", "TN"), **{name: ("f", "TN3") for name in vectors}
    )
    store.check_layout(path, arrays, **layout)
    values: dict[str, Any] = {name: arrays[name] for name in layout}
    return Trajectories(**values, track=arrays.get("track"))


def write_tracked_clouds(out: Path, kept: Trajectories, monitor: Monitor) -> None:
    """Write OUT/tracked/NNNN.ply, the points of the kept trajectories in each frame: the surface, cleaned by tracking (D'Apuzzo et al.
    1999, §2.4.2)."""
    columns = np.broadcast_to(np.arange(kept.sigma_m.shape[1]), kept.sigma_m.shape) if kept.track is None else kept.track
    for t, frame in enumerate(kept.frames.tolist()):
        monitor.step("tracked clouds", t, len(kept.frames))
        seen = kept.visible[t]
        write_tracked(
            out / "tracked" / f"{frame:04d}.ply",
            xyz_m=kept.xyz_m[t, seen],
            sigma_m=kept.sigma_m[t, seen],
            velocity_m_s=kept.velocity_m_s[t, seen],
            track=columns[t, seen],
        )
