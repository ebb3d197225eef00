"""A fit that was stopped while it followed the body goes on from what it kept, and ends with the same bytes."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.fitting import frame_to_frame
from tricap.core.fitting.sequence import FitInput, FitSettings, fit_sequence
from tricap.core.progress import Cancelled, Monitor
from tricap.core.results import KeptFit, Results

SETTINGS = FitSettings(model_sigma_m=0.0, length_sigma=0.001, radius_sigma=0.001, voxel_m=0.006, sequence_steps=4)
CLICK, FRAMES = 3, 9


class Stopper(Monitor):
    """Counts the frames that are followed, and stops the fit at one of them."""

    def __init__(self, at: int | None = None) -> None:
        super().__init__()
        self.at, self.frames = at, 0

    def step(self, stage: str, done: float, total: float) -> None:
        if stage == "fit frame after frame":
            if self.frames == self.at:
                raise Cancelled("Stopped by the test.")
            self.frames += 1


def arrays(fit: object) -> dict[str, bytes]:
    motion = fit.motion  # type: ignore[attr-defined]
    return {name: np.ascontiguousarray(getattr(motion, name)).tobytes() for name in ("values", "covariance", "joints_m", "sigma0")}


@pytest.fixture
def given(make_scene, monkeypatch: pytest.MonkeyPatch) -> FitInput:
    monkeypatch.setattr(frame_to_frame, "KEEP_EVERY", 2)
    scene = make_scene(frames=FRAMES, click=CLICK)
    return FitInput(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks={CLICK: scene.clicks}, click_frame=CLICK,
                    time_s=scene.time_s, trajectories=scene.trajectories)


def test_a_stopped_fit_goes_on_with_the_same_bytes(given: FitInput, tmp_path: Path) -> None:
    """Stopped on the way to the end, and on the way back to the beginning."""
    whole = arrays(fit_sequence(given, SETTINGS))
    for stopped_at, left in ((4, 5), (7, 1)):
        goes_on(given, tmp_path / str(stopped_at), stopped_at, left, whole)


def goes_on(given: FitInput, folder: Path, stopped_at: int, left: int, whole: dict[str, bytes]) -> None:
    kept = KeptFit(Results(folder), "key")
    with pytest.raises(Cancelled):
        fit_sequence(given, SETTINGS, Stopper(stopped_at), kept)
    monitor = Stopper()
    assert arrays(fit_sequence(given, SETTINGS, monitor, kept)) == whole
    assert monitor.frames == left


def test_what_was_kept_of_another_take_is_not_used(given: FitInput, tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        fit_sequence(given, SETTINGS, Stopper(6), KeptFit(Results(tmp_path / "out"), "key"))
    monitor = Stopper(0)
    with pytest.raises(Cancelled):
        fit_sequence(given, SETTINGS, monitor, KeptFit(Results(tmp_path / "out"), "another"))
    assert monitor.frames == 0
