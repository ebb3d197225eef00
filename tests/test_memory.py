"""A long recording needs no more memory than a short one: frames and clouds are read when they are needed, and none is kept."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tricap.core.tracking import trajectories
from tricap.core.tracking.settings import TrackStatus
from tricap.core.tracking.tracked import TrackedFrame, born
from tricap.core.tracking.trajectories import assemble

KB_PER_FRAME = 60.0  # 8 were measured; a kept cloud of this size has 150, a kept set of pictures 330


@pytest.fixture(scope="module")
def memory() -> ModuleType:
    """The benchmark of memory."""
    spec = importlib.util.spec_from_file_location("bench_memory", Path(__file__).parent / "bench" / "memory.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_a_long_fit_keeps_next_to_nothing_of_a_frame(memory: ModuleType) -> None:
    """More than are adjusted at once. A frame that is kept has 2 MB, what is told of one 0.05 MB."""
    assert memory.fit_growth((24, 48), at_once=12) < 900


@pytest.mark.slow
def test_measuring_and_tracking_keep_no_frames(memory: ModuleType) -> None:
    (row,) = memory.growth(("track",), [15, 45], pictures=4)  # which measures first
    assert row["kb_per_frame"] < KB_PER_FRAME, row


def step(frame: int, identities: list[int], ended: list[int]) -> TrackedFrame:
    n = len(identities)
    tracked = born(frame, np.array(identities), np.zeros((n, 2, 2)), np.zeros((n, 2, 2, 2)), np.full((n, 3), float(frame)),
                   np.tile(np.eye(3), (n, 1, 1)))  # fmt: skip
    return TrackedFrame(**{f: getattr(tracked, f) for f in TrackedFrame.__dataclass_fields__} | dict(
        ended=np.array(ended, dtype=np.int64), reason=np.full(len(ended), TrackStatus.NOT_FOUND, dtype=np.int8)))  # fmt: skip


def test_a_long_recording_is_looked_through_on_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """One point lives throughout, and in each frame another is born that lives for three; the table has room for three."""
    steps = [step(t, [0, *(i for i in (t - 1, t, t + 1) if i > 0)], [t - 2] if t > 2 else []) for t in range(40)]
    whole = assemble(iter(steps), 25.0, most_cells=120)
    kept: list[int] = []
    monkeypatch.setattr(trajectories, "LOOKED_THROUGH_EVERY", 5)
    promising = trajectories._promising
    monkeypatch.setattr(trajectories, "_promising", lambda seen, most: kept.append(sum(len(s[1]) for s in found)) or found
                        if (found := promising(seen, most)) else found)
    again = assemble(iter(steps), 25.0, most_cells=120)
    assert whole.omitted == again.omitted == 38 and max(kept) <= 120 + 4 * 5
    for name in ("xyz_m", "sigma_m", "status"):
        assert np.array_equal(getattr(whole, name), getattr(again, name), equal_nan=True)


def test_a_table_that_would_be_too_large_takes_the_longest() -> None:
    """Points 0 and 2 live four frames, 1 two, 3 one; a table of 12 cells has room for three, in the order of their identities."""
    steps = [step(0, [0, 1, 2], []), step(1, [0, 1, 2], []), step(2, [0, 2, 3], [1]), step(3, [0, 2], [3])]
    every, some, few = (assemble(iter(steps), 25.0, most_cells=cells) for cells in (100, 12, 8))
    assert every.omitted == 0 and every.xyz_m.shape == (4, 4, 3)
    assert some.omitted == 1 and some.seen.sum(axis=0).tolist() == [4, 2, 4]
    assert few.omitted == 2 and few.seen.sum(axis=0).tolist() == [4, 4]
    for whole, part, columns in ((every, some, [0, 1, 2]), (every, few, [0, 2])):
        assert np.array_equal(whole.xyz_m[:, columns], part.xyz_m, equal_nan=True)
        assert np.array_equal(whole.status[:, columns], part.status)
    assert some.status[2, 1] == TrackStatus.NOT_FOUND
