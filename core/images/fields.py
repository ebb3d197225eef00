"""Video fields: an interlaced frame holds two instants, one in its even rows and one in its odd rows.

Matching works on the rows of one field; every coordinate that leaves this package is in FULL-FRAME pixels
(D'Apuzzo et al. 1999, §2.1: only odd lines are kept; SCIENCE: field row r is frame row 2 r or 2 r + 1).
"""

from dataclasses import dataclass
from typing import overload

import numpy as np

INTERLACE = ("none", "odd", "even")
BOTH = "both"  # fields, one after the other


@dataclass(frozen=True, slots=True)
class RowGrid:
    """Which rows of the frame an image holds: frame row = step · row + offset. Columns are those of the frame."""

    step: int = 1
    offset: int = 0

    def rows(self, frame: np.ndarray) -> np.ndarray:
        """The rows (h', w) of a full frame (h, w), contiguous."""
        return np.ascontiguousarray(frame[self.offset :: self.step])

    def to_frame(self, xy: np.ndarray) -> np.ndarray:
        """Full-frame pixels (…, 2) of coordinates (…, 2) in the rows' image."""
        return np.asarray(xy, dtype=np.float64) * (1.0, self.step) + (0.0, self.offset)

    def from_frame(self, xy: np.ndarray) -> np.ndarray:
        """Coordinates (…, 2) in the rows' image of full-frame pixels (…, 2)."""
        return (np.asarray(xy, dtype=np.float64) - (0.0, self.offset)) / (1.0, self.step)

    def whole(self, frame: np.ndarray) -> np.ndarray:
        """The frame (h, w) with the rows that this grid does not have, of another instant, interpolated."""
        if self.step == 1:
            return frame
        filled = frame.copy()
        other = np.arange(1 - self.offset, len(frame), 2)
        above, below = np.clip(other - 1, self.offset, None), other + 1
        below = np.where(below < len(frame), below, above)
        filled[other] = 0.5 * (frame[above] + frame[below])
        return filled

    def covariance_to_frame(self, covariance: np.ndarray) -> np.ndarray:
        """Covariances (…, 2, 2) of coordinates in the rows' image, as of full-frame pixels."""
        scale = np.array([1.0, self.step])
        return covariance * scale[:, None] * scale[None, :]


@dataclass(frozen=True, slots=True)
class FieldLayout:
    """Which image, and which of its rows, show instant n of a recording: one instant an image, or two where both fields are measured."""

    first: RowGrid = RowGrid()
    second: RowGrid | None = None

    @property
    def per_image(self) -> int:
        """FieldLayout in an image, 1 or 2."""
        return 1 if self.second is None else 2

    def rows(self, instant: int) -> RowGrid:
        """The rows that show it."""
        return self.first if self.second is None or instant % 2 == 0 else self.second

    def image(self, instant: int) -> int:
        """Number of the image that shows it."""
        return instant // self.per_image


def field_layout(interlaced: str, first_field: str = "odd") -> FieldLayout:
    """The instants of footage of which one field is kept, or "both", of which `first_field` was exposed first."""
    if interlaced != BOTH:
        return FieldLayout(row_grid(interlaced))
    odd, even = row_grid("odd"), row_grid("even")
    return FieldLayout(odd, even) if first_field == "odd" else FieldLayout(even, odd)


def row_grid(interlaced: str) -> RowGrid:
    """The grid of rows to keep: "odd" keeps the 1st, 3rd, … line (rows 0, 2, …), "even" the others, "none" all."""
    return {"none": RowGrid(1, 0), "odd": RowGrid(2, 0), "even": RowGrid(2, 1)}[interlaced]


@overload
def frame_time_s(frame: float, fps: float) -> float: ...
@overload
def frame_time_s(frame: np.ndarray, fps: float) -> np.ndarray: ...
def frame_time_s(frame: float | np.ndarray, fps: float) -> float | np.ndarray:
    """When a frame of a recording (or each of several) was taken, in seconds after its frame 0; `fps` frames per second, fields counted."""
    return frame / fps
