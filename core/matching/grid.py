"""The template grid: the points of the reference image that are measured, a regular net of cells."""

from dataclasses import dataclass

import numpy as np

from ..images.fields import RowGrid


@dataclass(frozen=True, kw_only=True, slots=True)
class TemplateGrid:
    """Cells (j, i) about `spacing_px` full-frame pixels apart; in a field the rows step by half as many rows."""

    spacing_px: int
    rows: RowGrid
    shape: tuple[int, int]  # cells (gh, gw)

    @property
    def step(self) -> np.ndarray:
        """(2,) columns and rows of the image from cell to cell."""
        return np.array([self.spacing_px, max(1, round(self.spacing_px / self.rows.step))], dtype=np.float64)

    def xy(self, cells: np.ndarray) -> np.ndarray:
        """Rows' pixels (…, 2) of flat cell numbers (…)."""
        return np.stack([cells % self.shape[1], cells // self.shape[1]], axis=-1) * self.step

    def nearest(self, xy: np.ndarray) -> np.ndarray:
        """Flat cell numbers (…) nearest to rows' pixels (…, 2), clipped to the grid."""
        i, j = np.moveaxis(np.rint(xy / self.step).astype(np.int64), -1, 0)
        return np.clip(j, 0, self.shape[0] - 1) * self.shape[1] + np.clip(i, 0, self.shape[1] - 1)

    def every(self, n: int) -> np.ndarray:
        """Rows' pixels (m, 2) of every n-th cell in both directions."""
        j, i = np.mgrid[0 : self.shape[0] : n, 0 : self.shape[1] : n]
        return self.xy((j * self.shape[1] + i).ravel())


def template_grid(image_shape: tuple[int, int], rows: RowGrid, spacing_px: int) -> TemplateGrid:
    """The grid over an image of rows with shape (h', w)."""
    step_y = max(1, round(spacing_px / rows.step))
    return TemplateGrid(
        spacing_px=spacing_px, rows=rows, shape=((image_shape[0] - 1) // step_y + 1, (image_shape[1] - 1) // spacing_px + 1)
    )
