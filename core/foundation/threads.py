"""Array computations in a few threads. The pieces, and so the results, do not depend on the number of threads."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from threadpoolctl import threadpool_limits

Part = TypeVar("Part")
Result = TypeVar("Result")
_SHARE = os.environ.get("TRICAP_THREADS", "")  # `tricap batch` sets it for each worker
THREADS = int(_SHARE) if _SHARE.isdecimal() and int(_SHARE) > 0 else 2


def one_thread_in_linear_algebra() -> threadpool_limits:
    """A context in which the BLAS and LAPACK of numpy and scipy, in the whole process, use one thread.

    With more threads the order of summation varies, which changes the last digits, and small matrices keep threads busy waiting.
    """
    import scipy.linalg  # noqa: F401  its BLAS must be loaded before its threads can be limited

    return threadpool_limits(1, user_api="blas")


def in_threads(work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """The results of all parts, in their order; each free thread takes the next part."""
    if THREADS == 1 or len(parts) < 2:
        return [work(part) for part in parts]
    with ThreadPoolExecutor(min(THREADS, len(parts))) as pool:
        return list(pool.map(work, parts))


def equal_pieces(n: int, largest: int, shared_from: int) -> list[slice]:
    """An even number of equal pieces of n rows, none larger than `largest`; a single one below `shared_from` rows, empty if n is 0."""
    if n < max(2, shared_from) and n <= largest:
        return [slice(0, n)]
    count = 2 * -(-n // (2 * largest))
    cuts = [n * i // count for i in range(count + 1)]
    return [slice(a, b) for a, b in zip(cuts, cuts[1:])]
