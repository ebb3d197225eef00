"""Work shared between threads: pieces that cover everything, results in their order, whatever the number of threads."""

import threading

import pytest

from tricap.core.foundation import threads
from tricap.core.foundation.threads import equal_pieces, in_threads

from ...waiting import PATIENCE_S


@pytest.mark.parametrize("n", [0, 1, 511, 512, 513, 1650, 5000])
def test_pieces_are_equal_and_cover_all(n: int) -> None:
    pieces = equal_pieces(n, 1024, 513)
    assert [i for piece in pieces for i in range(n)[piece]] == list(range(n))
    sizes = [piece.stop - piece.start for piece in pieces]
    assert max(sizes) - min(sizes) <= 1 and max(sizes) <= 1024
    assert len(pieces) % 2 == 0 if n > 512 else len(pieces) == 1  # two threads end together
    assert max(p.stop - p.start for p in equal_pieces(n, 300, 10_000)) <= 300


@pytest.mark.parametrize("count", [1, 2, 5])
def test_results_keep_their_order(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "THREADS", count)

    last, first = threading.Event(), count == 1

    def last_ends_first(i: int) -> int:
        """The first waits for the last of those that run at the same time."""
        if i == count - 1:
            last.set()
        assert i or first or last.wait(PATIENCE_S)
        return i * i

    assert in_threads(last_ends_first, range(6)) == [0, 1, 4, 9, 16, 25]
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda i: 1 // i, [1, 0])
