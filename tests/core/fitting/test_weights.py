"""Weights of balls as parameters of the fit: off by default; where they are asked for they go towards the truth and have sigmas."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.stages.sequence import FitInput, fit_sequence
from tricap.core.fitting.state import ShapeParameters

SETTINGS = FitSettings(model_sigma_m=0.0, voxel_m=0.002, length_sigma=0.01, proportion_sigma=0.01, radius_sigma=0.02)


def test_weights_are_parameters_only_where_that_is_asked_for() -> None:
    shape = default_shape(read_model("arm.R"))
    without, with_weights = ShapeParameters(shape), ShapeParameters(shape, weights=True)
    assert len(with_weights.layout) == len(without.layout) + 6 == 2 + 12 + 6
    assert not len(without.layout.group("weights")) and with_weights.layout.group("weights").tolist() == list(range(14, 20))
    assert with_weights.layout.names[-1] == "weight forearm.R 3"
    vector = with_weights.vector()
    vector[-1] = np.log(1.3)
    lengths, balls = with_weights.body(vector)
    assert np.isclose(balls.weight[-1], 1.3) and np.allclose(with_weights.vector(with_weights.shape(vector, 0 * vector)), vector)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["joint", "alternating"])
def test_a_ball_of_another_weight_is_found(make_scene, method: str) -> None:
    shape = default_shape(read_model("arm.R"))
    true = np.array([1.0, 1.0, 1.0, 1.0, 1.5, 1.0])
    scene = make_scene(noise=0.0005, points=600, shape=replace(shape, metaballs=replace(shape.metaballs, weight=true)))
    given = FitInput(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks={0: scene.clicks}, time_s=scene.time_s)
    held = fit_sequence(given, replace(SETTINGS, method=method)).shape
    fit = fit_sequence(given, replace(SETTINGS, method=method, weights=True)).shape
    assert np.array_equal(held.metaballs.weight, np.ones(6)) and held.weight_sigma is None
    assert np.argmax(fit.metaballs.weight) == 4 and fit.metaballs.weight[4] > 1.2
    assert fit.weight_sigma is not None and (fit.weight_sigma > 0).all() and (fit.weight_sigma < 0.3 * fit.metaballs.weight).all()
