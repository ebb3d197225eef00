"""Tracking whole takes: checkpoints, and a resumed run that is the same run."""

import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.tracking.published_step import STEPS
from tricap.core.tracking.settings import FILTER_KNOBS
from tricap.core.tracking.step import TrackedFrame


def same(a: TrackedFrame, b: TrackedFrame) -> None:
    """Byte-equal tracked frames."""
    assert a.frame == b.frame
    for f in fields(TrackedFrame):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype and x.tobytes() == y.tobytes(), f"{f.name} of frame {a.frame}"


@pytest.fixture(scope="module")
def surfaces(plane_take: Path, tmp_path_factory: pytest.TempPathFactory, scenes: Any) -> Path:
    """The results of measuring alone; copy them before changing them."""
    out: Path = tmp_path_factory.mktemp("surfaces") / "out"
    scenes.measure(plane_take, out)
    return out


@pytest.fixture(scope="module")
def whole(plane_take: Path, surfaces: Path, tmp_path_factory: pytest.TempPathFactory, scenes: Any) -> Path:
    """The results of measuring and tracking in one run; copy them before changing them."""
    out = Path(shutil.copytree(surfaces, tmp_path_factory.mktemp("whole") / "out"))
    scenes.track(plane_take, out, scenes.measure(plane_take, out))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("stop_at", [1, 2, 3])
def test_a_resumed_run_is_the_same_run(plane_take: Path, surfaces: Path, whole: Path, tmp_path: Path, scenes: Any, stop_at: int) -> None:
    """Cancelled before frame `stop_at` and run again, with surfaces that come from checkpoints too: byte-equal."""
    shutil.copytree(surfaces, tmp_path / "parts")
    measured = scenes.measure(plane_take, tmp_path / "parts")
    at_once = scenes.track(plane_take, whole, measured)

    def stop(stage: str, done: float, total: float) -> None:
        if stage == "tracks" and done >= stop_at - 0.5:
            monitor.cancel()

    monitor = Monitor(stop)
    with pytest.raises(Cancelled):
        scenes.track(plane_take, tmp_path / "parts", measured, monitor=monitor)
    kept = sorted(p.stem for p in (tmp_path / "parts" / "cache" / "tracks").glob("*.npz"))
    assert 1 <= len(kept) < 4
    resumed = scenes.track(plane_take, tmp_path / "parts", scenes.measure(plane_take, tmp_path / "parts"))
    for a, b in zip(at_once, resumed, strict=True):
        same(a, b)
    for path in list((tmp_path / "parts" / "cache" / "tracks").glob("0002*.npz")):
        path.write_bytes(path.read_bytes()[:2000])  # damaged: made anew, and so is what depends on it, alike
    for a, b in zip(at_once, scenes.track(plane_take, tmp_path / "parts", measured), strict=True):
        same(a, b)


@pytest.mark.slow
def test_what_changes_is_tracked_again(plane_take: Path, whole: Path, tmp_path: Path, scenes: Any) -> None:
    shutil.copytree(whole, tmp_path / "out")
    measured = scenes.measure(plane_take, tmp_path / "out")
    first = scenes.track(plane_take, tmp_path / "out", measured)
    coarse = scenes.track(plane_take, tmp_path / "out", measured, {"tracking": {"spacing_px": 16}})
    assert len(coarse[0].identity) < 0.5 * len(first[0].identity)
    other = scenes.measure(plane_take, tmp_path / "out", {"matching": {"patch_px": 11}})
    again = scenes.track(plane_take, tmp_path / "out", other, {"matching": {"patch_px": 11}})
    assert not np.array_equal(again[0].xyz_m[:50], first[0].xyz_m[:50])
    for a, b in zip(first, scenes.track(plane_take, tmp_path / "out", measured)):
        same(a, b)


def test_filters_need_no_new_tracking(plane_take: Path, whole: Path, tmp_path: Path, scenes: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other settings of the filters: every checkpoint is used, the result is that of a fresh run. A setting of the step tracks again."""
    other = {"tracking": {"max_speed": 8.0, "max_acceleration": 90.0, "uniformity": "voxels", "max_sigma_ratio": 2.0, "min_length": 3,
                          "smooth_frames": 5}}  # fmt: skip
    assert set(other["tracking"]) == set(FILTER_KNOBS)
    shutil.copytree(whole, tmp_path / "out")
    measured = scenes.measure(plane_take, tmp_path / "out")
    fresh = scenes.track(plane_take, tmp_path / "fresh", measured, other)

    def no_tracking(*_: Any) -> None:
        raise AssertionError("tracked again")

    monkeypatch.setitem(STEPS, "space", no_tracking)
    for a, b in zip(fresh, scenes.track(plane_take, tmp_path / "out", measured, other), strict=True):
        same(a, b)
    for name, value in (("max_deviation_mm", 3.0), ("neighbourhood_m", 0.2)):  # the filters ask for them, and the step does, too
        with pytest.raises(AssertionError, match="tracked again"):
            scenes.track(plane_take, tmp_path / "out", measured, {"tracking": {name: value}})


@pytest.mark.slow
def test_frames_without_a_surface(tmp_path: Path, scenes: Any) -> None:
    """Every point ends when the picture goes blank; new ones with new identities start when it comes back."""
    plane = scenes.Body(half_m=(0.2, 0.15))
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[plane], [plane], [], [], [], [], [], [], [plane], [plane]])
    steps = scenes.track(take, tmp_path / "out", scenes.measure(take, tmp_path / "out"), {"tracking": {"regenerate_every": 1}})
    count = [len(s.identity) for s in steps]
    assert count[0] > 50 and count[2:8] == [0] * 6 and count[8] > 0.8 * count[0]
    assert steps[8].identity.min() > steps[0].identity.max()


def test_enhanced_images_are_tracked(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    """A surface measured in enhanced images is tracked in them; the keys of the two differ."""
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text.replace("[[views]]", "frames = [0, 2]\n[[views]]", 1))
    measured = scenes.measure(take, tmp_path / "out")
    plain = scenes.track(take, tmp_path / "out", measured)[1]
    enhanced = scenes.track(take, tmp_path / "out", measured, {"enhance": {"wallis": "on"}})[1]
    both = np.intersect1d(plain.identity, enhanced.identity)
    moved = [t.xy[np.searchsorted(t.identity, both)] for t in (plain, enhanced)]
    assert len(both) > 50 and 0 < np.nanmedian(np.abs(moved[0] - moved[1])) < 0.2
