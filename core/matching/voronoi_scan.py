"""Dense matching as published (D'Apuzzo et al. 2000, §2.2): shifts over the Voronoi regions of the seeds.

The reference image is the template; every search image is matched independently, without geometry. From each seed the match is shifted
horizontally to the boundary of the seed's region, then vertically from the points so matched, and so on until the region is covered:

    start(p + δ) = x(p) + A(p) δ                                                                             (1)

A match is accepted if five indicators are within the limits of its texture case: sigma0, the standard deviations of the shifts in x and y,
and the displacements from the start in x and y. A failed match is repeated with half the shift, then with bigger patches; holes are closed
from all directions around; points whose affine parameters differ from their neighbours' are removed, and matched again from the others.
At the end the search images' results are merged and intersected.

All regions advance together: the heads of all scans are one array, and a step of all of them is one call of the matcher.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..foundation.progress import Monitor
from ..geometry.intersection import forward_intersection
from ..geometry.robust import mad_sigma, masked_median
from ..images.sampling import SplineImage
from .foreground import Foreground
from .least_squares import Matches, MatchingSettings, SearchImage, TemplatePoints, match_patches
from .region_growing import MAX_LIMIT_PX, SEED_MEDIANS, TEMPLATE_SIGMA_PX, GrowingSettings, MatchedField
from .seeds import Approximations
from .views import TemplateGrid, Views

HORIZONTAL, VERTICAL = np.array([(-1, 0), (1, 0)]), np.array([(0, -1), (0, 1)])
AROUND = np.array([(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dx or dy])
BIGGER_PX = (4, 8)  # px by which patches are larger in the retries
FILTER_SIGMAS = 3.0  # robust deviations from the neighbours' median at which a point is removed
FILTER_LEAST = np.array([0.02, 0.02, 0.02, 0.02, 0.3, 0.3])  # least deviation of the four shape parameters, and of the two shifts [px]
FILTER_NEIGHBOURS = 3  # of a point; one with fewer is not judged
FILTER_PASSES = 2
HOLES_CLOSED = 0.002  # closing holes ends when a pass adds less than this part of the matched cells


@dataclass(frozen=True, kw_only=True, slots=True)
class TextureCase:
    """Limits of the five indicators (and of the correlation) for a level of texture.

    D'Apuzzo et al. 2000 leave the values to the user; these are ours.
    """

    max_sigma0: float  # grey values of a patch whose contrast is 50
    max_sigma_px: float  # of the shifts in x and y
    max_shift_px: float  # displacement from the start in x and y
    min_correlation: float


CASES = {
    "strong": TextureCase(max_sigma0=12.0, max_sigma_px=0.08, max_shift_px=3.0, min_correlation=0.90),
    "clothing": TextureCase(max_sigma0=18.0, max_sigma_px=0.15, max_shift_px=3.0, min_correlation=0.80),
    "skin": TextureCase(max_sigma0=35.0, max_sigma_px=0.30, max_shift_px=4.0, min_correlation=0.70),
}


def limits_of(texture: str, matching: MatchingSettings) -> MatchingSettings:
    """The matching settings with the limits of a texture case; "own" leaves them unchanged."""
    if texture == "own":
        return matching
    case = CASES[texture]
    return replace(
        matching,
        max_sigma0=case.max_sigma0,
        max_sigma_px=case.max_sigma_px,
        max_shift_px=case.max_shift_px,
        min_correlation=case.min_correlation,
    )


def voronoi_scan(
    views: Views,
    grid: TemplateGrid,
    seeds: Approximations,
    matching: MatchingSettings,
    growing: GrowingSettings,
    *,
    foreground: Foreground,
    monitor: Monitor,
) -> MatchedField:
    """The matched field by scanning the Voronoi regions of the seeds. Arguments and result as of `region_growing.grow_regions`.

    Only points that the foreground allows, and whose rays meet, are accepted.
    """
    settings = limits_of(growing.texture, matching)
    cells, first = np.unique(grid.nearest(seeds.xy[:, views.reference]), return_index=True)
    scans = []
    for k in views.search:
        one = _Scan(views.template, views.images[k], grid, cells, settings, monitor)
        step = grid.xy(cells) - seeds.xy[first, views.reference]
        shape = seeds.shape[first, k]
        one.begin(seeds.xy[first, k] + np.einsum("nij,nj->ni", shape, step), shape)
        one.cover()
        one.close_holes()
        for _ in range(FILTER_PASSES):
            one.filter_and_repeat()
        scans.append(one)
    return _merged(scans, views, grid, growing, foreground)


class _Scan:
    """The scan of one search image: the state of every cell of the grid."""

    def __init__(
        self, template: SplineImage, image: SplineImage, grid: TemplateGrid, seeds: np.ndarray, settings: MatchingSettings, monitor: Monitor
    ) -> None:
        from scipy.spatial import cKDTree

        n = grid.shape[0] * grid.shape[1]
        self._template, self._image, self._grid, self._settings, self._monitor = template, image, grid, settings, monitor
        self._seeds = seeds
        every = np.arange(n)
        self._region = cKDTree(grid.xy(seeds) * (1, grid.rows.step)).query(grid.xy(every) * (1, grid.rows.step))[1] if len(seeds) else every
        self.found, self.tried = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        self.centre, self.xy, self.offset, self.spread = (np.zeros((n, 2)) for _ in range(4))
        self.shape, self.covariance = np.zeros((n, 2, 2)), np.zeros((n, 2, 2))
        self.correlation = np.zeros(n)

    def begin(self, start: np.ndarray, shape: np.ndarray) -> None:
        """Match the seeds themselves."""
        self._try(self._seeds, start, shape)

    def cover(self) -> None:
        """Shift horizontally, then vertically, from all matched cells, until the regions are covered."""
        fresh, directions = np.flatnonzero(self.found), HORIZONTAL
        idle = 0
        while idle < 2:
            begun = self.found.copy()
            self._run(fresh, directions)
            new = self.found & ~begun
            fresh = np.flatnonzero(self.found)
            directions = VERTICAL if directions is HORIZONTAL else HORIZONTAL
            idle = 0 if new.any() else idle + 1

    def close_holes(self) -> None:
        """Match the open cells from all directions around, across the regions' boundaries; the best result is taken."""
        while True:
            before = self.found.copy()
            cells, parents = self._pairs(np.flatnonzero(self.found), AROUND, within=False)
            open_ = ~self.found[cells]
            self._best(cells[open_], parents[open_])
            if (self.found & ~before).sum() < max(1, HOLES_CLOSED * before.sum()):
                return

    def filter_and_repeat(self) -> None:
        """Remove points whose affine parameters differ from their neighbours', and match them again from those."""
        cell = np.flatnonzero(self.found)
        moved = self.centre[cell] - self._grid.xy(cell)
        parameters = np.concatenate([self.shape[cell].reshape(-1, 4), self._local_shift(cell, moved)], axis=1)
        removed = cell[unlike_neighbours(self._grid, cell, parameters, sigmas=FILTER_SIGMAS, least=FILTER_LEAST)]
        self.found[removed] = False
        cells, parents = self._pairs(np.flatnonzero(self.found), AROUND, within=False)
        again = np.isin(cells, removed)
        self._best(cells[again], parents[again])

    def _local_shift(self, cell: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Parallax (N, 2) less the mean of the predictions (1) from the neighbours."""
        neighbour = self._grid.neighbours(cell, cell, radius=1, itself=False)
        valid = (neighbour >= 0)[..., None]
        at = self._grid.xy(cell)
        A = self.shape[cell][neighbour] - np.eye(2)
        predicted = moved[neighbour] + np.einsum("nmij,nmj->nmi", A, at[:, None] - at[neighbour])
        mean = np.where(valid, predicted, 0.0).sum(axis=1) / np.maximum(valid.sum(axis=1), 1)
        return np.where(valid.any(axis=1), moved - mean, 0.0)

    def _run(self, heads: np.ndarray, directions: np.ndarray) -> None:
        """Advance all heads in these directions, cell by cell, until each reaches its region's boundary, a tried cell, or fails."""
        for direction in directions:
            at = heads
            while len(at):
                self._monitor.step("surface", float(self.found.sum()), len(self.found))
                cells, parents = self._pairs(at, direction[None], within=True)
                open_ = ~self.tried[cells]
                at = self._from_parents(cells[open_], parents[open_])

    def _pairs(self, parents: np.ndarray, directions: np.ndarray, *, within: bool) -> tuple[np.ndarray, np.ndarray]:
        """The neighbours of cells in some directions, and the cell that each belongs to; `within` their region only."""
        gh, gw = self._grid.shape
        i, j = (parents % gw)[:, None] + directions[:, 0], (parents // gw)[:, None] + directions[:, 1]
        usable = ((i >= 0) & (i < gw) & (j >= 0) & (j < gh)).ravel()
        cells, owners = (j * gw + i).ravel()[usable], np.repeat(parents, len(directions))[usable]
        if within:
            inside = self._region[cells] == self._region[owners]
            cells, owners = cells[inside], owners[inside]
        return cells, owners

    def _from_parents(self, cells: np.ndarray, parents: np.ndarray) -> np.ndarray:
        """Match cells from their neighbours (one each), with the retries as published; returns the matched cells."""
        cells, first = np.unique(cells, return_index=True)
        parents = parents[first]
        good = self._try(cells, *self._start(cells, parents))
        again, parents = cells[~good], parents[~good]
        half = self._half_way(again, parents)
        if half is not None:
            good = self._try(again, *half)
            again, parents = again[~good], parents[~good]
        for bigger in BIGGER_PX:
            good = self._try(again, *self._start(again, parents), patch_px=self._settings.patch_px + bigger)
            again, parents = again[~good], parents[~good]
        return cells[self.found[cells]]

    def _start(self, cells: np.ndarray, parents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        step = self._grid.xy(cells) - self._grid.xy(parents)
        return self.centre[parents] + np.einsum("nij,nj->ni", self.shape[parents], step), self.shape[parents]  # (1)

    def _half_way(self, cells: np.ndarray, parents: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Starts of cells from a match half-way to them: the smaller shift."""
        if not len(cells):
            return None
        start, shape = self._start(cells, parents)
        half = 0.5 * (self._grid.xy(cells) - self._grid.xy(parents))
        m = self._match(self._grid.xy(parents) + half, start - np.einsum("nij,nj->ni", shape, half), shape, self._settings)
        onward = m.xy + np.einsum("nij,nj->ni", m.shape, half)
        return np.where(m.ok[:, None], onward, np.nan), np.where(m.ok[:, None, None], m.shape, shape)

    def _match(self, xy: np.ndarray, start: np.ndarray, shape: np.ndarray, settings: MatchingSettings) -> Matches:
        template = TemplatePoints(image=self._template, xy=xy, row_step=self._grid.rows.step)
        return match_patches(template, [SearchImage(image=self._image, start=start, shape=shape)], settings)[0]

    def _try(self, cells: np.ndarray, start: np.ndarray, shape: np.ndarray, *, patch_px: int | None = None) -> np.ndarray:
        """Match cells from these starts and store the good matches; returns which (n,) are good."""
        if not len(cells):
            return np.zeros(0, dtype=bool)
        settings = self._settings if patch_px is None else replace(self._settings, patch_px=patch_px)
        m = self._match(self._grid.xy(cells), start, shape, settings)
        self.tried[cells] = True
        self._store(cells[m.ok], m, m.ok)
        return m.ok

    def _best(self, cells: np.ndarray, parents: np.ndarray) -> None:
        """Match every pair of a cell and a neighbour; of each cell the result with the smallest variance is stored."""
        self._monitor.step("surface", float(self.found.sum()), len(self.found))
        if not len(cells):
            return
        m = self._match(self._grid.xy(cells), *self._start(cells, parents), self._settings)
        order = np.lexsort((np.trace(m.covariance, axis1=1, axis2=2), ~m.ok, cells))
        unique, first = np.unique(cells[order], return_index=True)
        rows = order[first]
        good = m.ok[rows]
        self._store(unique[good], m, rows[good])

    def _store(self, cells: np.ndarray, m: Matches, rows: np.ndarray) -> None:
        self.found[cells] = True
        self.centre[cells], self.xy[cells], self.shape[cells] = m.xy[rows], m.transfer_xy[rows], m.shape[rows]
        self.covariance[cells], self.correlation[cells] = m.transfer_covariance[rows], m.correlation[rows]
        self.offset[cells], self.spread[cells] = m.offset[rows], m.spread[rows]


def unlike_neighbours(grid: TemplateGrid, cell: np.ndarray, parameters: np.ndarray, *, sigmas: float, least: np.ndarray) -> np.ndarray:
    """(N,) points one of whose `parameters` (N, Q) differs from its neighbours' median by more than `sigmas` robust deviations.

    `least` (Q,) are the smallest deviations that count as a standard deviation. A point with fewer than three neighbours is not judged.
    """
    neighbour = grid.neighbours(cell, cell, itself=False)
    valid = neighbour >= 0
    bad = np.zeros(len(cell), dtype=bool)
    for q in range(parameters.shape[1]):
        z = np.where(valid, parameters[neighbour, q], np.nan)
        middle = masked_median(np.nan_to_num(z), valid)
        deviation = mad_sigma(np.nan_to_num(z) - middle[:, None], 1, valid)
        bad |= np.abs(parameters[:, q] - middle) > sigmas * np.maximum(deviation, least[q])
    return bad & (valid.sum(axis=1) >= FILTER_NEIGHBOURS)


def _merged(scans: Sequence[_Scan], views: Views, grid: TemplateGrid, growing: GrowingSettings, foreground: Foreground) -> MatchedField:
    """The cells found in as many search images as are required, intersected."""
    cameras, reference = views.cameras, views.reference
    count = np.sum([s.found for s in scans], axis=0)
    cell = np.flatnonzero(count >= views.required_matches(growing.pairs))
    n = len(cell)
    xy, (shape, K) = np.full((n, len(cameras), 2), np.nan), (np.tile(np.eye(2), (n, len(cameras), 1, 1)) for _ in range(2))
    matched = np.stack([s.found[cell] for s in scans])
    offset = np.sum([s.offset[cell] * f[:, None] for s, f in zip(scans, matched)], axis=0) / count[cell, None]
    xy[:, reference], shape[:, reference], K[:, reference] = grid.xy(cell) + offset, np.eye(2), np.eye(2) * TEMPLATE_SIGMA_PX**2
    for k, s, found in zip(views.search, scans, matched):
        # a bigger patch has another centre of gravity: the images of the same template point are intersected
        xy[:, k] = s.xy[cell] + np.einsum("nij,nj->ni", s.shape[cell], offset - s.offset[cell])
        xy[~found, k] = np.nan
        shape[:, k], K[:, k] = s.shape[cell], s.covariance[cell]
    point = forward_intersection(cameras, grid.rows.to_frame(xy), grid.rows.covariance_to_frame(K))
    typical = float(np.nanmedian(point.rms_residual_px)) if n else 0.0
    limit_px = max(growing.max_residual_px, min(SEED_MEDIANS * typical, MAX_LIMIT_PX))  # a poor rig must not lose its points
    field = MatchedField(
        grid=grid,
        cell=cell,
        xy=xy,
        shape=shape,
        covariance=K,
        correlation=np.min([np.where(f, s.correlation[cell], 1.0) for s, f in zip(scans, matched)], axis=0),
        xyz_m=point.xyz_m,
        covariance_m2=point.covariance_m2,
        residual_px=point.rms_residual_px,
        sigma0=point.sigma0,
        spread=np.stack([s.spread[cell] for s in scans])[matched.argmax(axis=0), np.arange(n)],
        smoothed=np.zeros(n, dtype=bool),
        extended=np.zeros(n, dtype=bool),
        tried=int(np.any([s.tried for s in scans], axis=0).sum()),
        limit_px=limit_px,
    )
    near, far = foreground.depth_range_m
    depth = views.base.to_camera(point.xyz_m)[:, 2]
    with np.errstate(invalid="ignore"):
        good = (depth >= near) & (depth <= far) & (field.residual_px <= limit_px)
        return field.select(good & ~foreground.excludes(point.xyz_m, point.covariance_m2))
