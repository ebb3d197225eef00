"""Small matrices as arrays against numpy's own, one by one."""

import numpy as np

from tricap.core.geometry.small_matrices import invert_spd, largest, sandwich


def test_products_and_inverses_are_numpys() -> None:
    random = np.random.default_rng(0)
    A, B = random.standard_normal((2, 50, 2, 2))
    K = B @ B.transpose(0, 2, 1) + np.eye(2)
    assert np.allclose(sandwich(A, K), A @ K @ A.transpose(0, 2, 1), rtol=1e-12, atol=1e-14)
    C = random.standard_normal((50, 6, 6))
    assert np.allclose(invert_spd(C @ C.transpose(0, 2, 1) + np.eye(6)), np.linalg.inv(C @ C.transpose(0, 2, 1) + np.eye(6)), atol=1e-12)
    assert np.array_equal(largest(C[:, 0]), np.abs(C[:, 0]).max(axis=1)) and len(largest(C[:0, 0])) == 0


def test_a_singular_matrix_spoils_itself_alone() -> None:
    inverse = invert_spd(np.stack([np.eye(3), np.zeros((3, 3)), 2 * np.eye(3)]))
    assert np.array_equal(inverse[[0, 2]], [np.eye(3), 0.5 * np.eye(3)]) and not np.isfinite(inverse[1]).all()
