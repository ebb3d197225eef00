"""Metaballs: the facts derived from Eqs. 7 and 8, and derivatives against differences."""

import numpy as np

from tricap.core.body.metaballs import STATIONS, VISIBLE, Metaballs, active_balls, field, field_and_derivatives, three_balls
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import bone_frames


def test_an_isolated_ball_is_seen_at_0_58871_of_its_radius() -> None:
    ball = Metaballs(bone_index=np.array([0]), centre=np.zeros((1, 3)), radii_m=np.array([[0.1, 0.2, 0.3]]), weight=np.ones(1))
    X = np.diag([0.1, 0.2, 0.3]) * 0.588705
    assert np.allclose(field(ball, np.ones(1), np.eye(3)[None], np.zeros((1, 3)), X), 0.5, atol=1e-5)
    assert abs(VISIBLE - 0.588705) < 1e-6


def test_three_balls_make_the_wanted_radius() -> None:
    lengths, wanted = np.array([0.26]), np.full((1, 3, 2), 0.04)
    balls = three_balls(np.array([0]), lengths, wanted)
    X = np.array([[0.04, f * 0.26, 0.0] for f in STATIONS])
    assert np.allclose(field(balls, lengths, np.eye(3)[None], np.zeros((1, 3)), X), 0.5, atol=1e-6)
    assert np.allclose(balls.radii_m[:, 0] / 0.04, 1.534, rtol=0.06)  # 1.534 for equal radii in the middle of an endless limb


def test_derivatives_equal_differences() -> None:
    rng, h = np.random.default_rng(0), 1e-6
    shape = default_shape(read_model("arm.R"))
    balls, L = shape.metaballs, shape.lengths_m
    R, head = bone_frames(shape.skeleton, L, rng.normal(0, 0.4, 8))
    X = head[rng.integers(0, 2, 20)] + rng.normal(0, 0.06, (20, 3))
    F, gradient, to_log_radii, to_weights = field_and_derivatives(balls, L, R, head, X)
    for i in range(3):
        step = np.eye(3)[i] * h
        assert np.allclose((field(balls, L, R, head, X + step) - field(balls, L, R, head, X - step)) / (2 * h), gradient[:, i], atol=1e-6)
    for m in range(len(balls.weight)):
        for i in range(3):
            grown = balls.radii_m.copy()
            grown[m, i] *= np.exp(h)
            other = Metaballs(bone_index=balls.bone_index, centre=balls.centre, radii_m=grown, weight=balls.weight)
            assert np.allclose((field(other, L, R, head, X) - F) / h, to_log_radii[:, m, i], atol=1e-5)
        heavier = Metaballs(bone_index=balls.bone_index, centre=balls.centre, radii_m=balls.radii_m, weight=balls.weight + h * np.eye(6)[m])
        assert np.allclose((field(heavier, L, R, head, X) - F) / h, to_weights[:, m], atol=1e-5)


def test_only_neighbouring_parts_add() -> None:
    shape = default_shape(read_model("arm.R"))
    alone = np.eye(2, dtype=bool)
    assert active_balls(shape.metaballs, alone, 1).tolist() == [False] * 3 + [True] * 3
    assert active_balls(shape.metaballs, shape.skeleton.neighbours, 1).all()
    R, head = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(8))
    X = head[1][None] + [[0, -0.03, 0]]
    both = field(shape.metaballs, shape.lengths_m, R, head, X)
    one = field(shape.metaballs, shape.lengths_m, R, head, X, active_balls(shape.metaballs, alone, 1))
    assert both > one
