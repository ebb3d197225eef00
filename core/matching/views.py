"""What matching works on: the calibrated views of one moment, and the template grid, the points of the reference image to be measured."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..foundation.threads import in_threads
from ..geometry.camera import Camera
from ..geometry.view_angles import views_alike
from ..images.interlace import RowGrid
from ..images.sampling import SplineImage

RADIUS_CELLS = 3  # of the neighbourhood of a point: 7×7 cells


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Views:
    """The calibrated views of one moment: the reference view, whose image is the template, and the search views."""

    images: Sequence[SplineImage]  # (K,) the rows of every view
    cameras: Sequence[Camera]  # (K,)
    reference: int  # number of the reference view
    rows: RowGrid  # where the images' rows lie in the full frame

    @property
    def template(self) -> SplineImage:
        """The image of the reference view."""
        return self.images[self.reference]

    @property
    def base(self) -> Camera:
        """The camera of the reference view."""
        return self.cameras[self.reference]

    @property
    def search(self) -> list[int]:
        """The numbers of the search views, in the order of the cameras; without those that look from too far apart to be matched."""
        return views_alike(self.cameras, self.reference)

    def required_matches(self, pairs: bool) -> int:
        """How many search views must match a point: two, or all there are; with `pairs` one."""
        return 1 if pairs else min(2, len(self.search))

    def select(self, numbers: Sequence[int]) -> "Views":
        """Only these views; the first one becomes the reference."""
        return Views(images=[self.images[k] for k in numbers], cameras=[self.cameras[k] for k in numbers], reference=0, rows=self.rows)

    def smoothed(self, sigma_px: float) -> "Views":
        """The same views with Gaussian-smoothed images, `sigma_px` in full-frame pixels."""
        return replace(self, images=in_threads(lambda image: image.smoothed(sigma_px, self.rows.step), self.images))


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

    def neighbours(self, cell: np.ndarray, query: np.ndarray, radius: int = RADIUS_CELLS, *, itself: bool = True) -> np.ndarray:
        """Rows of `cell` (N,) that lie within `radius` cells of the cells `query` (M,): (M, m) with −1 where there is none."""
        gh, gw = self.shape
        row_of = np.full((gh + 2 * radius, gw + 2 * radius), -1, dtype=np.int64)
        row_of[cell // gw + radius, cell % gw + radius] = np.arange(len(cell))
        dj, di = (d.ravel() for d in np.mgrid[-radius : radius + 1, -radius : radius + 1])
        found = row_of[(query // gw)[:, None] + radius + dj, (query % gw)[:, None] + radius + di]
        if not itself:
            found[:, len(dj) // 2] = -1
        return found

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
