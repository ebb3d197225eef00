"""A sequence whose items are made when they are asked for and not kept, so that a long recording is never held in memory."""

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar, overload

A = TypeVar("A")
B = TypeVar("B")


class Lazy(Sequence[B], Generic[A, B]):
    """The items of another sequence as what `made` makes of each."""

    def __init__(self, items: Sequence[A], made: Callable[[A], B]) -> None:
        self._items, self._made = items, made

    def __len__(self) -> int:
        return len(self._items)

    @overload
    def __getitem__(self, index: int) -> B: ...
    @overload
    def __getitem__(self, index: slice) -> "Lazy[A, B]": ...
    def __getitem__(self, index: int | slice) -> "B | Lazy[A, B]":
        if isinstance(index, slice):
            return Lazy(self._items[index], self._made)
        return self._made(self._items[index])
