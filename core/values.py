"""Read-only arrays: the values that flow between the stages cannot be changed behind anybody's back."""

from collections.abc import Sequence
from typing import Any

import numpy as np


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
