"""What matching works on: the calibrated views of one moment, and the template grid, the points of the reference image to be measured.

What a point's neighbours say of it: a local polynomial through the values of the neighbouring cells, fitted robustly.

    z(a, b) = c · m(a, b) ,   m = 1, a, b [, ½ a², a b, ½ b²] ,   a, b in rows' pixels from the point          (1)

Used as the neighbourhood constraint of matching (SCIENCE §5b: what the neighbours predict becomes a pseudo-observation) and as the
neighbourhood filter (D'Apuzzo et al. 2000, §2.2: a point whose affine parameters differ from the local mean is removed).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from ..foundation.threads import equal_pieces, in_threads
from ..geometry.camera import Camera
from ..geometry.robust import PolynomialFit, fit_polynomial, mad_sigma, masked_median
from ..images.interlace import RowGrid
from ..images.sampling import SplineImage


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
        """The numbers of the search views, in the order of the cameras."""
        return [k for k in range(len(self.cameras)) if k != self.reference]

    def required_matches(self, pairs: bool) -> int:
        """How many search views must match a point: two, or all there are; with `pairs` one."""
        return 1 if pairs else min(2, len(self.cameras) - 1)

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


RADIUS_CELLS = 3
LARGEST = 512  # points whose neighbours stay in the cache


def neighbours_of(
    grid: TemplateGrid, cell: np.ndarray, query: np.ndarray, radius: int = RADIUS_CELLS, *, itself: bool = True
) -> np.ndarray:
    """Rows of `cell` (N,) that lie within `radius` cells of the cells `query` (M,): (M, m) with −1 where there is none."""
    gh, gw = grid.shape
    row_of = np.full((gh + 2 * radius, gw + 2 * radius), -1, dtype=np.int64)
    row_of[cell // gw + radius, cell % gw + radius] = np.arange(len(cell))
    dj, di = (d.ravel() for d in np.mgrid[-radius : radius + 1, -radius : radius + 1])
    found = row_of[(query // gw)[:, None] + radius + dj, (query % gw)[:, None] + radius + di]
    if not itself:
        found[:, len(dj) // 2] = -1
    return found


def fit_neighbours(
    neighbour: np.ndarray, xy: np.ndarray, values: np.ndarray, query_xy: np.ndarray, *, degree: int, min_scale: np.ndarray, radius_px: float
) -> PolynomialFit:
    """Fit (1) about `query_xy` (M, 2) to `values` (N,) at `xy` (N, 2) of the rows `neighbour` (M, m), by Tukey's weights.

    Residuals below `min_scale` (M,) count fully; `radius_px` is the reach of the neighbourhood. Where there is no neighbour,
    coefficients are zero.
    """

    def fit(rows: slice) -> PolynomialFit:
        return _fitted(neighbour[rows], xy, values, query_xy[rows], degree, min_scale[rows], radius_px)

    parts = in_threads(fit, equal_pieces(len(neighbour), LARGEST, LARGEST))
    return PolynomialFit(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(PolynomialFit)})


def _fitted(
    neighbour: np.ndarray, xy: np.ndarray, values: np.ndarray, query_xy: np.ndarray, degree: int, min_scale: np.ndarray, radius_px: float
) -> PolynomialFit:
    valid = neighbour >= 0
    a, b = np.moveaxis(np.where(valid[..., None], xy[neighbour] - query_xy[:, None], 0.0), -1, 0)
    z = np.where(valid, values[neighbour], 0.0)
    base = np.where(valid.any(axis=1), z.sum(axis=1) / np.maximum(valid.sum(axis=1), 1), 0.0)
    z = z - base[:, None]
    fit = fit_polynomial(a, b, z, valid, degree=degree, radius=radius_px, min_scale=min_scale)
    fit.coefficients[:, 0] += base
    return fit


def unlike_neighbours(grid: TemplateGrid, cell: np.ndarray, parameters: np.ndarray, *, sigmas: float, least: np.ndarray) -> np.ndarray:
    """(N,) points one of whose `parameters` (N, Q) differs from its neighbours' median by more than `sigmas` robust deviations.

    `least` (Q,) are the smallest deviations that count as a standard deviation. A point with fewer than three neighbours is not judged.
    """
    neighbour = neighbours_of(grid, cell, cell, itself=False)
    valid = neighbour >= 0
    bad = np.zeros(len(cell), dtype=bool)
    for q in range(parameters.shape[1]):
        z = np.where(valid, parameters[neighbour, q], np.nan)
        middle = masked_median(np.nan_to_num(z), valid)
        deviation = mad_sigma(np.nan_to_num(z) - middle[:, None], 1, valid)
        bad |= np.abs(parameters[:, q] - middle) > sigmas * np.maximum(deviation, least[q])
    return bad & (valid.sum(axis=1) >= 3)
