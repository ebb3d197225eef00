"""The beginning of views by the motion that they show: energies of known starts, and takes without sound."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.images.interlace import RowGrid
from tricap.core.images.sequence import open_sequence
from tricap.core.synchronising.motion import APART_S, GRID_S, energy_of, offsets_by_motion
from tricap.core.synchronising.synchronise import synchronise
from tricap.core.take.take import read_take


def energy(t: np.ndarray, seed: int = 0) -> np.ndarray:
    """Of a person who moves now and then, differently for each seed, from second 20 to 60; else 0."""
    rng = np.random.default_rng(seed)
    moved = sum(np.exp(-0.5 * ((t - at) / 0.3) ** 2) for at in rng.uniform(20.0, 60.0, 60))
    return np.asarray(moved * ((t > 20) & (t < 60)))


def test_the_start_is_among_the_candidates() -> None:
    """At other rates, with other noise, minutes apart, and for a recording that begins and ends while somebody moves."""
    for first_s, start_s, last_s in ((0.0, -300.0, 80.0), (0.0, 5.0, 90.0), (25.0, 31.3, 52.0)):
        a_s, b_s = np.arange(first_s, 70.0, 1 / 30), np.arange(0.0, last_s - start_s, 1 / 24)
        rng = np.random.default_rng(3)
        a = energy(a_s) + 0.1 * np.abs(rng.standard_normal(len(a_s)))
        b = 2.0 * energy(b_s + start_s) ** 1.3 + 0.1 * np.abs(rng.standard_normal(len(b_s)))
        found = offsets_by_motion(a, b, a_s, b_s)
        assert abs(found[0] - start_s) < 3 * GRID_S and all(abs(u - v) > APART_S for u in found for v in found if u != v)


@pytest.mark.parametrize("still", [np.zeros(100), np.zeros(1), np.zeros(0)])
def test_where_nobody_moves_there_is_no_candidate(still: np.ndarray) -> None:
    t = np.arange(300) / 30
    assert offsets_by_motion(energy(t + 20), still, t, np.arange(len(still)) / 30) == []


def test_the_energy_is_that_between_images(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    ground = rng.uniform(60, 200, (48, 64)).astype(np.float32)
    for n in range(30):
        picture = ground + rng.standard_normal(ground.shape)
        picture[10:30, 10 + 2 * max(0, min(n - 12, 8)) :][:, :20] = 250
        cv2.imwrite(str(tmp_path / f"{n:04d}.png"), picture.astype(np.uint8))
    sequence = open_sequence(tmp_path, images="*.png", movie=None, view="C")
    found = energy_of(sequence, RowGrid(1, 0), Monitor())
    assert len(found) == 29 and found[12:20].min() > 5 * np.delete(found, np.arange(12, 20)).max()
    stopped = Monitor()
    stopped.cancel()
    with pytest.raises(Cancelled):
        energy_of(sequence, RowGrid(1, 0), stopped)


@pytest.fixture
def early(at_thirty: Callable[[Mapping[str, Sequence[int]]], Path]) -> Path:
    """Three views at 30 images per second; R began 138 still images before the others, too early for the rays alone."""
    moving = [*range(0, 18, 2), *([16] * 12)]
    return at_thirty({"L": [0] * 12 + moving, "C": [0] * 12 + moving, "R": [0] * 150 + moving})


@pytest.mark.slow
def test_a_view_that_began_much_earlier_is_found_without_sound(early: Path) -> None:
    timings = synchronise(read_take(early), Monitor())
    assert timings[2].method == "motion and rays" and all(t.found for t in timings) and abs(timings[0].start_s) < 3e-3
    assert abs(timings[2].start_s + 138 / 30) < 3e-3 and timings[2].sigma_s < 3e-3


@pytest.mark.slow
def test_another_motion_is_not_taken_for_the_same(early: Path) -> None:
    for path in sorted((early / "R").iterdir()):  # its images are turned about: no point of it is where the rays meet
        picture = cv2.imread(str(path))[::-1, ::-1]
        path.unlink()
        cv2.imwrite(str(path), picture)
    timings = synchronise(read_take(early), Monitor())
    assert not timings[2].found and "too few moving points" in timings[2].problem
