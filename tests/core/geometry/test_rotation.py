"""Rotations: round trips over all angles, small ones and half turns too, and agreement with the definition."""

import numpy as np
import pytest

from tricap.core.geometry.rotation import axis_rotation, cross_matrix, rotation_from_vector, vector_from_rotation

ANGLES = [0.0, 1e-12, 1e-9, 1e-8, 1.1e-8, 1e-6, 1e-3, 0.5, 2.0, 3.1, np.pi - 1e-7]


@pytest.mark.parametrize("angle", ANGLES)
def test_vector_and_matrix_there_and_back(angle: float) -> None:
    for seed in range(5):
        axis = np.random.default_rng(seed).standard_normal(3)
        vector = angle * axis / np.linalg.norm(axis)
        R = rotation_from_vector(vector)
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-14) and np.isclose(np.linalg.det(R), 1)
        assert np.allclose(vector_from_rotation(R), vector, atol=1e-14 + 1e-7 * (angle > 3.14))  # the axis is ill-defined near a half turn
        assert np.allclose(R, np.eye(3) + cross_matrix(vector) @ (np.eye(3) + 0.5 * cross_matrix(vector)), atol=angle**3 / 5 + 1e-15)


def test_a_half_turn() -> None:
    for axis in np.eye(3):
        R = rotation_from_vector(np.pi * axis)
        assert np.allclose(R, 2 * np.outer(axis, axis) - np.eye(3), atol=1e-15)
        assert np.allclose(rotation_from_vector(vector_from_rotation(R)), R, atol=1e-15)


def test_many_at_once_and_about_the_axes() -> None:
    angles = np.linspace(-4, 4, 9)
    for i, axis in enumerate("xyz"):
        vectors = np.zeros((9, 3))
        vectors[:, i] = angles
        assert np.allclose(axis_rotation(axis, angles), rotation_from_vector(vectors), atol=1e-15)
    assert axis_rotation("x", 0.1).shape == (3, 3)
    assert np.allclose(axis_rotation("z", np.pi / 2) @ [1, 0, 0], [0, 1, 0])
    a, b = np.random.default_rng(0).standard_normal((2, 7, 3))
    assert np.allclose(np.einsum("nij,nj->ni", cross_matrix(a), b), np.cross(a, b))
