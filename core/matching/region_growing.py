"""Region growing: dense matching from seeds, whole fronts of points at a time.

As published (D'Apuzzo et al. 2000, §2.2) the reference image is the template, a point's start is its matched neighbour shifted with the
neighbour's shape, and failed points are tried again from other neighbours. Here the neighbours of accepted points join the patches at work,
and a point is accepted only if enough views match it, its rays meet, and its depth continues that of its neighbour:

    start_k(p + δ) = x_k(p) + A_k(p) δ                                                    (1)
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import count, product
from typing import Any

import numpy as np

from ..foundation.arrays import concatenated, select_rows
from ..foundation.progress import Monitor
from ..foundation.settings import knob
from ..geometry.camera import Camera
from ..geometry.intersection import Intersection, chi2_limit, forward_intersection
from .foreground import Foreground
from .least_squares import Matches, Matching, MatchingSettings, PatchTemplates, SearchImage, TemplatePoints, match_patches
from .seeds import Approximations
from .views import TemplateGrid, Views

NEIGHBOURS = np.array([(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dx or dy])
TEMPLATE_SIGMA_PX = 0.02  # px, of the template point itself, so that the adjustment can move it
NOISE_SIGMAS = 4.0  # sigmas of a depth by which it may differ from its parent's, beyond the steepest slope
EQUAL_SIGMA_PX = 1.0  # px, far above matching's own: all rays have the same weight
PATCH_STEP_PX = 4  # px by which the patch grows from round to round
SMOOTHED_FROM_LEVEL = 2  # rounds of larger patches, from which on the images are smoothed
AT_WORK = 0.5  # share of the patches at work with which the next front begins
NARROW = -1  # level of the last round: fingers, and what shows next to an outline, are narrower than the patch
SMALLEST_PATCH_PX = 5  # px, side of a patch
NARROW_SIGMA_SHARE = 0.5  # of the largest sigma, in the last round: few pixels must have much texture
RETRY_SMOOTHING_PX = 1.0  # px, sigma of the Gaussian: what fails is weak texture, and noise finer than its details is removed
LOOSE_SIGMA = 4.0  # times the largest sigma: on skin calibrated sigmas are up to four times JᵀWJ's
LOOSE_CORRELATION = 0.15  # below the smallest correlation: weak texture is little more than the noise
LARGEST_PATCH_M = 0.03  # m on the surface
SEED_MEDIANS = 3.0  # medians of the seeds' residuals that a residual may reach
MAX_LIMIT_PX = 2.5  # px, and never more than this
OF_FIELD = ("grid", "tried", "limit_px", "rig_sigma_px", "weak_texture")  # of a whole `MatchedField`; the others are arrays of points


@dataclass(frozen=True, kw_only=True, slots=True)
class GrowingSettings:
    """How the surface is covered with points."""

    method: str = knob(
        "fronts",
        "How the surface is covered: by region growing (fronts), or by the published scan of the seeds' Voronoi regions.",
        choices=("fronts", "published"),
    )
    texture: str = knob(
        "clothing",
        "Quality limits of the published scan: those for a level of texture, or those of the matching settings (own).",
        choices=("strong", "clothing", "skin", "own"),
    )
    spacing_px: int = knob(4, "Distance between measured points in the reference image.", unit="px", low=1, high=32)
    seed_spacing_px: int = knob(
        24,
        "Distance between the points at which automatic seeds are searched for; 0: none, the surface starts from clicks.",
        unit="px",
        low=0,
        high=128,
    )
    attempts: int = knob(3, "How often a point is tried, each time from another neighbour.", low=1, high=8)
    bigger_patches: int = knob(
        5,
        "Rounds in which failed points are tried again with patches 4 px larger, from the second on in smoothed images; "
        "fewer where a pixel covers much of the body.",
        low=0,
        high=5,
    )
    max_residual_px: float = knob(
        0.7,
        "Largest RMS distance by which rays may miss each other; three times the seeds' median where that is more.",
        unit="px",
        low=0.05,
        high=10.0,
    )
    max_ray_sigma0: float = knob(  # the χ² test removes 2 % more points, of which hardly any are wrong
        3.0,
        "Largest distance by which rays may miss each other, in units of its sigma; 0: a χ² test at 99.9 % for their number.",
        low=0.0,
        high=100.0,
    )
    pairs: bool = knob(False, "Accept points matched in two views only; the cloud records the number of rays of each point.")
    max_slope: float = knob(3.0, "Steepest surface, as change of depth per distance across the line of sight.", low=0.5, high=20.0)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MatchedField:
    """The points that were matched, one row per accepted cell of the grid. Rows' pixels, metres; NaN in views without a match."""

    grid: TemplateGrid
    cell: np.ndarray  # (N,) flat cell numbers, ascending
    xy: np.ndarray  # (N, K, 2) the texture's centre of gravity in every view
    shape: np.ndarray  # (N, K, 2, 2)
    covariance: np.ndarray  # (N, K, 2, 2) of xy
    correlation: np.ndarray  # (N,) the smallest over the views
    xyz_m: np.ndarray  # (N, 3)
    covariance_m2: np.ndarray  # (N, 3, 3)
    residual_px: np.ndarray  # (N,) RMS distance between the image points and the projections of the intersection
    sigma0: np.ndarray  # (N,) of the intersection
    spread: np.ndarray  # (N, 2) variance of the texture's energy in the patch of the reference view
    smoothed: np.ndarray  # (N,) matched in the smoothed images only
    extended: np.ndarray  # (N,) measured from the surface of the neighbours, where texture is weak (`extension`)
    tried: int  # how many cells were tried
    limit_px: float  # the residual that was allowed
    rig_sigma_px: float = 0.0  # the calibration's own error, as the constraint found it
    weak_texture: bool = False  # the patches' sigmas are large, as the constraint found

    def matched_in(self, views: Sequence[int]) -> np.ndarray:
        """(N, S) in which of some views the points are matched."""
        return np.ascontiguousarray(np.isfinite(self.xy).all(axis=2)[:, views])

    def select(self, rows: np.ndarray) -> "MatchedField":
        """The field with only these rows (a mask or indices)."""
        chosen: dict[str, Any] = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name not in OF_FIELD}
        return replace(self, **chosen)

    def joined(self, other: "MatchedField") -> "MatchedField":
        """The field with the rows of another one of the same grid, in the order of the cells."""
        order = np.argsort(np.concatenate([self.cell, other.cell]), kind="stable")
        names = [f.name for f in fields(self) if f.name not in OF_FIELD]
        both: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)])[order] for name in names}
        return replace(self, **both)


class _Cells:
    """The state of every cell of the grid while the field grows."""

    def __init__(self, grid: TemplateGrid, views: int) -> None:
        cells = grid.shape[0] * grid.shape[1]
        self.grid = grid
        self.centre = np.zeros((cells, views, 2))  # of the patches; the starts of the neighbours follow from it
        self.xy = np.full((cells, views, 2), np.nan)
        self.shape = np.zeros((cells, views, 2, 2))
        self.covariance = np.zeros((cells, views, 2, 2))
        self.correlation, self.residual, self.sigma0 = np.zeros(cells), np.zeros(cells), np.zeros(cells)
        self.spread = np.zeros((cells, 2))
        self.smoothed = np.zeros(cells, dtype=bool)
        self.xyz, self.covariance_m2 = np.zeros((cells, 3)), np.zeros((cells, 3, 3))
        self.accepted, self.tried = np.zeros(cells, dtype=bool), np.zeros(cells, dtype=bool)
        self.attempts = np.zeros(cells, dtype=np.int16)  # of this round
        self.moving = np.zeros(cells, dtype=bool)  # at work now
        self.began, self.when = np.full((2, cells), -1)  # the step of the round at which the last attempt began, and that of acceptance

    def begin(self, front: "Front", step: int) -> None:
        """The cells of a front are tried now."""
        self.attempts[front.cell] += 1
        self.tried[front.cell] = self.moving[front.cell] = True
        self.began[front.cell] = step

    def restart(self) -> None:
        """Begin a round: every cell may be tried anew."""
        self.attempts[:], self.began[:], self.when[:] = 0, -1, -1

    def accept(self, front: "Front", measured: "_Measured", views: Views, step: int) -> None:
        """Store what was measured at the cells of a front."""
        cell, reference, matched, point = front.cell, views.reference, measured.matched, measured.point
        xy = self.grid.xy(cell)
        self.accepted[cell], self.when[cell] = True, step
        self.centre[cell, reference], self.xy[cell, reference] = xy, xy + matched[0].offset
        self.shape[cell] = front.shape  # also in views that are not matched
        self.shape[cell, reference], self.spread[cell] = np.eye(2), matched[0].spread
        self.covariance[cell, reference] = np.eye(2) * TEMPLATE_SIGMA_PX**2
        for k, m in zip(views.search, matched):
            # in a view where the match failed, neighbours start from the point's projection, with the shape predicted there
            projected = views.rows.from_frame(views.cameras[k].project(point.xyz_m))
            self.centre[cell, k] = np.where(m.ok[:, None], m.xy, projected)
            self.xy[cell, k] = np.where(m.ok[:, None], m.transfer_xy, np.nan)
            self.shape[cell, k] = np.where(m.ok[:, None, None], m.shape, front.shape[:, k])
            self.covariance[cell, k] = m.transfer_covariance
        self.correlation[cell] = np.min([np.where(m.ok, m.correlation, 1.0) for m in matched], axis=0)
        self.xyz[cell], self.covariance_m2[cell] = point.xyz_m, point.covariance_m2
        self.residual[cell], self.sigma0[cell] = point.rms_residual_px, point.sigma0

    def next_front(self, fresh: np.ndarray, failed: np.ndarray, attempts: int, base: Camera) -> "Front":
        """The open neighbours of freshly accepted cells, and failed cells with a new neighbour: the predictions (1) of these parents."""
        cell, parent = self._to_try(fresh, failed, attempts)
        step = self.grid.xy(cell) - self.grid.xy(parent)
        start = self.centre[parent] + np.einsum("nkij,nj->nki", self.shape[parent], step)  # (1)
        return Front(cell=cell, start=start, shape=self.shape[parent], parent_depth_m=base.to_camera(self.xyz[parent])[:, 2])

    def _to_try(self, fresh: np.ndarray, failed: np.ndarray, attempts: int) -> tuple[np.ndarray, np.ndarray]:
        """Open cells next to the fresh ones, and failed ones, each with its best parent (smallest variance) that is new to it."""
        (parents, cells), (retried, beside) = self._pairs(fresh), self._pairs(failed)
        cells, parents = np.concatenate([cells, retried]), np.concatenate([parents, beside])
        good = ~(self.accepted | self.moving)[cells] & (self.attempts[cells] < attempts)
        good &= self.accepted[parents] & (self.when[parents] >= self.began[cells])
        cells, parents = cells[good], parents[good]
        quality = np.trace(self.covariance_m2[parents], axis1=1, axis2=2)
        order = np.lexsort((parents, quality, cells))
        cells, first = np.unique(cells[order], return_index=True)
        return cells, parents[order][first]

    def _pairs(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cells with each of their neighbours in the grid."""
        gh, gw = self.grid.shape
        i = (cells % gw)[:, None] + NEIGHBOURS[:, 0]
        j = (cells // gw)[:, None] + NEIGHBOURS[:, 1]
        there = (i >= 0) & (i < gw) & (j >= 0) & (j < gh)
        return np.repeat(cells, len(NEIGHBOURS))[there.ravel()], (j * gw + i)[there]

    def field(self, limit_px: float) -> MatchedField:
        """The accepted cells."""
        cell = np.flatnonzero(self.accepted)
        return MatchedField(
            grid=self.grid,
            cell=cell,
            xy=self.xy[cell],
            shape=self.shape[cell],
            covariance=self.covariance[cell],
            correlation=self.correlation[cell],
            xyz_m=self.xyz[cell],
            covariance_m2=self.covariance_m2[cell],
            residual_px=self.residual[cell],
            sigma0=self.sigma0[cell],
            spread=self.spread[cell],
            smoothed=self.smoothed[cell],
            extended=np.zeros(len(cell), dtype=bool),
            limit_px=limit_px,
            tried=int(self.tried.sum()),
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Front:
    """Cells that are matched next, and what their parents predict for them."""

    cell: np.ndarray  # (n,) flat cell numbers
    start: np.ndarray  # (n, K, 2) (1), rows' pixels
    shape: np.ndarray  # (n, K, 2, 2)
    parent_depth_m: np.ndarray  # (n,) depth that the point should continue; NaN for seeds, which have no parent


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Measured:
    """The points of a front: matches in every search view, and where their rays meet."""

    matched: list[Matches]
    point: Intersection
    depth_m: np.ndarray  # (n,) in the reference camera

    def select(self, rows: np.ndarray) -> "_Measured":
        """Only these rows (a mask)."""
        return _Measured(
            matched=[select_rows(m, rows) for m in self.matched], point=select_rows(self.point, rows), depth_m=self.depth_m[rows]
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Round:
    """One pass over the image: which images and patches are matched, and how many views must match."""

    views: Views
    matching: MatchingSettings
    pairs: bool
    smoothed: bool


def matched_seeds(views: Views, grid: TemplateGrid, seeds: Approximations, matching: MatchingSettings) -> int:
    """How many of the seeds match in as many views as are required."""
    front = _seed_front(grid, seeds, views.reference)
    first = _measure(views, grid.xy(front.cell), front, matching, EQUAL_SIGMA_PX, pairs=False)
    return int(_enough(first.matched, views.required_matches(False)).sum())


def grow_regions(
    views: Views,
    grid: TemplateGrid,
    seeds: Approximations,
    matching: MatchingSettings,
    growing: GrowingSettings,
    *,
    foreground: Foreground,
    monitor: Monitor,
) -> MatchedField:
    """Grow the field from the seeds until no neighbour can be matched; again with larger patches, and finally with a smaller one.

    A point needs three rays, or both where there are two views; with `pairs`, two rays are enough for cells that are still open then.
    Only points that the foreground allows are accepted.
    """
    seed_front = _seed_front(grid, seeds, views.reference)
    first = _measure(views, grid.xy(seed_front.cell), seed_front, matching, EQUAL_SIGMA_PX, pairs=False)
    growth = _Growth(views, grid, growing, first, foreground, monitor)
    larger = rounds_of_larger_patches(matching, growing, first.depth_m, views.base)
    levels = (*range(larger + 1), NARROW)
    for pairs, level in product((False, True) if growing.pairs and len(views.search) > 1 else (False,), levels):
        growth.run(_round(views, matching, level, pairs), seed_front, with_seeds=level == 0, restart=bool(level or pairs))
    return growth.cells.field(growth.limit_px)


def _round(views: Views, matching: MatchingSettings, level: int, pairs: bool) -> _Round:
    """The round with patches `level` steps larger than those set; NARROW is the one with smaller patches."""
    settings = replace(matching, patch_px=max(SMALLEST_PATCH_PX, matching.patch_px + PATCH_STEP_PX * level))
    smoothed = level >= SMOOTHED_FROM_LEVEL
    if level == NARROW:
        settings = replace(settings, max_sigma_px=NARROW_SIGMA_SHARE * settings.max_sigma_px)
    if smoothed:
        settings, views = loosened(settings), views.smoothed(RETRY_SMOOTHING_PX)
    return _Round(views=views, matching=settings, pairs=pairs, smoothed=smoothed)


class _Growth:
    """The growth of one field: its cells, and the limits that the seeds' residuals set."""

    def __init__(
        self, views: Views, grid: TemplateGrid, growing: GrowingSettings, seeds: _Measured, foreground: Foreground, monitor: Monitor
    ) -> None:
        self._base, self._grid, self._growing, self._foreground, self._monitor = views.base, grid, growing, foreground, monitor
        self.cells = _Cells(grid, len(views.cameras))
        self.limit_px, self._rig_sigma_px = _rig_quality(seeds.matched, seeds.point, growing)

    def run(self, this: _Round, seeds: Front, *, with_seeds: bool, restart: bool) -> None:
        """One round: from the seeds, or, on a `restart`, from everything accepted so far.

        The neighbours of accepted points are tried as soon as half of the patches at work are matched; the slow ones go on beside them.
        """
        cells, attempts, front, views = self.cells, self._growing.attempts, seeds, this.views
        none, required = np.zeros(0, dtype=np.int64), views.required_matches(this.pairs)
        if restart:
            cells.restart()
            front = cells.next_front(np.flatnonzero(cells.accepted), none, attempts, self._base)
            front = _joined(cells, seeds, front) if with_seeds else front
        matching = Matching([views.images[k] for k in views.search], this.matching, required)
        at_work = select_rows(front, none)
        for step in count():
            if len(front.cell):
                cells.begin(front, step)
                at_work = concatenated([at_work, front])
                template = TemplatePoints(image=views.template, xy=self._grid.xy(front.cell), row_step=views.rows.step)
                start, shape = front.start[:, views.search].swapaxes(0, 1), front.shape[:, views.search].swapaxes(0, 1)
                matching.add(PatchTemplates(template, this.matching), start, shape)
            if not len(at_work.cell):
                break
            self._monitor.step("surface", int(cells.accepted.sum()), len(cells.accepted))
            matching.advance(AT_WORK)
            done, matched = matching.take()
            front, at_work = select_rows(at_work, done), select_rows(at_work, ~done)
            cells.moving[front.cell] = False
            measured = _intersected(views, self._grid.xy(front.cell), matched, self._rig_sigma_px, required)
            good = self._acceptable(measured, front.parent_depth_m, required)
            accepted = select_rows(front, good)
            cells.accept(accepted, measured.select(good), views, step)
            cells.smoothed[accepted.cell] = this.smoothed
            front = cells.next_front(accepted.cell, front.cell[~good], attempts, self._base)

    def _acceptable(self, measured: _Measured, parent_depth_m: np.ndarray, matches: int) -> np.ndarray:
        """(n,) which points have enough matches, rays that meet, a depth that continues their parent's, and lie in the foreground."""
        growing, point, depth = self._growing, measured.point, measured.depth_m
        near, far = self._foreground.depth_range_m
        sigma = np.sqrt(np.nan_to_num(np.trace(point.covariance_m2, axis1=1, axis2=2), nan=0.0))
        across = depth * self._grid.spacing_px * np.sqrt(2) / self._base.focal_px
        with np.errstate(invalid="ignore"):  # NaN depths of seeds' parents pass
            continues = ~(np.abs(depth - parent_depth_m) > growing.max_slope * across + NOISE_SIGMAS * sigma)
            return (
                _enough(measured.matched, matches)
                & (point.rms_residual_px <= self.limit_px)
                & (point.sigma0 <= (growing.max_ray_sigma0 or chi2_limit(point.rays)))
                & (depth >= near)
                & (depth <= far)
                & continues
                & ~self._foreground.excludes(point.xyz_m, point.covariance_m2)
            )


def loosened(matching: MatchingSettings) -> MatchingSettings:
    """The settings with the limits for matches whose sigmas are calibrated."""
    min_correlation = max(0.0, matching.min_correlation - LOOSE_CORRELATION)
    return replace(matching, max_sigma_px=LOOSE_SIGMA * matching.max_sigma_px, min_correlation=min_correlation)


def rounds_of_larger_patches(matching: MatchingSettings, growing: GrowingSettings, depth_m: np.ndarray, camera: Camera) -> int:
    """How many rounds of larger patches follow: as many as are set, but from the second on none wider than LARGEST_PATCH_M on the body.

    A limb is round; over a wider patch its surface turns away.
    """
    if not np.isfinite(depth_m).any():
        return 0
    across_px = LARGEST_PATCH_M * camera.focal_px / float(np.nanmedian(depth_m))
    return int(np.clip((across_px - matching.patch_px) // PATCH_STEP_PX, min(1, growing.bigger_patches), growing.bigger_patches))


def _rig_quality(matched: Sequence[Matches], seeds: Intersection, growing: GrowingSettings) -> tuple[float, float]:
    """The residual to allow, and the sigma of an image point that the rig and the affine patch add to matching, both from the seeds.

    A rig whose rays miss each other by 0.6 px everywhere must not lose its points for that, and its sigmas must contain it: with K equally
    weighted rays the mean square residual is σ² (2 K − 3) / K, of which matching explains its own part.
    """
    finite = np.isfinite(seeds.rms_residual_px)
    if not finite.any():
        return growing.max_residual_px, 0.0
    typical = float(np.median(seeds.rms_residual_px[finite]))
    rays = float(np.median(seeds.rays[finite]))
    explained = float(np.median(np.concatenate([np.trace(m.transfer_covariance[finite & m.ok], axis1=1, axis2=2) / 2 for m in matched])))
    unexplained = typical**2 * rays / (2 * rays - 3) - explained
    return max(growing.max_residual_px, min(SEED_MEDIANS * typical, MAX_LIMIT_PX)), float(np.sqrt(max(0.0, unexplained)))


def _joined(cells: _Cells, seeds: Front, front: Front) -> Front:
    """The seeds that are not yet accepted, and the rest of a front."""
    fresh = ~cells.accepted[seeds.cell]
    rest = ~np.isin(front.cell, seeds.cell[fresh])
    return concatenated([select_rows(seeds, fresh), select_rows(front, rest)])


def _seed_front(grid: TemplateGrid, seeds: Approximations, reference: int) -> Front:
    """The seeds moved to their nearest cells, one per cell."""
    cell = grid.nearest(seeds.xy[:, reference])
    cell, first = np.unique(cell, return_index=True)
    step = grid.xy(cell) - seeds.xy[first, reference]
    start = seeds.xy[first] + np.einsum("nkij,nj->nki", seeds.shape[first], step)
    return Front(cell=cell, start=start, shape=seeds.shape[first], parent_depth_m=np.full(len(cell), np.nan))


def _measure(views: Views, xy: np.ndarray, front: Front, matching: MatchingSettings, rig_sigma_px: float, *, pairs: bool) -> _Measured:
    """Match a front's points `xy` (n, 2) in every search view and intersect; `rig_sigma_px` is added to every image point's covariance."""
    template = TemplatePoints(image=views.template, xy=xy, row_step=views.rows.step)
    searches = [SearchImage(image=views.images[k], start=front.start[:, k], shape=front.shape[:, k]) for k in views.search]
    required = views.required_matches(pairs)
    return _intersected(views, xy, match_patches(template, searches, matching, needed=required), rig_sigma_px, required)


def _intersected(views: Views, xy: np.ndarray, matched: list[Matches], rig_sigma_px: float, required: int) -> _Measured:
    """The points `xy` (n, 2) of the template at the intersection of their rays, where enough views match them."""
    image_xy = np.full((len(xy), len(views.cameras), 2), np.nan)
    rig = np.diag([1.0, 1 / views.rows.step**2]) * rig_sigma_px**2
    K = np.tile(np.eye(2) * TEMPLATE_SIGMA_PX**2 + rig, (len(xy), len(views.cameras), 1, 1))
    image_xy[:, views.reference] = xy + matched[0].offset
    for k, m in zip(views.search, matched):
        image_xy[m.ok, k] = m.transfer_xy[m.ok]
        K[m.ok, k] = m.transfer_covariance[m.ok] + rig
    image_xy[~_enough(matched, required)] = np.nan
    point = forward_intersection(views.cameras, views.rows.to_frame(image_xy), views.rows.covariance_to_frame(K))
    return _Measured(matched=matched, point=point, depth_m=views.base.to_camera(point.xyz_m)[:, 2])


def _enough(matched: Sequence[Matches], required: int) -> np.ndarray:
    """(N,) whether as many views match the point as are required."""
    return np.asarray(np.sum([m.ok for m in matched], axis=0) >= required)
