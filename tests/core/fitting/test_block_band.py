"""The banded, bordered solver against dense algebra."""

import numpy as np
import pytest

from tricap.core.fitting.solve.block_band import NormalEquations, eliminated, reversed_in_time
from tricap.core.fitting.solve.solver import FURTHEST, bounded_step


def _random(T: int, D: int, S: int, seed: int) -> tuple[NormalEquations, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    rows = []
    for t in range(T):
        for span in (1, 2, 3):
            row = np.zeros((2 * D, T * D + S))
            row[:, t * D : (min(t + span, T)) * D] = rng.normal(size=(2 * D, (min(t + span, T) - t) * D))
            row[:, T * D :] = rng.normal(size=(2 * D, S)) if span == 1 else 0.0
            rows.append(row)
    J = np.concatenate(rows)
    N, b = J.T @ J, rng.normal(size=T * D + S)
    e = NormalEquations.empty(T, D, S)
    for t in range(T):
        e.diagonal[t] = N[t * D : (t + 1) * D, t * D : (t + 1) * D]
        e.border[t] = N[t * D : (t + 1) * D, T * D :]
        for k, target in ((1, e.next1), (2, e.next2)):
            if t + k < T:
                target[t] = N[(t + k) * D : (t + k + 1) * D, t * D : (t + 1) * D]
    e.corner[:], e.g[:], e.h[:] = N[T * D :, T * D :], b[: T * D].reshape(T, D), b[T * D :]
    return e, N, b


@pytest.mark.parametrize(("T", "S"), [(1, 0), (1, 4), (2, 3), (3, 0), (7, 5)])
def test_solution_and_inverse_blocks_equal_dense_algebra(T: int, S: int) -> None:
    D = 4
    e, N, b = _random(T, D, S, seed=T + S)
    for damping in (0.0, 0.3):
        dense = np.linalg.solve(N + damping * np.diag(np.diag(N)), b)
        x, s = e.solve(damping)
        assert np.allclose(np.concatenate([x.ravel(), s]), dense, rtol=1e-8, atol=1e-10)
    back = np.arange(1.0, T + 1)
    x, s = e.solve(0.3, back)
    dense = np.linalg.solve(N + 0.3 * np.diag(np.diag(N)) + np.diag(np.concatenate([np.repeat(back, D), np.zeros(S)])), b)
    assert np.allclose(np.concatenate([x.ravel(), s]), dense, rtol=1e-8, atol=1e-10)
    inverse = np.linalg.inv(N)
    pose, mixed, shape = e.covariance()
    for t in range(T):
        rows = slice(t * D, (t + 1) * D)
        assert np.allclose(pose[t], inverse[rows, rows], rtol=1e-7, atol=1e-11)
        assert np.allclose(mixed[t], inverse[rows, T * D :], rtol=1e-7, atol=1e-11)
    assert np.allclose(shape, inverse[T * D :, T * D :], rtol=1e-7, atol=1e-11)


@pytest.mark.parametrize("backwards", [False, True])
def test_what_is_left_after_elimination_has_the_same_solution(backwards: bool) -> None:
    T, D, S = 6, 4, 3
    e, _, _ = _random(T, D, S, seed=1)
    x, s = e.solve()
    left = reversed_in_time(eliminated(reversed_in_time(e), T - 2)) if backwards else eliminated(e, T - 2)
    two, shape = left.solve()
    assert np.allclose(two, x[:2] if backwards else x[-2:], rtol=1e-7, atol=1e-10) and np.allclose(shape, s, rtol=1e-7, atol=1e-10)
    assert np.allclose(left.covariance()[2], e.covariance()[2], rtol=1e-7)


def test_equations_without_information_are_refused() -> None:
    e, _, _ = _random(3, 4, 0, seed=0)
    e.diagonal[1] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        e.solve()


def test_a_frame_that_would_go_too_far_is_held_back_and_no_other() -> None:
    """Frame 1 of three uncoupled ones hardly knows its first unknown."""
    e = NormalEquations.empty(3, 2, 0)
    e.diagonal[:] = np.diag([1e4, 2e4])
    e.diagonal[1] = [[10.0, 5.0], [5.0, 1e4]]
    e.g[:] = [[100.0, -200.0], [20.0, 300.0], [1900.0, 10.0]]
    free, _ = e.solve(1e-3)
    step, _ = bounded_step(e, 1e-3, FURTHEST)
    assert np.abs(free[1]).max() > 1.5 and FURTHEST / 10 < np.abs(step[1]).max() <= FURTHEST
    assert (step[[0, 2]] == free[[0, 2]]).all()
    assert np.sum(step * e.g) > 0  # still downhill
    assert (bounded_step(e, 1e-3, np.inf)[0] == free).all()
