"""The fundamental matrix of two views: with wrong matches, and from points that determine none."""

import numpy as np
import pytest

from tricap.core.geometry.fundamental import fundamental_matrix


def test_matches_that_agree_are_found_among_wrong_ones() -> None:
    random = np.random.default_rng(4)
    X = np.column_stack([random.uniform(-1, 1, (80, 2)), random.uniform(3, 5, 80)])
    xi, xj = 800 * X[:, :2] / X[:, 2:], 800 * (X[:, :2] + [0.4, 0.1]) / X[:, 2:]
    xj[:20] += random.uniform(30, 60, (20, 2))
    found = fundamental_matrix(xi, xj, 1.0, 0.999, 2000)
    assert found is not None
    F, agree = found
    assert agree[20:].all() and agree[:20].sum() < 6
    one = np.ones((60, 1))
    assert np.abs(np.sum(np.hstack([xj[20:], one]) @ F * np.hstack([xi[20:], one]), axis=1)).max() < 1e-2 * np.linalg.norm(F)


@pytest.mark.parametrize("points", [np.random.default_rng(0).normal(size=(6, 2)), np.ones((30, 2)), np.full((30, 2), np.nan)])
def test_points_that_determine_none_give_none(points: np.ndarray) -> None:
    assert fundamental_matrix(points, points + 1, 1e-3, 0.99, 500) is None
