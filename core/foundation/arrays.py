"""Read-only arrays: the values that flow between the stages cannot be changed behind anybody's back.

Values of arrays that belong together row by row: some of their rows, or several values one after the other.

A sequence whose items are made when they are asked for and not kept, so that a long recording is never held in memory.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any, ClassVar, Generic, Protocol, TypeVar, overload

import numpy as np

from .errors import InputError

LEAST_CELLS, SPARSEST = 1_000_000, 20  # cells of a table: so many in any case, and so many for every one that is known


class _OfArrays(Protocol):
    """A dataclass; here, of arrays."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


Rows = TypeVar("Rows", bound=_OfArrays)


def frozen(array: Any, shape: Sequence[int | None], dtype: Any = np.float64, name: str = "array") -> np.ndarray:
    """A read-only copy of `array` as `dtype`, whose shape agrees with `shape` (None: any length).

    A file that is mapped read-only is not copied into memory.

    Raises:
        ValueError: the shape does not agree.
    """
    mapped = isinstance(array, np.memmap) and not array.flags.writeable
    copy = array if mapped else np.array(array, dtype=dtype)
    if copy.ndim != len(shape) or any(want is not None and have != want for have, want in zip(copy.shape, shape)):
        raise ValueError(f"{name} has shape {copy.shape}, expected {tuple(shape)}")
    copy.flags.writeable = False
    return copy


def select_rows(value: Rows, rows: Any) -> Rows:
    """A dataclass of arrays with only these rows (a mask, indices, a slice, or several of these for as many axes), contiguous."""
    return type(value)(**{f.name: np.ascontiguousarray(getattr(value, f.name)[rows]) for f in fields(value)})


def concatenated(values: Sequence[Rows], axis: int = 0) -> Rows:
    """Dataclasses of arrays, at least one, as one: their arrays one after the other along an axis."""
    return type(values[0])(**{f.name: np.concatenate([getattr(v, f.name) for v in values], axis) for f in fields(values[0])})


def check_sparse(rows: int, frames: int, names: int, where: object) -> None:
    """See that a table of frames × names is worth its memory, when a file has so many rows of one frame and name each.

    Raises:
        InputError: next to none of it is known: a file of a megabyte could ask for gigabytes.
    """
    if frames * names > max(LEAST_CELLS, SPARSEST * rows):
        raise InputError(
            f"{where} has {rows} rows for {frames} frames and {names} names, so that nearly all is missing; it is damaged, export it again."
        )


A = TypeVar("A")
B = TypeVar("B")


class LazySequence(Sequence[B], Generic[A, B]):
    """The items of another sequence as what `made` makes of each."""

    def __init__(self, items: Sequence[A], made: Callable[[A], B]) -> None:
        self._items, self._made = items, made

    def __len__(self) -> int:
        return len(self._items)

    @overload
    def __getitem__(self, index: int) -> B: ...
    @overload
    def __getitem__(self, index: slice) -> "LazySequence[A, B]": ...
    def __getitem__(self, index: int | slice) -> "B | LazySequence[A, B]":
        if isinstance(index, slice):
            return LazySequence(self._items[index], self._made)
        return self._made(self._items[index])
