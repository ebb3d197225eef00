"""A long recording needs no more memory than a short one: frames and clouds are read when they are needed, and none is kept."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

KB_PER_FRAME = 60.0  # 1 was measured, also beside other work; a kept cloud of this size has 150, a kept set of pictures 330


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
    row = memory.growth(("track",), [15, 75], pictures=4)[0]  # tracking measures first
    assert row["kb_per_frame"] < KB_PER_FRAME, row
