"""Video fields: an interlaced frame holds two instants, one in its even rows and one in its odd rows.

Matching works on the rows of one field; every coordinate that leaves this package is in FULL-FRAME pixels
(D'Apuzzo et al. 1999, §2.1: only odd lines are kept; SCIENCE: field row r is frame row 2 r or 2 r + 1).
"""

from dataclasses import dataclass

import numpy as np

INTERLACE = ("none", "odd", "even")


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

    def covariance_to_frame(self, covariance: np.ndarray) -> np.ndarray:
        """Covariances (…, 2, 2) of coordinates in the rows' image, as of full-frame pixels."""
        scale = np.array([1.0, self.step])
        return covariance * scale[:, None] * scale[None, :]


def row_grid(interlaced: str) -> RowGrid:
    """The grid of rows to keep: "odd" keeps the 1st, 3rd, … line (rows 0, 2, …), "even" the others, "none" all."""
    return {"none": RowGrid(1, 0), "odd": RowGrid(2, 0), "even": RowGrid(2, 1)}[interlaced]
