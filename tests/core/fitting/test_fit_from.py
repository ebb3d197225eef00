"""A second adjustment of the same frames from the poses that were tracked for the first one."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.stages.sequence import fit_and_start, fit_from
from tricap.core.foundation.progress import Monitor

FRAMES = 5


class _Stages(Monitor):
    """The stages that were reported."""

    def __init__(self) -> None:
        super().__init__()
        self.heard: list[str] = []

    def step(self, stage: str, done: float, total: float) -> None:
        self.heard.append(stage)
        super().step(stage, done, total)


def _given(scene) -> FitInput:
    return FitInput(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks={0: scene.clicks}, click_frame=0, time_s=scene.time_s)


def test_the_same_input_gives_the_same_body(make_scene) -> None:
    """To the last bit, from the tracked poses alone."""
    given, settings = _given(make_scene(frames=FRAMES, seed=2, points=120)), FitSettings(model_sigma_m=0.0, voxel_m=0.002)
    first, start = fit_and_start(given, settings, whole := _Stages())
    again = fit_from(given, start, settings, monitor := _Stages())
    assert np.array_equal(again.motion.joints_m, first.motion.joints_m) and again.iterations == first.iterations
    assert np.array_equal(again.shape.metaballs.radii_m, first.shape.metaballs.radii_m)
    assert {"fit the click frame", "fit frame after frame"} <= set(whole.heard) - set(
        monitor.heard
    ) and "adjust the sequence" in monitor.heard


def test_another_input_moves_the_body(make_scene) -> None:
    """The start does not hold the second adjustment: points that lie elsewhere take the arm with them."""
    scene, settings = make_scene(frames=FRAMES, seed=2, points=120), FitSettings(model_sigma_m=0.0, voxel_m=0.002)
    first, start = fit_and_start(_given(scene), settings, Monitor())
    moved = [SimpleNamespace(**{**vars(cloud), "xyz_m": cloud.xyz_m + [0.004, 0.0, 0.0]}) for cloud in scene.clouds]
    again = fit_from(replace(_given(scene), clouds=moved), start, settings, Monitor())
    shift = (again.motion.joints_m - first.motion.joints_m).mean(axis=(0, 1))
    assert shift == pytest.approx([0.004, 0.0, 0.0], abs=8e-4)
