"""Views with their own images per second, start, drift and time stamps: which image shows a frame, and the rest that is interpolated."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.checking.timing import estimate_offsets
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.run.stages import stage_keys
from tricap.core.run.take_run import settings_of
from tricap.core.surface.starts import image_digests, measured_rows
from tricap.core.take.clock import Clock, read_timestamps
from tricap.core.take.footage import Footage, open_take
from tricap.core.take.take import FrameClicks, Take, View, read_take

AtThirty = Callable[[Mapping[str, Sequence[int]]], Path]
HEAD = 'format = "tricap-take"\nversion = 1\nfps = 30.0\n'


def test_a_clock_gives_the_nearest_image_and_its_delay() -> None:
    even = Clock(start_s=0.5, period_s=1 / 24 * (1 + 50e-6))
    t = even.time_s(24_000)
    assert abs(t - (0.5 + 1000.05)) < 1e-9 and even.nearest(t + 0.4 / 24) == 24_000 and even.nearest(0.4) == -2
    assert even.delay_images(24_000, t + 0.4 / 24) == pytest.approx(-0.4, abs=1e-3) and even.delay_images(3, even.time_s(3) + 1e-5) == 0
    stamped = Clock(start_s=1.0, period_s=0.1, times_s=np.array([1.0, 1.1, 1.3, 1.4]))  # an image was lost
    assert [stamped.nearest(s) for s in (0.79, 1.0, 1.18, 1.22, 1.41, 1.62)] == [-2, 0, 1, 2, 3, 5]
    assert stamped.delay_images(2, 1.22) == pytest.approx(0.4) and stamped.delay_images(1, 1.18) == pytest.approx(-0.4)
    assert stamped.time_s(2.5) == pytest.approx(1.35) and stamped.time_s(-1) == pytest.approx(0.9)


def test_time_stamps_of_one_or_several_views_are_read_in_the_order_of_the_images(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("sync_index,cam_id,frame_index,frame_time\n3,1,1,20.5\n3,0,0,20.0\n4,0,1,20.1\n5,1,0,20.2\n")
    assert read_timestamps(path, "cam_1").tolist() == [20.2, 20.5] and read_timestamps(path, "0").tolist() == [20.0, 20.1]
    path.write_text("time_s\n1\n2.5\n")
    assert read_timestamps(path, "L").tolist() == [1.0, 2.5]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no time stamps"),
        ("a,b\n1,2\n", "has no time stamps"),
        ("view,time_s\nR,1\nR,2\n", "no usable time stamps of view L"),
        ("time_s\n1\nnan\n", "no usable time stamps"),
        ("time_s\n1\n1e300\n", "no usable time stamps"),
        ("time_s\n1\nhello\n", "not a number"),
        ("view,time_s\nL,1\nL\n", "not a number"),
        ("time_s\n1\n2\n2\n", "do not increase after image 1"),
        ("frame_index,time_s\n0,0\n0,0.04\n2,0.08\n", "two time stamps of one image of view"),
        ("time_s\n1\n2\n", "has 2 time stamps of view L, which has 3 images"),
        ("time_s,\0x\n\0", "Cannot read|no time stamps|not a number"),
    ],
)
def test_time_stamps_that_cannot_be_used_are_refused_in_one_sentence(at_thirty: AtThirty, text: str, said: str) -> None:
    take = loose(at_thirty, {"L": range(3), "C": range(3), "R": range(3)})
    (take.folder / "t.csv").write_text(text)
    with pytest.raises(InputError, match=said) as refused:
        open_take(replace(take, views=(replace(take.views[0], timestamps="t.csv"), *take.views[1:])))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("line", ["fps = 0", 'fps = "x"', "start = nan", "start = 1e9", "drift_ppm = true", "drift_ppm = 1e5",
                                  'timestamps = "../t.csv"', "timestamps = 3"])  # fmt: skip
def test_impossible_clocks_are_refused(tmp_path: Path, line: str) -> None:
    views = "".join(f'[[views]]\nname = "{n}"\nimages = "{n}/*.png"\n' for n in "LR")
    (tmp_path / "take.toml").write_text(HEAD + views + line + "\n")
    with pytest.raises(InputError, match=f'`{line.split()[0]}` of view "R"'):
        read_take(tmp_path)


def loose(at_thirty: AtThirty, images: dict[str, range]) -> Take:
    """The same, of which the views have some images each, at 30 frames per second."""
    return replace(read_take(at_thirty(images)), clicks=FrameClicks())


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


def test_views_at_other_rates_show_the_instants_of_the_take(at_thirty: AtThirty, sixty: Path) -> None:
    """L has 60 images per second and starts 2 of them late, R has 30, half a frame late: R is interpolated to the instants."""
    take = loose(at_thirty, {"L": range(2, 18), "C": range(0, 18, 2), "R": range(1, 18, 2)})
    views = tuple(replace(v, **clock) for v, clock in zip(take.views, ({"fps": 60.0, "start_s": 2 / 60}, {}, {"start_s": 1 / 60})))
    footage = open_take(replace(take, views=views))
    assert footage.frames == range(1, 9)
    for frame in footage.frames:
        assert (footage.number(0, frame), footage.delay(0, frame)) == (2 * frame - 2, 0.0)
        assert footage.number(2, frame) in (frame - 1, frame) and abs(footage.delay(2, frame)) == pytest.approx(0.5, abs=0.01)
    truth = open_take(replace(read_take(sixty)))
    for frame in (4, 6):
        shown, right = measured_rows(footage, frame), measured_rows(truth, 2 * frame)
        assert np.array_equal(shown[0], right[0]) and np.array_equal(shown[1], right[1])
        assert rms(shown[2], right[2]) < 0.5 * rms(footage.read(frame)[2], right[2])
    assert len(image_digests(footage, 4)) == 5  # R's neighbours count
    assert list(footage.frames_of_images(0, np.array([0, 1, 2]))) == [1, -1, 2]


def test_how_far_images_stray_when_they_are_played_one_after_another(at_thirty: AtThirty) -> None:
    take = loose(at_thirty, {"L": range(18), "C": range(9), "R": range(9)})
    steady = "view,time_s\n" + "".join(f"R,{n / 30}\n" for n in range(9))
    for times, strays in ((steady, 0.0), (steady.replace("R,0.0\n", "R,-0.1\n"), 3.0)):  # three frames are missing after image 0
        (take.folder / "timestamps.csv").write_text(times)
        views = tuple(replace(v, **c) for v, c in zip(take.views, ({"fps": 60.0}, {}, {"timestamps": "timestamps.csv"})))
        footage = open_take(replace(take, views=views))
        assert footage.strays_frames(1, 0) == 0.0 and footage.strays_frames(2, 0) == strays
        assert footage.strays_frames(0, 0) == footage.frames.stop - 1  # twice as many images as frames


def test_keys_of_stages_follow_clocks(sixty: Path, tmp_path: Path) -> None:
    take = replace(read_take(sixty), clicks=FrameClicks())
    settings, keys = settings_of({}, {}, "x"), set()
    for clock in ({}, {"start_s": 0.01}, {"start_s": 0.01, "drift_ppm": 9.0}):
        views = (replace(take.views[0], **clock), *take.views[1:])
        keys.add(stage_keys(open_take(replace(take, views=views)), settings, tmp_path)["measure"])
    assert len(keys) == 3


def test_the_rays_give_what_a_clock_lacks(at_thirty: AtThirty) -> None:
    """L at 60, R at 30 images per second half a frame late, but its start is given 6 ms too early."""
    take = loose(at_thirty, {"L": range(0, 18), "C": range(0, 18, 2), "R": range(1, 18, 2)})
    for wrong_s in (0.0, 0.006):
        views = tuple(replace(v, **c) for v, c in zip(take.views, ({"fps": 60.0}, {}, {"start_s": 1 / 60 - wrong_s})))
        offsets = {o.view: o for o in estimate_offsets(open_take(replace(take, views=views)), Monitor())}
        assert offsets["L"].method == offsets["R"].method == "rays"
        assert abs(offsets["L"].delay_frames) / 30 < 0.001 and abs(offsets["R"].delay_frames / 30 - wrong_s) < 0.001


def test_views_without_a_common_frame_are_refused(sixty: Path) -> None:
    take = replace(read_take(sixty), clicks=FrameClicks())
    late = replace(take, views=(replace(take.views[0], start_s=700.0), *take.views[1:]))
    with pytest.raises(InputError, match=r"no frame in common \(L from 700.00 to 700.28 s"):
        open_take(late)
    some = replace(take, views=(replace(take.views[0], start_s=0.1), *take.views[1:]), frames=(0, 9))
    with pytest.raises(InputError, match="frames 6 to 18"):
        open_take(some)
    assert View(name="L").clock == () and Footage.number(open_take(take), 0, 3) == 3
