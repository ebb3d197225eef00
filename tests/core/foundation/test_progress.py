"""Progress: parts of a whole, and cancelling from another thread."""

import pytest

from tricap.core.foundation.progress import Cancelled, Monitor

from ...waiting import seconds_to_cancel


def test_steps_are_reported_and_parts_count_as_fractions() -> None:
    said: list[tuple[str, float, float]] = []
    monitor = Monitor(lambda *step: said.append(step))
    monitor.step("surface", 1, 4)
    part = monitor.part("surface", 2, 4)
    part.step("anything", 5, 10)
    part.part("inner", 1, 2).step("deep", 1, 2)
    part.step("another", 1, 10)  # its own steps may begin anew; what it reports does not go back
    part.step("anything", 30, 10)  # more than its total is still one part
    part.step("anything", 0, 0)
    assert [done for _, done, _ in said] == [1, 2.5, 2.75, 2.75, 3, 3]
    assert {(stage, total) for stage, _, total in said} == {("surface", 4)}


def test_cancelling_reaches_every_part_and_a_part_cancels_the_whole() -> None:
    for cancel_the_part in (False, True):
        monitor = Monitor()
        part = monitor.part("surface", 0, 3).part("seeds", 0, 2)
        assert not monitor.cancelled and not part.cancelled
        (part if cancel_the_part else monitor).cancel()
        assert monitor.cancelled and part.cancelled
        for m in (monitor, part):
            with pytest.raises(Cancelled, match="Stopped during surface, 1 of 3 done|Stopped during surface, 0.5 of 3 done"):
                m.step("surface", 1, 3 if m is monitor else 1)


def test_nothing_is_reported_after_the_cancel() -> None:
    said: list[str] = []
    monitor = Monitor(lambda stage, done, total: said.append(stage))
    monitor.cancel()
    with pytest.raises(Cancelled):
        monitor.step("surface", 0, 1)
    assert not said


def test_cancel_from_another_thread_is_seen_at_the_next_step() -> None:
    assert seconds_to_cancel(lambda monitor: monitor.step("loop", 0, 1)) < 1.0
