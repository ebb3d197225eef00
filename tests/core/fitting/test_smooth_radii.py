"""Post-fit smoothing: rings that no measurement supports disappear; measured radii, lengths, and a body's own proportions stay."""

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.fitting.smooth_radii import smooth_radii
from tricap.core.fitting.state import ShapeParameters

SIGMA = 0.4


@pytest.fixture(scope="module")
def parameters() -> ShapeParameters:
    return ShapeParameters(default_shape(read_model("full")))


def with_a_ring(parameters: ShapeParameters) -> tuple[np.ndarray, np.ndarray]:
    """A vector whose spine is half as thick again in the middle as the model's, and where in it."""
    balls, names = parameters.template.metaballs, [bone.name for bone in parameters.skeleton.bones]
    middle = np.flatnonzero(balls.bone_index == names.index("spine"))[1]
    rows = parameters.layout.group("radii")[2 * middle : 2 * middle + 2]
    vector = parameters.vector()
    vector[rows] += np.log(1.5)
    return vector, rows


def test_a_ring_is_smoothed_as_far_as_it_was_not_measured(parameters: ShapeParameters) -> None:
    vector, rows = with_a_ring(parameters)
    for sigma, low, high in ((0.005, 0.99, 1.0), (1.0, 0.0, 0.3)):
        found, covariance = smooth_radii(parameters, vector, sigma**2 * np.eye(len(vector)), SIGMA)
        left = (found - parameters.vector())[rows] / np.log(1.5)
        assert (left >= low).all() and (left <= high).all()
        assert np.linalg.eigvalsh(covariance).min() > 0 and (np.diag(covariance) <= sigma**2 * (1 + 1e-9)).all()


def test_a_body_thicker_all_along_or_towards_its_ends_stays_as_it_is(parameters: ShapeParameters) -> None:
    vector = parameters.vector()
    vector[parameters.layout.group("radii")] += np.log(1.3)
    found, _ = smooth_radii(parameters, vector, np.eye(len(vector)), SIGMA)
    np.testing.assert_allclose(found, vector, atol=1e-12)


def test_lengths_stay_even_where_they_are_correlated_with_the_radii(parameters: ShapeParameters) -> None:
    vector, rows = with_a_ring(parameters)
    J = np.random.default_rng(3).normal(size=(2 * len(vector), len(vector)))
    found, _ = smooth_radii(parameters, vector, np.linalg.inv(J.T @ J), SIGMA)
    lengths = parameters.layout.group("lengths")
    assert np.array_equal(found[lengths], vector[lengths]) and not np.allclose(found[rows], vector[rows])
