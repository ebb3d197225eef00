"""A stopped fit resumes from its checkpoints, with the same bytes in the end."""

import gc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.fitting.solve.time_priors import MarginalPrior
from tricap.core.fitting.stages import long_sequence, pose_tracking, sequence
from tricap.core.fitting.stages.pose_tracking import CHECKPOINT
from tricap.core.fitting.stages.sequence import FitInput, FitSettings, fit_sequence
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.results.folder import FitCheckpoints, Results

SETTINGS = FitSettings(model_sigma_m=0.0, length_sigma=0.001, proportion_sigma=0.001, radius_sigma=0.001, voxel_m=0.006, sequence_steps=4)
CLICK, FRAMES = 3, 9


class Stopper(Monitor):
    """Counts the frames that are followed, and stops the fit at one of them."""

    def __init__(self, at: int | None = None) -> None:
        super().__init__()
        self.at, self.frames = at, 0

    def part(self, stage: str, index: int, total: int) -> Monitor:
        if stage == pose_tracking.STAGE:
            if self.frames == self.at:
                raise Cancelled("Stopped by the test.")
            self.frames += 1
        return super().part(stage, index, total)


def arrays(fit: object) -> dict[str, bytes]:
    motion = fit.motion  # type: ignore[attr-defined]
    return {name: np.ascontiguousarray(getattr(motion, name)).tobytes() for name in ("values", "covariance", "joints_m", "sigma0")}


@pytest.fixture
def given(make_scene, monkeypatch: pytest.MonkeyPatch) -> FitInput:
    monkeypatch.setattr(pose_tracking, "CHECKPOINT_EVERY", 2)
    scene = make_scene(frames=FRAMES, click=CLICK)
    return FitInput(
        rig=scene.rig,
        model=scene.model,
        clouds=scene.clouds,
        clicks={CLICK: scene.clicks},
        click_frame=CLICK,
        time_s=scene.time_s,
        trajectories=scene.trajectories,
    )


def test_a_stopped_fit_resumes_with_the_same_bytes(given: FitInput, tmp_path: Path) -> None:
    """Stopped on the way to the end, and on the way back to the beginning."""
    whole = arrays(fit_sequence(given, SETTINGS))
    for stopped_at, left in ((4, 5), (7, 1)):
        resumes(given, tmp_path / str(stopped_at), stopped_at, left, whole)


def resumes(given: FitInput, folder: Path, stopped_at: int, left: int, whole: dict[str, bytes]) -> None:
    checkpoints = FitCheckpoints(Results(folder), "key")
    with pytest.raises(Cancelled):
        fit_sequence(given, SETTINGS, Stopper(stopped_at), checkpoints)
    monitor = Stopper()
    assert arrays(fit_sequence(given, SETTINGS, monitor, checkpoints)) == whole
    assert monitor.frames == left


def test_checkpoints_of_another_take_are_not_used(given: FitInput, tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        fit_sequence(given, SETTINGS, Stopper(6), FitCheckpoints(Results(tmp_path / "out"), "key"))
    monitor = Stopper(0)
    with pytest.raises(Cancelled):
        fit_sequence(given, SETTINGS, monitor, FitCheckpoints(Results(tmp_path / "out"), "another"))
    assert monitor.frames == 0
    with pytest.raises(Cancelled):  # a second fit of the same run has checkpoints of its own, beside those of the first
        fit_sequence(given, SETTINGS, Stopper(6), FitCheckpoints(Results(tmp_path / "out"), "again", "fit_again"))
    first, second = (FitCheckpoints(Results(tmp_path / "out"), *which) for which in (("key",), ("again", "fit_again")))
    assert first.load(CHECKPOINT) is not None and second.load(CHECKPOINT) is not None


class StoppedStretches(Monitor):
    """Notes each part of an adjustment in stretches as it begins, and stops the fit when the n-th begins."""

    def __init__(self, at: int | None = None) -> None:
        super().__init__()
        self.at, self.begun = at, list[str]()

    def step(self, stage: str, done: float, total: float) -> None:
        if stage == "adjust the sequence" and done == 0:
            self._begin("shape")

    def part(self, stage: str, index: int, total: int) -> Monitor:
        if stage == "adjust the poses":
            self._begin(f"{index + 1} of {total}")
        return Monitor()

    def _begin(self, what: str) -> None:
        if len(self.begun) == self.at:
            raise Cancelled("Stopped by the test.")
        self.begun.append(what)


@pytest.mark.parametrize("balls", ["three", pytest.param("complete", marks=pytest.mark.slow)])
def test_a_fit_in_stretches_resumes_with_the_next(given: FitInput, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, balls: str) -> None:
    """Stopped after the shape, and after the second of three stretches."""
    for module in (sequence, long_sequence):
        monkeypatch.setattr(module, "AT_ONCE", 3)
    monkeypatch.setattr(long_sequence, "MARGIN", 2)
    settings = replace(SETTINGS, balls=balls, sequence_steps=2)
    whole = arrays(fit_sequence(given, settings, monitor := StoppedStretches()))
    assert monitor.begun == ["shape", "1 of 3", "2 of 3", "3 of 3"]
    for stopped_at in (1, 3):
        checkpoints = FitCheckpoints(Results(tmp_path / str(stopped_at)), "key")
        with pytest.raises(Cancelled):
            fit_sequence(given, settings, StoppedStretches(stopped_at), checkpoints)
        assert arrays(fit_sequence(given, settings, again := StoppedStretches(), checkpoints)) == whole
        assert again.begun == monitor.begun[stopped_at:]


@pytest.mark.slow
def test_marginal_priors_of_earlier_stretches_are_released(make_scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are as large as a stretch's covariances: a long fit would need twice the memory."""
    scene, alive, adjusted = make_scene(frames=21, click=9), list[int](), sequence._stretch
    for module in (sequence, long_sequence):
        monkeypatch.setattr(module, "AT_ONCE", 3)
    monkeypatch.setattr(long_sequence, "MARGIN", 2)

    def counted(*given: object) -> object:
        gc.collect()
        alive.append(sum(isinstance(thing, MarginalPrior) for thing in gc.get_objects()))
        return adjusted(*given)

    monkeypatch.setattr(sequence, "_stretch", counted)
    given = FitInput(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks={9: scene.clicks}, click_frame=9, time_s=scene.time_s)
    fit_sequence(given, replace(SETTINGS, sequence_steps=1))
    assert len(alive) == 7
    assert max(alive) == 4  # the last one ahead, and the last one back: for the adjustment, and for covariances
