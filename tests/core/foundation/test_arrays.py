"""Items are made when they are asked for, and not kept."""

import pytest

from tricap.core.foundation.arrays import LazySequence


def test_items_are_made_anew_each_time_and_no_sooner() -> None:
    asked: list[int] = []
    squares = LazySequence([1, 2, 3, 4], lambda n: asked.append(n) or n * n)  # type: ignore[func-returns-value]
    assert len(squares) == 4 and asked == []
    assert squares[1] == 4 and squares[1] == 4 and asked == [2, 2]
    assert list(squares[2:]) == [9, 16] and squares[-1] == 16
    with pytest.raises(IndexError):
        squares[4]
