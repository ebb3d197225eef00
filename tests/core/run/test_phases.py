"""One progress bar over all stages: it never goes back, and the time left can be believed."""

import re
from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.progress import Course, Monitor
from tricap.core.run.phases import COST, course_of

ROOT = Path(__file__).parents[3]
STAGES = ("measure", "track", "fit", "report")
FRAMES = 100


def simulated(slower: dict[str, float], skipped: tuple[str, ...] = ()) -> list[tuple[float, float, float | None]]:
    """A run whose phases take so many times what the table says, 0.01 of it where they are skipped: at every step the part of the time
    that is over, the bar, and the time left over the true one."""
    now = [50.0]
    course = Course([(n, once + FRAMES * each) for s in STAGES for n, (once, each) in COST[s].items()], clock=lambda: now[0])
    seen = []
    for stage in STAGES:
        for name, (once, each) in COST[stage].items():
            for i in range(FRAMES):
                now[0] += (once + FRAMES * each) / FRAMES * (0.05 if name in skipped else slower.get(name, 1.0))
                course.step(name, i + 1, FRAMES)
                seen.append((now[0], course.fraction, course.seconds_left))
    end = now[0]
    return [((t - 50.0) / (end - 50.0), bar, None if left is None or end - t < 1 else left / (end - t)) for t, bar, left in seen]


@pytest.mark.parametrize("machine", [0.3, 1.0, 8.0])
def test_the_time_left_is_right_within_a_third_after_the_first_tenth(machine: float) -> None:
    """On machines of any speed, where each phase is up to an eighth cheaper or more expensive than in the table."""
    random = np.random.default_rng(5)
    for _ in range(5):
        slower = {name: machine * random.uniform(0.87, 1.13) for costs in COST.values() for name in costs}
        seen = simulated(slower)
        assert all(left is not None and 2 / 3 < left < 4 / 3 for part, _, left in seen if 0.12 < part < 0.9)


def test_the_bar_never_goes_back_and_ends_at_one() -> None:
    bars = [bar for _, bar, _ in simulated({"surface": 3.0})]
    assert bars == sorted(bars) and bars[-1] == pytest.approx(1.0)


def test_what_was_read_from_checkpoints_says_nothing_of_the_pace() -> None:
    seen = simulated({}, skipped=("seeds", "surface", "tracks"))
    assert all(left is None or 2 / 3 < left < 4 / 3 for _, _, left in seen)
    assert any(left is not None for _, _, left in seen)


def test_a_run_of_checkpoints_alone_has_no_pace() -> None:
    course = Course([("surface", 10.0)], clock=lambda: 0.0)
    course.step("surface", 1, 1)
    assert course.fraction == 1.0 and course.seconds_left is None


def test_unknown_and_earlier_phases_change_nothing() -> None:
    course = course_of(STAGES, FRAMES)
    course.step("tracks", 1, 2)
    before = course.fraction
    course.step("surface", 1, 1)
    course.step("look for a limb", 1, 1)
    course.step("tracks", 1, 4)
    assert course.fraction == before > 0


def test_without_a_surface_the_points_of_single_views_move_the_bar() -> None:
    course = course_of(STAGES, FRAMES, surface=False)
    course.step("background", 1, 1)
    before = course.fraction
    course.step("follow points", 1, 2)
    assert 0 < before < 0.1 and course.fraction > before + 0.1


def test_a_part_of_a_task_moves_the_bar() -> None:
    monitor = Monitor()
    monitor.course = course_of(STAGES, FRAMES)
    monitor.part("surface", 50, 100).step("anything", 0, 1)
    assert 0.1 < monitor.course.fraction < 0.4


def test_every_phase_of_the_table_is_reported_by_the_code() -> None:
    """A renamed phase would stand still."""
    code = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "core").rglob("*.py") if path.name != "phases.py")
    for name in (name for costs in COST.values() for name in costs):
        assert re.search(rf'"{name}"', code), name
