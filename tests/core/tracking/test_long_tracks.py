"""Long recordings: filtering in stretches gives the same result as in one table; columns are shared where the table is too small."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.tracking.corrections import without
from tricap.core.tracking.long_tracks import MARGIN_FRAMES, in_columns, in_stretches, trajectories_of
from tricap.core.tracking.settings import TrackingSettings, TrackStatus
from tricap.core.tracking.tracked import TrackedFrame, born
from tricap.core.tracking.trajectories import Filtered, Trajectories, filter_trajectories

FPS, FRAMES, NEW = 25.0, 160, 2  # points that are born in each frame
SETTINGS = TrackingSettings(uniformity="off", max_sigma_ratio=1000.0)
DAMAGED = 40  # the only point that jumps, in its twentieth frame
FIELDS = ("xyz_m", "sigma_m", "velocity_m_s", "acceleration_m_s2")


def life(identity: int) -> range:
    """The frames in which a point is visible: most are short."""
    first = identity // NEW
    return range(first, min(FRAMES, first + (90 if identity % 20 == 0 else 2 + identity % 11)))


@pytest.fixture(scope="module")
def steps() -> list[TrackedFrame]:
    random, made = np.random.default_rng(0), []
    for frame in range(FRAMES):
        here = [i for i in range(NEW * FRAMES) if frame in life(i)]
        gone = np.array([i for i in range(NEW * FRAMES) if life(i).stop == frame], dtype=np.int64)
        n = len(here)
        xyz = np.stack([np.array(here) * 0.01, np.full(n, 0.004 * frame), np.zeros(n)], axis=1) + 1e-4 * random.standard_normal((n, 3))
        xyz[[i == DAMAGED and frame - life(i).start == 20 for i in here]] += 3.0
        K = np.tile(np.eye(3), (n, 1, 1)) * random.uniform(1e-8, 4e-8, (n, 1, 1))
        step = born(frame, np.array(here, dtype=np.int64), np.zeros((n, 2, 2)), np.zeros((n, 2, 2, 2)), xyz, K)
        made.append(replace(step, ended=gone, reason=np.full(len(gone), TrackStatus.NOT_FOUND, dtype=np.int8)))
    return made


def decide(raw: Trajectories, rows: range) -> tuple[Filtered, np.ndarray]:
    return filter_trajectories(raw, SETTINGS), np.zeros(0, dtype=np.int64)


def test_stretches_overlap_and_own_each_frame_once(steps: list[TrackedFrame]) -> None:
    stretches = list(in_stretches(iter(steps), MARGIN_FRAMES, 1500))
    own = [stretch.frames[t].frame for stretch in stretches for t in stretch.own]
    assert own == list(range(FRAMES)) and len(stretches) > 2 and not any(s.whole for s in stretches)
    assert all(s.own.start == MARGIN_FRAMES for s in stretches[1:])
    assert all(s.own.stop == len(s.frames) - MARGIN_FRAMES for s in stretches[:-1])
    assert [s.whole for s in in_stretches(iter(steps), MARGIN_FRAMES, 10**6)] == [True]


def test_a_recording_in_stretches_has_the_same_trajectories(steps: list[TrackedFrame]) -> None:
    whole, reasons = trajectories_of(iter(steps), FPS, SETTINGS, decide)
    parts, again = trajectories_of(iter(steps), FPS, SETTINGS, decide, stretch_cells=1500)
    assert reasons == again and whole.kept.track is None and parts.kept.track is None and not parts.kept.omitted
    assert np.array_equal(whole.raw.status, parts.raw.status) and np.array_equal(whole.source, parts.source)
    assert (whole.source == DAMAGED).sum() == 2  # pieces before and after the jump
    for name in FIELDS:
        assert np.allclose(getattr(whole.kept, name), getattr(parts.kept, name), rtol=1e-5, atol=1e-3, equal_nan=True), name
        if name in ("xyz_m", "sigma_m"):
            assert np.allclose(getattr(whole.raw, name), getattr(parts.raw, name), atol=1e-6, equal_nan=True)
    assert whole.kept.smooth is not None and parts.kept.smooth is not None
    assert np.allclose(whole.kept.smooth.velocity_m_s, parts.kept.smooth.velocity_m_s, atol=1e-4, equal_nan=True)
    measured = whole.kept.status == TrackStatus.MEASURED
    assert np.array_equal(measured, parts.kept.status == TrackStatus.MEASURED)
    ends = [(t.kept.status == TrackStatus.NOT_FOUND).sum(axis=0) for t in (whole, parts)]
    assert (ends[0] == ends[1]).mean() > 0.99


def test_columns_are_shared_where_the_table_has_no_room(steps: list[TrackedFrame]) -> None:
    whole = trajectories_of(iter(steps), FPS, SETTINGS, decide)[0]
    parts = trajectories_of(iter(steps), FPS, SETTINGS, decide, stretch_cells=1500, table_cells=12 * FRAMES)[0]
    kept, raw = parts.kept, parts.raw
    assert kept.track is not None and raw.track is not None and kept.xyz_m.shape == (FRAMES, 12, 3) and kept.omitted > 0
    assert np.array_equal(kept.track[kept.visible] >= 0, np.ones(kept.visible.sum(), dtype=bool))
    t, n = np.nonzero(kept.visible)
    assert np.allclose(kept.xyz_m[t, n], whole.raw.xyz_m[t, kept.track[t, n]], atol=1e-6)
    both = kept.visible[:-1] & kept.visible[1:]
    assert np.array_equal(kept.track[:-1][both], kept.track[1:][both])  # a frame lies between two in a column
    longest = {i for i in range(NEW * FRAMES) if len(life(i)) == 90}
    assert longest <= set(kept.track[kept.visible].tolist())
    assert kept.visible.sum() > 2 * sum(len(life(i)) for i in longest)  # which alone would not fill twelve columns of their own


def test_what_the_user_removes_is_removed_from_all_stretches(steps: list[TrackedFrame]) -> None:
    def without_one(raw: Trajectories, rows: range) -> tuple[Filtered, np.ndarray]:
        filtered = filter_trajectories(raw, SETTINGS)
        at = np.flatnonzero(np.abs(np.nanmedian(raw.xyz_m[..., 0], axis=0) - 0.4) < 1e-3)
        hit = at[: 1 if 60 in raw.frames[rows.start : rows.stop] else 0]
        return (without(filtered, int(hit[0])) if len(hit) else filtered), hit

    parts = trajectories_of(iter(steps), FPS, SETTINGS, without_one, stretch_cells=1500)[0]
    assert DAMAGED not in parts.source and len(set(parts.source)) > 10
    seen = parts.raw.visible[:, DAMAGED]
    assert seen.sum() == 90 and (parts.raw.status[seen, DAMAGED] == TrackStatus.REMOVED_BY_USER).all()


def test_the_longest_get_columns_first() -> None:
    extent = np.array([[7, 0, 9, 10], [8, 0, 3, 4], [9, 5, 9, 5], [10, 4, 9, 6], [11, 0, 9, 3]])  # number, first, last, length
    assert in_columns(extent, 10, 20).tolist() == [0, -1, -1, 1, -1]  # one row lies between 8 and 9, none between 8 and 10
    assert in_columns(extent[[0, 1, 2, 4]], 10, 20).tolist() == [0, 1, 1, -1]
