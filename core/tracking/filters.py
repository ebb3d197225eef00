"""Filters of trajectories by their speed and by their neighbours: false ones are cut or removed, each with a reason.

There are three filters, each a table (T, N) of statuses:

thresholds   |v| ≤ v_max + 3 σ_v ,  |a| ≤ a_max + 3 σ_a: the noise of a difference is added to the limits (D'Apuzzo et al. 2000, §3.3);
             and a sigma not much larger than the recording's median
voxels       as published: in each time step the velocity must agree with the median of the other trajectories in the same voxel,
             |v − v̄| ≤ max(3 · MAD / Φ⁻¹(3/4), 0.15 |v̄| + 60 mm/s)                                                              (1)
rigid        a rotating limb has no common velocity, so here the point must follow the rigid motion of its neighbours, over one step and
             over longer spans, in which a slow slide accumulates to a detectable deviation:
             |X_{i+s} − X̂_{i+s}| ≤ max(√s d, 3.5 c √(σ_i² + σ_{i+s}² + (1 + h) spread²)) ,  h: leverage of X̂         (2)
             X̂ is predicted by all neighbours, or by those whose distance to the point is constant (neighbours.py); the nearer one counts.
             Much of a sigma is common to a point's frames and its neighbours, and cancels in the difference: c is the part that remains,
             estimated from the median of all points over the same span.

             Neighbours that scatter by more than √s d have no common motion and confirm nothing. A trajectory with few confirmed steps is
             removed where others have more: such isolated points lie at outlines.

A trajectory is cut where it is false. Its other pieces become trajectories of their own unless they are short. One that is false in more
than half of its steps is removed entirely.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from ..geometry.robust import mad_sigma, masked_median
from .neighbours import common_motion, nearest_neighbours, same_distance
from .settings import TrackingSettings, TrackStatus

SPANS = ((1, 1), (4, 2), (10, 2))  # lengths of spans and intervals between their starts, both in frames
NOISE_SIGMAS = 3.0  # that the thresholds add to their limits
MAX_SIGMAS = 3.5  # of the summed variance of all three coordinates, scaled by c of (2)
MEDIAN_OF_CHI = 0.888  # of three coordinates, in units of the root of their summed variance
MIN_SCALE = 0.35  # of c in (2)
SCALE_POINTS = 20  # from which c is estimated; with fewer it is 1
MIN_MEMBERS = 5  # neighbours that must share a motion
MAX_SPREAD = 1.0  # in units of √s d: neighbours that scatter more have no common motion
NOT_TESTED = -1  # of a step without an Agreement
MIN_SUPPORT = 0.5  # part of a trajectory's tested steps that must be confirmed
VOXEL_MEMBERS = 4  # of (1): other velocities in the voxel
VOXEL_TOLERANCE_M_S = 0.06  # of (1)
VOXEL_TOLERANCE = 0.15  # of (1): part of the median speed
MOSTLY_FALSE = 0.5  # part of a trajectory's frames
MIN_LENGTH_AT_END = 3  # frames of a trajectory that only the recording's end cuts off

Progress = Callable[[float, float], None]


def over_thresholds(
    velocity_m_s: np.ndarray, acceleration_m_s2: np.ndarray, sigma_m: np.ndarray, dt: float, settings: TrackingSettings
) -> np.ndarray:
    """TOO_FAST or ACCELERATES (T, N) where a trajectory exceeds the limits and its noise, UNCERTAIN by its sigma, else MEASURED."""
    verdict = np.full(sigma_m.shape, TrackStatus.MEASURED, dtype=np.int8)
    noise = np.nan_to_num(sigma_m)
    if noise.any():
        verdict[noise > settings.max_sigma_ratio * np.median(noise[noise > 0])] = TrackStatus.UNCERTAIN
    with np.errstate(invalid="ignore"):
        jerky = np.linalg.norm(acceleration_m_s2, axis=2) > settings.max_acceleration + NOISE_SIGMAS * np.sqrt(6) * noise / dt**2
        fast = np.linalg.norm(velocity_m_s, axis=2) > settings.max_speed + NOISE_SIGMAS * noise / (np.sqrt(2) * dt)
    verdict[jerky], verdict[fast] = TrackStatus.ACCELERATES, TrackStatus.TOO_FAST
    return verdict


def against_voxels(xyz_m: np.ndarray, velocity_m_s: np.ndarray, settings: TrackingSettings) -> np.ndarray:
    """NOT_UNIFORM (T, N) where a velocity differs from that of the others in its voxel in the same and the neighbouring steps.  (1)"""
    verdict = np.full(xyz_m.shape[:2], TrackStatus.MEASURED, dtype=np.int8)
    known = np.isfinite(velocity_m_s).all(axis=2) & np.isfinite(xyz_m).all(axis=2)
    cell = np.floor(np.nan_to_num(xyz_m) / settings.neighbourhood_m).astype(np.int64)
    for t in range(len(xyz_m)):
        rows = np.flatnonzero(known[t])
        near = [(u, j) for u in (t - 1, t, t + 1) if 0 <= u < len(xyz_m) for j in np.flatnonzero(known[u])]
        if not len(rows) or not near:
            continue
        u, j = np.array(near).T
        v, owner = velocity_m_s[u, j], j
        _, place = np.unique(np.concatenate([cell[t, rows], cell[u, j]]), axis=0, return_inverse=True)
        place = place.reshape(-1)
        for voxel in np.unique(place[: len(rows)]):
            inside, others = rows[place[: len(rows)] == voxel], place[len(rows) :] == voxel
            verdict[t, inside[_differs(inside, velocity_m_s[t, inside], owner[others], v[others])]] = TrackStatus.NOT_UNIFORM
    return verdict


def _differs(inside: np.ndarray, velocity: np.ndarray, owner: np.ndarray, all_velocities: np.ndarray) -> np.ndarray:
    """Which of the trajectories in a voxel violate (1), each against the others (leave one out)."""
    other = inside[:, None] != owner
    enough = other.sum(axis=1) >= VOXEL_MEMBERS
    bad = np.zeros(len(inside), dtype=bool)
    if enough.any():
        mean = masked_median(np.broadcast_to(all_velocities, (*other[enough].shape, 3)), other[enough][..., None], axis=1)
        sigma = mad_sigma(np.linalg.norm(all_velocities - mean[:, None], axis=2), 1, other[enough])
        limit = np.maximum(3 * sigma, VOXEL_TOLERANCE * np.linalg.norm(mean, axis=1) + VOXEL_TOLERANCE_M_S)
        bad[enough] = np.linalg.norm(velocity[enough] - mean, axis=1) > limit
    return bad


def against_neighbours(xyz_m: np.ndarray, sigma_m: np.ndarray, settings: TrackingSettings, progress: Progress) -> np.ndarray:
    """NOT_RIGID (T, N) where a trajectory deviates from the rigid motion of its neighbours (2), UNSUPPORTED where they do not confirm it.

    Unsupported are whole trajectories of which few steps were confirmed, and the ends of others before the first and after the last
    confirmed step. Where half of all trajectories lack support, none is marked for it.
    """
    verdict = np.full(sigma_m.shape, TrackStatus.MEASURED, dtype=np.int8)
    T, N = sigma_m.shape
    answers = np.full((len(SPANS), T, N), NOT_TESTED, dtype=np.int8)
    for done, (span, every) in enumerate(SPANS):
        fresh: list[tuple[slice, np.ndarray]] = []
        for t in range(0, T - span, every):
            progress(done + t / T, len(SPANS))
            rows = np.flatnonzero(np.isfinite(xyz_m[[t, t + span], :, 0]).all(axis=0))
            sigma = np.hypot(sigma_m[t, rows], sigma_m[t + span, rows])
            answers[done, t, rows] = answer = compare_with_neighbours(xyz_m[t, rows], xyz_m[t + span, rows], sigma, span, settings)
            false = rows[answer == Agreement.DEVIATES]
            false = false[(verdict[t + 1 : t + span + 1, false] == TrackStatus.MEASURED).all(axis=0)]  # not yet false
            fresh.append((slice(t + 1, t + span + 1), false))
        for frames, false in fresh:
            verdict[frames, false] = TrackStatus.NOT_RIGID
    tested = (answers != NOT_TESTED).sum(axis=(0, 1))
    support = (answers == Agreement.CONFIRMED).sum(axis=(0, 1)) / np.maximum(tested, 1)
    if tested.any() and np.median(support[tested > 0]) >= MIN_SUPPORT:
        alone = ~_between_confirmed(answers[0] == Agreement.CONFIRMED) | (support < MIN_SUPPORT)
        verdict[(verdict == TrackStatus.MEASURED) & alone & (tested > 0)] = TrackStatus.UNSUPPORTED
    return verdict


def _between_confirmed(confirmed: np.ndarray) -> np.ndarray:
    """Frames (T, N) from the first to the last of the steps t → t + 1 that are confirmed (T, N)."""
    ends = confirmed | np.concatenate([np.zeros_like(confirmed[:1]), confirmed[:-1]])
    return np.logical_or.accumulate(ends, axis=0) & np.logical_or.accumulate(ends[::-1], axis=0)[::-1]


class Agreement(IntEnum):
    """How a point's motion compares with that of its neighbours."""

    UNKNOWN = 0  # too few neighbours, or they have no common motion
    CONFIRMED = 1
    DEVIATES = 2


def compare_with_neighbours(
    before_m: np.ndarray, after_m: np.ndarray, sigma_m: np.ndarray, span: int, settings: TrackingSettings
) -> np.ndarray:
    """An Agreement for each of N points that moved in `span` frames with the rigid motion of its neighbours.  (2)"""
    rows, there = nearest_neighbours(before_m, before_m, settings.neighbourhood_m, same=True)
    tolerance = np.sqrt(span) * 1e-3 * settings.max_deviation_mm
    sigma = np.nan_to_num(sigma_m)
    scale: float | None = None

    def compare(i: np.ndarray, weight: np.ndarray) -> np.ndarray:
        nonlocal scale
        goal = common_motion(before_m[i], before_m[rows[i]], after_m[rows[i]], weight, tolerance / 2)
        common = (goal.members >= MIN_MEMBERS) & (goal.spread_m <= MAX_SPREAD * tolerance)
        away = np.linalg.norm(after_m[i] - goal.xyz_m, axis=1)
        expected = np.sqrt(sigma[i] ** 2 + (1 + goal.leverage) * goal.spread_m**2)
        scale = scale or _scale(away[common], expected[common])
        with np.errstate(invalid="ignore"):
            near = away <= np.maximum(tolerance, MAX_SIGMAS * scale * expected)
        return np.where(common, np.where(near, Agreement.CONFIRMED, Agreement.DEVIATES), Agreement.UNKNOWN)

    answer = np.full(len(before_m), Agreement.UNKNOWN)
    rest = np.flatnonzero(there.sum(axis=1) >= MIN_MEMBERS)
    if len(rest):
        answer[rest] = compare(rest, there[rest].astype(np.float64))
    rest = rest[answer[rest] != Agreement.CONFIRMED]
    if len(rest):
        weight = there[rest] * same_distance(before_m[rest], after_m[rest], before_m[rows[rest]], after_m[rows[rest]], tolerance / 2)
        again = compare(rest, weight)
        answer[rest] = np.where(again == Agreement.UNKNOWN, answer[rest], again)
    return answer


def _scale(away_m: np.ndarray, expected_m: np.ndarray) -> float:
    """c of (2): the ratio between observed and expected deviations (n,)."""
    if len(away_m) < SCALE_POINTS:
        return 1.0
    return float(np.clip(np.median(away_m / np.maximum(expected_m, 1e-9)) / MEDIAN_OF_CHI, MIN_SCALE, 1.0))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Pieces:
    """M pieces of N trajectories over T frames."""

    source: np.ndarray  # (M,) number of the trajectory
    kept: np.ndarray  # (T, M) which frames belong to the piece
    status: np.ndarray  # (T, M) TrackStatus
    verdict: np.ndarray  # (T, N) on the frames of the trajectories: MEASURED where they belong to a piece


def cut(visible: np.ndarray, status: np.ndarray, settings: TrackingSettings) -> Pieces:
    """Cut trajectories where they are false.

    `visible` (T, N): frames with a position; `status` (T, N): MEASURED, or why the frame is false. A gap does not cut a trajectory.
    """
    T = len(visible)
    shortest = max(2, min(settings.min_length, T))
    good = visible & (status == TrackStatus.MEASURED)
    false = visible & ~good
    mostly = false.sum(axis=0) > MOSTLY_FALSE * np.maximum(visible.sum(axis=0), 1)
    piece = np.cumsum(false, axis=0)
    columns, kept, statuses = [], [], []
    verdict = np.where(good, TrackStatus.TOO_SHORT, status).astype(np.int8)
    for n in np.flatnonzero(visible.any(axis=0)):
        for number in np.unique(piece[good[:, n], n]) if not mostly[n] else ():
            frames = good[:, n] & (piece[:, n] == number)
            if frames.sum() >= (shortest if not frames[-1] else min(shortest, MIN_LENGTH_AT_END)):
                columns.append(n)
                kept.append(frames)
                statuses.append(np.where(visible[:, n] & ~frames & good[:, n], TrackStatus.OTHER_PIECE, status[:, n]))
                verdict[frames, n] = TrackStatus.MEASURED
    stack = [np.array(a, dtype=d).reshape(-1, T).T for a, d in ((kept, bool), (statuses, np.int8))]
    return Pieces(source=np.array(columns, dtype=np.int64), kept=stack[0], status=stack[1], verdict=verdict)
