"""Rectangles are packed without overlaps, in a small square, always in the same way."""

import numpy as np

from tricap.core.body.skin.packing import packed


def test_rectangles_do_not_overlap_and_fill_the_square() -> None:
    sizes = np.random.default_rng(3).uniform(0.2, 1.0, (12, 2))
    corners, side = packed(sizes)
    low, high = corners, corners + sizes
    apart = (low[:, None] >= high[None] - 1e-9).any(axis=2)
    assert (apart | apart.T | np.eye(len(sizes), dtype=bool)).all()
    assert low.min() >= 0 and high.max() == side and 0.8 < sizes.prod(axis=1).sum() / side**2 < 1
    again, same = packed(sizes)
    assert np.array_equal(again, corners) and same == side


def test_one_rectangle_is_at_the_origin() -> None:
    corners, side = packed(np.array([[0.3, 0.5]]))
    assert not corners.any() and side == 0.5
