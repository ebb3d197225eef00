"""A view that is half a frame late, put to the moment of the others: pictures, clouds and tracks as good as those of a synchronous take."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.checking.timing import synchronised
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.images.retime import Recent, retimed
from tricap.core.run import pipeline, take_run
from tricap.core.surface.starts import measured_rows
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.synthetic.score import score_run
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take


def blob(x: float) -> np.ndarray:
    """A smooth texture that has moved by x pixels to the right and x / 2 down."""
    v, u = np.mgrid[0:80, 0:120].astype(float)
    waves = [20 * np.cos(0.5 * (u - x) * np.cos(a) + 0.5 * (v - x / 2) * np.sin(a) + 7 * a) for a in np.arange(6) * 0.55]
    return (128 + np.sum(waves, axis=0)).astype(np.float32)


@pytest.mark.parametrize("late", [0.5, -0.4, 0.2])
def test_pictures_go_back_along_the_motion(late: float) -> None:
    """A path x(t) = 3 t + 0.8 t²: the parabola is followed, and at the ends of a recording the straight line."""
    path = [3 * t + 0.8 * t * t for t in (-1 + late, late, 1 + late)]
    inner = np.s_[12:-12, 12:-12]
    before, here, after = (blob(x) for x in path)
    was = float(np.sqrt(np.mean((here - blob(0.0))[inner] ** 2)))
    assert np.sqrt(np.mean((retimed(here, before, after, late) - blob(0.0))[inner] ** 2)) < 0.08 * was
    assert np.sqrt(np.mean((retimed(here, None, after, late) - blob(0.0))[inner] ** 2)) < 0.4 * was
    assert np.array_equal(retimed(here, None, None, late), here) or np.abs(retimed(here, None, None, late) - here).max() < 0.01


def test_recent_pictures_are_not_decoded_again() -> None:
    class Counted:
        count, source, asked = 9, "x", 0

        def files(self) -> tuple[Path, ...]:
            return ()

        def read(self, index: int) -> np.ndarray:
            Counted.asked += 1
            return np.full((2, 2), float(index))

    recent = Recent(Counted())
    for t in range(1, 8):
        assert [recent.read(t + s)[0, 0] for s in (0, -1, 1)] == [t, t - 1, t + 1]
    assert Counted.asked == 9 and (recent.count, recent.source, recent.files()) == (9, "x", ())


@pytest.mark.slow
def test_a_view_late_by_frames_is_told_to_be_shifted_first(tmp_path: Path) -> None:
    make_arm_take(tmp_path / "take", ArmTakeSettings(width_px=320, frames=8, interlaced="none", late_frames=1.3))
    with pytest.raises(InputError, match=r"View R has a time offset of .1.[23]\d frames, too large to correct; add -1"):
        synchronised(open_take(read_take(tmp_path / "take")), Monitor())


@pytest.mark.slow
@pytest.mark.parametrize(("interlaced", "second"), [("odd", 0), ("even", 1)])
def test_each_field_is_put_to_its_moment_as_if_it_were_alone(tmp_path: Path, interlaced: str, second: int) -> None:
    """What a late view showed before and after is asked of the same lines of the images before and after."""
    make_arm_take(tmp_path / "take", ArmTakeSettings(width_px=192, frames=3, interlaced="both", late_frames=0.4))
    both = open_take(read_take(tmp_path / "take"))
    alone = open_take(replace(both.take, interlaced=interlaced, fps=25.0))
    late = (0.0, 0.0, 0.4)
    for image in range(3):
        rows = measured_rows(replace(both, delay_images=late), 2 * image + second)
        expected = measured_rows(replace(alone, delay_images=late), image)
        assert all(np.array_equal(a, b) for a, b in zip(rows, expected))
    assert not np.array_equal(rows[2], measured_rows(both, 4 + second)[2])


@pytest.mark.slow
def test_a_view_half_a_frame_late_costs_nothing_once_corrected(tmp_path: Path) -> None:
    """Measured at 480 px: clouds 0.15 mm synchronous, 0.95 mm half a frame late, 0.15 mm corrected; tracks 0.20, 1.10, 0.19 mm."""
    error = {}
    for name, late, correct in (("synchronous", 0.0, False), ("late", 0.5, False), ("corrected", 0.5, True)):
        take = tmp_path / f"take {late}"
        if not take.exists():
            make_arm_take(take, ArmTakeSettings(width_px=320, frames=9, interlaced="none", late_frames=late))
        settings = {"growing": {"spacing_px": 6}, "timing": {"correct": correct}}
        with take_run.open_run(take, tmp_path / name, settings, frames=(3, 6)) as run:
            pipeline.track(run, Monitor())
        score = score_run(take, tmp_path / name, Monitor())
        error[name] = score.clouds.median_mm
        assert ("offsets" in run.record) == correct
    assert abs(run.record["offsets"]["R"]["late_frames"] - 0.5) < 0.05
    assert error["corrected"] < 1.2 * error["synchronous"] and error["late"] > 2 * error["synchronous"], error
    footage, _ = synchronised(open_take(read_take(tmp_path / "take 0.5")), Monitor())
    sound = open_take(read_take(tmp_path / "take 0.0"))
    left = measured_rows(footage, 4)[2] - measured_rows(sound, 4)[2]
    assert np.sqrt(np.mean(left**2)) < 0.5 * np.sqrt(np.mean((footage.read(4)[2] - sound.read(4)[2]) ** 2))
