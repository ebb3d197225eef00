"""What the cameras saw of the reference bar: two image points per camera and position, some missing, some wrong, ends perhaps mixed up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..values import frozen


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BarObservations:
    """N positions of a bar of known length before C cameras. `labelled`: end 0 is the same end in all cameras of a position."""

    names: tuple[str, ...]
    size_px: np.ndarray  # (C, 2) width, height
    xy_px: np.ndarray  # (N, C, 2 ends, 2) full-frame pixels, NaN: not seen
    length_m: float
    frames: np.ndarray  # (N,) frame numbers
    labelled: bool = True

    def __post_init__(self) -> None:
        C = len(self.names)
        object.__setattr__(self, "size_px", frozen(self.size_px, (C, 2), name="size_px"))
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (None, C, 2, 2), name="xy_px"))
        object.__setattr__(self, "frames", frozen(self.frames, (len(self.xy_px),), np.int64, "frames"))

    @property
    def seen(self) -> np.ndarray:
        """(N, C, 2) whether an end was seen."""
        return np.isfinite(self.xy_px).all(axis=-1)

    @property
    def complete(self) -> np.ndarray:
        """(N, C) whether both ends were seen."""
        return self.seen.all(axis=-1)

    def part(self, positions: np.ndarray | Sequence[int]) -> "BarObservations":
        """Some of the positions: indices or a mask (N,)."""
        return self.changed(self.xy_px[positions], self.frames[positions], self.labelled)

    def changed(self, xy_px: np.ndarray, frames: np.ndarray | None = None, labelled: bool = True) -> "BarObservations":
        """The same cameras and bar with other image points."""
        return BarObservations(
            names=self.names,
            size_px=self.size_px,
            xy_px=xy_px,
            length_m=self.length_m,
            frames=self.frames if frames is None else frames,
            labelled=labelled,
        )
