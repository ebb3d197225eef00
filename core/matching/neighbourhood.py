"""What a point's neighbours say of it: a local polynomial through the values of the neighbouring cells, fitted robustly.

    z(a, b) = c · m(a, b) ,   m = 1, a, b [, ½ a², a b, ½ b²] ,   a, b in rows' pixels from the point          (1)

Used as the neighbourhood constraint of matching (SCIENCE §5b: what the neighbours predict becomes a pseudo-observation) and as the
neighbourhood filter (D'Apuzzo et al. 2000, §2.2: a point whose affine parameters differ from the local mean is removed).
"""

from dataclasses import dataclass, fields

import numpy as np

from ..threads import equal_pieces, in_threads
from .grid import TemplateGrid
from .template_patches import monomials

RADIUS_CELLS = 3
LARGEST = 512  # points whose neighbours stay in the cache
ROBUST_STEPS = 3
TUKEY = 4.685
RIDGE = (1e-9, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2)  # with coordinates in units of the radius: a thin neighbourhood falls back to a plane


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class NeighbourFit:
    """The polynomials (1) at M points."""

    coefficients: np.ndarray  # (M, P)
    scatter: np.ndarray  # (M,) robust scatter of the neighbours about (1)
    weights: np.ndarray  # (M, m) how far each neighbour lies on (1): 1 to 0, and 0 where there is none

    @property
    def support(self) -> np.ndarray:
        """(M,) the share of the neighbourhood's cells that lie on (1); at an outline half of them or less."""
        return np.asarray(self.weights.mean(axis=1))


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
) -> NeighbourFit:
    """Fit (1) about `query_xy` (M, 2) to `values` (N,) at `xy` (N, 2) of the rows `neighbour` (M, m), by Tukey's weights.

    Residuals below `min_scale` (M,) count fully; `radius_px` is the reach of the neighbourhood. Where there is no neighbour,
    coefficients are zero.
    """

    def fit(rows: slice) -> NeighbourFit:
        return _fitted(neighbour[rows], xy, values, query_xy[rows], degree, min_scale[rows], radius_px)

    parts = in_threads(fit, equal_pieces(len(neighbour), LARGEST, LARGEST))
    return NeighbourFit(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(NeighbourFit)})


def _fitted(
    neighbour: np.ndarray, xy: np.ndarray, values: np.ndarray, query_xy: np.ndarray, degree: int, min_scale: np.ndarray, radius_px: float
) -> NeighbourFit:
    valid = neighbour >= 0
    a, b = np.moveaxis(np.where(valid[..., None], xy[neighbour] - query_xy[:, None], 0.0) / radius_px, -1, 0)
    z = np.where(valid, values[neighbour], 0.0)
    base = np.where(valid.any(axis=1), z.sum(axis=1) / np.maximum(valid.sum(axis=1), 1), 0.0)
    z = np.where(valid, z - base[:, None], 0.0)
    m = monomials(a, b, degree).astype(np.float64)
    ridge = np.diag(RIDGE[: m.shape[2]])
    robust, scatter = valid.astype(np.float64), np.zeros(len(z))
    c = np.zeros((len(z), m.shape[2]))
    for step in range(ROBUST_STEPS + 1):
        weighted = (robust[:, :, None] * m).transpose(0, 2, 1)
        c = np.linalg.solve(weighted @ m + ridge, weighted @ z[:, :, None])[..., 0]
        residual = z - np.einsum("nmi,ni->nm", m, c)
        scatter = 1.4826 * _median(np.abs(residual), valid)
        if step < ROBUST_STEPS:
            ratio = residual / (TUKEY * np.maximum(scatter, min_scale))[:, None]
            robust = valid * np.clip(1 - ratio**2, 0, 1) ** 2
    c[:, 0] += base
    power = np.array([0, 1, 1, 2, 2, 2])[: m.shape[2]]
    return NeighbourFit(coefficients=c / radius_px**power, scatter=scatter, weights=robust)


def unlike_neighbours(grid: TemplateGrid, cell: np.ndarray, parameters: np.ndarray, *, sigmas: float, least: np.ndarray) -> np.ndarray:
    """(N,) points one of whose `parameters` (N, Q) differs from its neighbours' median by more than `sigmas` robust deviations.

    `least` (Q,) are the smallest deviations that count as a standard deviation. A point with fewer than three neighbours is not judged.
    """
    neighbour = neighbours_of(grid, cell, cell, itself=False)
    valid = neighbour >= 0
    bad = np.zeros(len(cell), dtype=bool)
    for q in range(parameters.shape[1]):
        z = np.where(valid, parameters[neighbour, q], np.nan)
        middle = _median(np.nan_to_num(z), valid)
        deviation = 1.4826 * _median(np.abs(np.nan_to_num(z) - middle[:, None]), valid)
        bad |= np.abs(parameters[:, q] - middle) > sigmas * np.maximum(deviation, least[q])
    return bad & (valid.sum(axis=1) >= 3)


def _median(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Median of each row over its mask; zero for empty rows."""
    ordered = np.sort(np.where(mask, values, np.inf), axis=1)
    n = mask.sum(axis=1)
    rows = np.arange(len(values))
    low, high = ordered[rows, np.maximum(n - 1, 0) // 2], ordered[rows, np.minimum(n // 2, values.shape[1] - 1)]
    return np.where(n > 0, 0.5 * (np.where(n > 0, low, 0.0) + np.where(n > 0, high, 0.0)), 0.0)
