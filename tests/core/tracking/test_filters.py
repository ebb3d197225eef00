"""The filters of trajectories on bodies of known motion with planted false ones: precision, recall, and no true one lost on a fast limb."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.tracking.filters import against_neighbours, against_voxels, over_thresholds
from tricap.core.tracking.settings import TrackingSettings, TrackStatus
from tricap.core.tracking.trajectories import Trajectories, filter_trajectories, with_kinematics

FRAMES, DT, SIGMA_M = 30, 1 / 25, 5e-4
SETTINGS = TrackingSettings()


def limb(random: np.random.Generator, count: int, start: np.ndarray, axis: np.ndarray, rate: float, travel: np.ndarray) -> np.ndarray:
    """Points (T, count, 3) on the front of a cylinder of 45 mm by 300 mm that turns about its upper end and travels."""
    angle, along = random.uniform(-1.2, 1.2, count), random.uniform(0, 0.3, count)
    own = np.stack([0.045 * np.sin(angle), -0.045 * np.cos(angle), -along], axis=1)
    t = np.arange(FRAMES) * DT
    R = rotation_from_vector(axis * rate * t[:, None])
    return start + travel * t[:, None, None] + own @ R.transpose(0, 2, 1)


def recording(true: np.ndarray, random: np.random.Generator) -> Trajectories:
    noisy = true + random.standard_normal(true.shape) * SIGMA_M
    return with_kinematics(np.arange(FRAMES), np.arange(FRAMES) * DT, noisy, np.full(true.shape[:2], SIGMA_M * np.sqrt(3)),
                           np.ones(true.shape[:2], np.int8), 7)  # fmt: skip


def legs(random: np.random.Generator) -> np.ndarray:
    """Two legs that pass each other, 120 points each, at up to 5 rad/s."""
    x = np.array([1.0, 0.0, 0.0])
    a = limb(random, 120, np.array([-0.06, 0.0, 0.9]), x, 2.5, np.array([0, 0.8, 0]))
    b = limb(random, 120, np.array([0.06, 0.0, 0.9]), x, -2.5, np.array([0, 0.8, 0]))
    return np.concatenate([a, b], axis=1)


@pytest.mark.parametrize("rate", [0.0, 2.0, 5.0, 6.5])
def test_a_rotating_limb_loses_nothing(rate: float) -> None:
    """At 5 rad/s the velocity differs by 1.5 m/s along the limb: the rigid test keeps every trajectory whole."""
    random = np.random.default_rng(int(rate))
    true = limb(random, 150, np.array([0, 0, 1.4]), np.array([0.8, 0.6, 0.0]), rate, np.array([0.2, 0.1, 0.0]))
    kept = filter_trajectories(recording(true, random), SETTINGS).kept
    assert 150 <= kept.visible.shape[1] <= 153 and kept.visible.sum() > 0.998 * 150 * FRAMES


def planted(kind: str, true: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points with 24 false ones planted; which (N,), and in which frames (T, N) they are no longer where they began."""
    x, false = true.copy(), np.zeros(true.shape[:2], dtype=bool)
    which = random.choice(true.shape[1], 24, replace=False)
    for n in which:
        t = int(random.integers(6, FRAMES - 6))
        if kind == "slide":  # 2.5 mm a frame along an edge
            direction = random.standard_normal(3) * (1, 0.2, 1)
            x[t:, n] += np.arange(FRAMES - t)[:, None] * 2.5e-3 * direction / np.linalg.norm(direction)
        elif kind == "jump":
            direction = random.standard_normal(3)
            x[t:, n] += 0.02 * direction / np.linalg.norm(direction)
        else:  # to the nearest point of the other leg, with which it goes on
            others = np.arange(120, 240) if n < 120 else np.arange(120)
            x[t:, n] = true[t:, others[np.linalg.norm(true[t, others] - true[t, n], axis=1).argmin()]]
        false[t:, n] = np.linalg.norm(x[t:, n] - true[t:, n], axis=1) > 0.01
    return x, which, false


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["slide", "jump", "swap"])
def test_planted_false_trajectories_are_caught(kind: str) -> None:
    """Precision and recall of trajectories ≥ 0.95, over three sets of 24 false ones among 240."""
    caught = missed = wrong = 0
    for seed in range(3):
        random = np.random.default_rng(seed)
        true = legs(random)
        x, which, _ = planted(kind, true, random)
        raw = recording(x, random)
        verdict = against_neighbours(raw.xyz_m, raw.sigma_m, SETTINGS, lambda done, total: None) != TrackStatus.MEASURED
        flagged = set(np.flatnonzero(verdict.any(axis=0)))
        caught += len(flagged & set(which))
        missed += len(set(which) - flagged)
        wrong += len(flagged - set(which))
    precision, recall = caught / (caught + wrong), caught / (caught + missed)
    assert precision >= 0.95 and recall >= 0.95, (precision, recall)


def test_sigmas_that_do_not_show_in_motion_hide_nothing() -> None:
    """An error common to all frames enlarges a sigma but not the motion; the part that does is estimated from all points."""
    random = np.random.default_rng(3)
    x, which, _ = planted("slide", legs(random), random)
    raw = recording(x, random)
    large = replace(raw, sigma_m=8 * raw.sigma_m)
    verdict = against_neighbours(large.xyz_m, large.sigma_m, SETTINGS, lambda done, total: None) == TrackStatus.NOT_RIGID
    assert verdict.any(axis=0)[which].mean() >= 0.9
    assert np.delete(verdict.any(axis=0), which).mean() < 0.05


def test_the_published_voxels_keep_true_ones_and_miss_slow_ones() -> None:
    """Why voxels are not the default: on a rotating limb, velocities within a voxel differ by more than that of a sliding point."""
    random = np.random.default_rng(0)
    x, which, false = planted("slide", legs(random), random)
    raw = recording(x, random)
    by_voxels = (against_voxels(raw.xyz_m, raw.velocity_m_s, SETTINGS) == TrackStatus.NOT_UNIFORM).mean(axis=0) > 0.2
    by_neighbours = (against_neighbours(raw.xyz_m, raw.sigma_m, SETTINGS, lambda done, total: None) != TrackStatus.MEASURED).any(axis=0)
    assert np.delete(by_voxels, which).mean() < 0.02
    assert by_voxels[which].mean() < 0.5 < 0.95 <= by_neighbours[which].mean()
    places = np.random.default_rng(1).uniform(0, 0.09, (100, 3))
    still, _, _ = planted("jump", np.zeros((FRAMES, 100, 3)) + places, np.random.default_rng(2))
    raw = recording(still, random)
    assert (against_voxels(raw.xyz_m, raw.velocity_m_s, SETTINGS) == TrackStatus.NOT_UNIFORM).any(axis=0).sum() >= 23


def test_a_jump_leaves_two_pieces() -> None:
    random = np.random.default_rng(0)
    true = limb(random, 100, np.array([0, 0, 1.4]), np.array([1.0, 0, 0]), 0.0, np.array([0.5, 0.0, 0.2]))
    true[12:, 7] += (0.0, 0.03, 0.0)
    kept = filter_trajectories(recording(true, random), SETTINGS).kept
    assert kept.visible.shape[1] == 101
    pieces = np.flatnonzero(kept.visible.sum(axis=0) < FRAMES)
    assert len(pieces) == 2 and not kept.visible[:, pieces].all(axis=1).any()
    assert set(kept.status[12, pieces]) == {TrackStatus.NOT_RIGID}
    long_only = filter_trajectories(recording(true, random), replace(SETTINGS, min_length=15)).kept
    assert long_only.visible.shape[1] == 100


def test_few_points_are_not_compared_with_each_other() -> None:
    """Key points far apart have no neighbours: nothing is removed, whatever they do."""
    random = np.random.default_rng(0)
    t = np.arange(FRAMES)[:, None, None] * DT
    x = np.array([[[0, 0, 0]], [[1.0, 0, 0]], [[0, 1.0, 0]]]).transpose(1, 0, 2) + np.sin(3 * t) * random.standard_normal((1, 3, 3)) * 0.2
    assert filter_trajectories(recording(x, random), SETTINGS).kept.visible.all()


def test_the_noise_is_added_to_the_thresholds() -> None:
    """Still points whose noise alone exceeds the limit of acceleration stay; fast ones are removed."""
    random = np.random.default_rng(0)
    settings = replace(SETTINGS, max_acceleration=1.0, max_speed=0.5, uniformity="off")
    still = recording(np.zeros((FRAMES, 50, 3)), random)
    assert (np.linalg.norm(still.acceleration_m_s2[1:-1], axis=2) > 1.0).mean() > 0.05
    assert filter_trajectories(still, settings).kept.visible.mean() > 0.98
    fast = recording(np.arange(FRAMES)[:, None, None] * DT * np.ones((1, 5, 3)), random)
    assert filter_trajectories(fast, settings).kept.visible.shape[1] == 0


def test_each_threshold_removes_what_exceeds_it_and_nothing_else() -> None:
    """Points that move at 1 m/s, at 3 m/s, and one that is pushed by 30 m/s² for a moment, under limits between."""
    random, t = np.random.default_rng(0), np.arange(FRAMES) * DT
    pushed = np.cumsum(np.cumsum(np.where(np.arange(FRAMES) == 12, 30.0, 0.0))) * DT**2
    x = np.stack([1.0 * t, 3.0 * t, 0.5 * t + pushed], axis=1)[..., None] * np.array([1.0, 0.0, 0.0])
    raw = recording(x, random)
    settings = replace(SETTINGS, max_speed=2.5, max_acceleration=20.0)
    verdict = over_thresholds(raw.velocity_m_s, raw.acceleration_m_s2, np.zeros_like(raw.sigma_m), DT, settings)
    inner = np.abs(np.arange(FRAMES) - 12) > 2
    assert (verdict[:, 0] == TrackStatus.MEASURED).all() and (verdict[1:-1, 1] == TrackStatus.TOO_FAST).all()
    assert (verdict[~inner, 2] == TrackStatus.ACCELERATES).any() and (verdict[inner, 2] == TrackStatus.MEASURED).all()
    off = replace(SETTINGS, max_speed=20.0, max_acceleration=500.0)
    assert (over_thresholds(raw.velocity_m_s, raw.acceleration_m_s2, np.zeros_like(raw.sigma_m), DT, off) == TrackStatus.MEASURED).all()
