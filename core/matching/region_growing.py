"""Dense matching: from seeds to a field of triplets, whole fronts of points at a time.

As published (D'Apuzzo et al. 2000, §2.2) the centre image is the template, a point's start is its matched neighbour shifted with the
neighbour's shape, and what fails is tried again from other neighbours. Here the neighbours of all points that were just accepted form one
array, and a point is accepted only when enough views find it, its rays meet, and its depth continues that of its neighbour:

    start_k(p + δ) = x_k(p) + A_k(p) δ                                                    (1)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.special import gammaincinv

from ..foundation.progress import Monitor
from ..foundation.settings import knob
from ..foundation.threads import in_threads
from ..geometry.camera import Camera
from ..geometry.intersection import Intersection, forward_intersection
from ..images.sampling import SplineImage
from .foreground import Foreground
from .grid import TemplateGrid
from .least_squares import Matches, MatchingSettings, match_patches
from .seeds import Approximations, fewest_views

NEIGHBOURS = np.array([(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dx or dy])
TEMPLATE_SIGMA_PX = 0.02  # of the template point itself, so that it may move along with the adjustment
NOISE_SIGMAS = 4.0
EQUAL_SIGMA_PX = 1.0  # far above matching's own: all rays weigh alike
PATCH_STEP_PX = 4
SMOOTH_FROM = 2
RAY_TEST = 0.999
NARROW = -1  # the last round: fingers, and what shows beside an outline, are narrower than the patch
SMALLEST_PX, NARROW_SURE = 5, 0.5  # px; of the largest sigma: few pixels must have much texture
RETRY_SMOOTHING_PX = 1.0  # what fails is weak texture: noise that is finer than its details is kept out
# Limits where sigmas are honest, on skin up to four times the naive one, and the texture is little more than the noise.
LESS_SURE, LESS_ALIKE = 4.0, 0.15
LARGEST_PATCH_M = 0.03
SEED_MEDIANS, MAX_LIMIT_PX = 3.0, 2.5


@dataclass(frozen=True, kw_only=True, slots=True)
class GrowingSettings:
    """How the surface is covered with points."""

    method: str = knob(
        "fronts",
        "How the surface is covered: whole fronts of points at a time, or the published scan over the seeds' regions.",
        choices=("fronts", "published"),
    )
    texture: str = knob(
        "clothing",
        "Quality limits of the published scan: those of a level of texture, or the ones set for matching (own).",
        choices=("strong", "clothing", "skin", "own"),
    )
    spacing_px: int = knob(4, "Distance between measured points in the reference image.", unit="px", low=1, high=32)
    seed_spacing_px: int = knob(24, "Distance between the points at which seeds are looked for.", unit="px", low=4, high=128)
    attempts: int = knob(3, "How often a point is tried from different neighbours.", low=1, high=8)
    bigger_patches: int = knob(
        5,
        "Rounds in which what failed is tried again with a patch 4 px larger, from the second on smoothed; fewer where pixels are large.",
        low=0,
        high=5,
    )
    max_residual_px: float = knob(
        0.7,
        "Largest distance by which rays may miss; if half of the seeds miss by more, three times their median.",
        unit="px",
        low=0.05,
        high=10.0,
    )
    max_ray_sigma0: float = knob(  # χ² removes 2 % more points, hardly any of them wrong
        3.0,
        "Largest distance by which rays may miss, in units of its own sigma; 0: the χ² test at 99.9 % for their number.",
        low=0.0,
        high=100.0,
    )
    pairs: bool = knob(False, "Keep points that only two views see; the cloud says how many rays each point has.")
    max_slope: float = knob(3.0, "Steepest surface, as change of depth per distance across.", low=0.5, high=20.0)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TripletField:
    """The points that were matched: one row per accepted cell of the grid. Rows' pixels, metres; NaN in views that do not see it."""

    grid: TemplateGrid
    cell: np.ndarray  # (N,) flat cell numbers, ascending
    xy: np.ndarray  # (N, K, 2) the texture's centre of gravity in every view
    shape: np.ndarray  # (N, K, 2, 2)
    covariance: np.ndarray  # (N, K, 2, 2) of xy
    correlation: np.ndarray  # (N,) the smallest over the views
    xyz_m: np.ndarray  # (N, 3)
    covariance_m2: np.ndarray  # (N, 3, 3)
    residual_px: np.ndarray  # (N,) rms distance of the image points to the meeting point's projections
    sigma0: np.ndarray  # (N,) of the intersection
    spread: np.ndarray  # (N, 2) variance of the texture's energy in the patch of the reference view
    smoothed: np.ndarray  # (N,) found in the smoothed images only
    tried: int  # how many cells were tried
    limit_px: float  # the residual that was allowed

    @property
    def complete(self) -> np.ndarray:
        """(N,) which points all views see."""
        return np.isfinite(self.xy).all(axis=(1, 2))

    def select(self, rows: np.ndarray) -> "TripletField":
        """The field with only these rows (a mask or indices)."""
        names = [n for n in TripletField.__dataclass_fields__ if n not in ("grid", "tried", "limit_px")]
        return TripletField(grid=self.grid, tried=self.tried, limit_px=self.limit_px, **{n: getattr(self, n)[rows] for n in names})


class _State:
    """What is known of every cell while the field grows."""

    def __init__(self, cells: int, views: int) -> None:
        self.middle = np.zeros((cells, views, 2))  # of the patches: what the growth goes on from
        self.xy = np.zeros((cells, views, 2))
        self.shape = np.zeros((cells, views, 2, 2))
        self.covariance = np.zeros((cells, views, 2, 2))
        self.correlation, self.residual, self.sigma0 = np.zeros(cells), np.zeros(cells), np.zeros(cells)
        self.spread = np.zeros((cells, 2))
        self.smoothed = np.zeros(cells, dtype=bool)
        self.xyz, self.covariance_m2 = np.zeros((cells, 3)), np.zeros((cells, 3, 3))
        self.accepted, self.tried = np.zeros(cells, dtype=bool), np.zeros(cells, dtype=bool)
        self.attempts = np.zeros(cells, dtype=np.int16)  # of this round


def grow(
    images: Sequence[SplineImage],
    cameras: Sequence[Camera],
    reference: int,
    grid: TemplateGrid,
    seeds: Approximations,
    matching: MatchingSettings,
    growing: GrowingSettings,
    *,
    foreground: Foreground,
    monitor: Monitor,
) -> TripletField:
    """Grow the field from the seeds until no neighbour can be matched any more; again with larger patches, and at last with a smaller one.

    A point needs three rays, of the views that see it, or both where there are two views; with `pairs`, two rays will do for what is then
    left. Only points that the foreground allows are accepted.
    """
    n_cells = grid.shape[0] * grid.shape[1]
    state = _State(n_cells, len(cameras))
    camera = cameras[reference]
    seed_front = cells, start, shape, parent_depth = _seed_front(grid, seeds, reference)
    matched, point, _ = _measure(images, cameras, reference, grid, grid.xy(cells), start, shape, matching, EQUAL_SIGMA_PX, pairs=False)
    limit_px, rig_sigma_px = _rig_quality(matched, point, growing)
    depths = camera.to_camera(point.xyz_m)[:, 2]
    levels = (*range(rounds_of_larger_patches(matching, growing, depths, camera) + 1), NARROW)
    for pairs, level in product((False, True) if growing.pairs and len(cameras) > 2 else (False,), levels):
        views, settings = images, replace(matching, patch_px=max(SMALLEST_PX, matching.patch_px + PATCH_STEP_PX * level))
        if level or pairs:
            state.attempts[:] = 0
            front = _front_from(state, np.flatnonzero(state.accepted), grid, growing.attempts, camera)
            cells, start, shape, parent_depth = _with_seeds(state, seed_front, front) if pairs and not level else front
        if level == NARROW:
            settings = replace(settings, max_sigma_px=NARROW_SURE * settings.max_sigma_px)
        if level >= SMOOTH_FROM:
            settings = loosened(settings)
            views = in_threads(lambda image: image.smoothed(RETRY_SMOOTHING_PX, grid.rows.step), images)
        while len(cells):
            monitor.step("surface", int(state.accepted.sum()), n_cells)
            state.attempts[cells] += 1
            state.tried[cells] = True
            xy = grid.xy(cells)
            matched, point, depth = _measure(views, cameras, reference, grid, xy, start, shape, settings, rig_sigma_px, pairs)
            good = _acceptable(matched, point, depth, parent_depth, grid, camera, replace(growing, pairs=pairs), limit_px, foreground)
            _store(state, cells[good], [_rows(m, good) for m in matched], point, good, xy[good], shape[good], grid, cameras, reference)
            state.smoothed[cells[good]] = level >= SMOOTH_FROM
            cells, start, shape, parent_depth = _front_from(state, cells[good], grid, growing.attempts, camera)
    return _field(state, grid, limit_px)


def loosened(matching: MatchingSettings) -> MatchingSettings:
    """The settings with the limits for matches whose sigmas are honest."""
    less_alike = max(0.0, matching.min_correlation - LESS_ALIKE)
    return replace(matching, max_sigma_px=LESS_SURE * matching.max_sigma_px, min_correlation=less_alike)


def rounds_of_larger_patches(matching: MatchingSettings, growing: GrowingSettings, depth_m: np.ndarray, camera: Camera) -> int:
    """How many rounds of larger patches follow: as many as are asked for, but from the second on none wider than LARGEST_PATCH_M there.

    A limb is round; over a wider patch it turns away.
    """
    if not np.isfinite(depth_m).any():
        return 0
    across_px = LARGEST_PATCH_M * camera.focal_px / float(np.nanmedian(depth_m))
    return int(np.clip((across_px - matching.patch_px) // PATCH_STEP_PX, min(1, growing.bigger_patches), growing.bigger_patches))


def _rig_quality(matched: Sequence[Matches], seeds: Intersection, growing: GrowingSettings) -> tuple[float, float]:
    """The residual to allow, and the sigma of an image point that the rig and the affine patch add to matching, both from the seeds.

    A rig whose rays miss each other by 0.6 px everywhere must not lose its points for that, and its sigmas must say so: with K equally
    weighted rays the mean square residual is σ² (2 K − 3) / K, of which matching explains its own part.
    """
    known = np.isfinite(seeds.rms_residual_px)
    if not known.any():
        return growing.max_residual_px, 0.0
    typical = float(np.median(seeds.rms_residual_px[known]))
    rays = float(np.median(seeds.rays[known]))
    explained = float(np.median(np.concatenate([np.trace(m.transfer_covariance[known & m.ok], axis1=1, axis2=2) / 2 for m in matched])))
    unexplained = typical**2 * rays / (2 * rays - 3) - explained
    return max(growing.max_residual_px, min(SEED_MEDIANS * typical, MAX_LIMIT_PX)), float(np.sqrt(max(0.0, unexplained)))


Front = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _with_seeds(state: "_State", seeds: Front, front: Front) -> Front:
    """The seeds that are not yet taken, and the rest of a front."""
    fresh = ~state.accepted[seeds[0]]
    rest = ~np.isin(front[0], seeds[0][fresh])
    cells, start, shape, depth = (np.concatenate([a[fresh], b[rest]]) for a, b in zip(seeds, front))
    return cells, start, shape, depth


def _front_from(state: "_State", fresh: np.ndarray, grid: TemplateGrid, attempts: int, camera: Camera) -> Front:
    """The next cells to try, their starts and shapes in every view, and the depth that they should continue."""
    cells, parents = _next_front(state, fresh, grid, attempts)
    step = grid.xy(cells) - grid.xy(parents)
    start = state.middle[parents] + np.einsum("nkij,nj->nki", state.shape[parents], step)  # (1)
    return cells, start, state.shape[parents], camera.to_camera(state.xyz[parents])[:, 2]


def _seed_front(grid: TemplateGrid, seeds: Approximations, reference: int) -> Front:
    """The seeds moved to their nearest cells, one per cell; their depth is not yet bound to anything (NaN)."""
    cells = grid.nearest(seeds.xy[:, reference])
    cells, first = np.unique(cells, return_index=True)
    step = grid.xy(cells) - seeds.xy[first, reference]
    start = seeds.xy[first] + np.einsum("nkij,nj->nki", seeds.shape[first], step)
    return cells, start, seeds.shape[first], np.full(len(cells), np.nan)


def _measure(
    images: Sequence[SplineImage],
    cameras: Sequence[Camera],
    reference: int,
    grid: TemplateGrid,
    xy: np.ndarray,
    start: np.ndarray,
    shape: np.ndarray,
    matching: MatchingSettings,
    rig_sigma_px: float,
    pairs: bool,
) -> tuple[list[Matches], Intersection, np.ndarray]:
    """Match points in every search view and intersect; `rig_sigma_px` is added to every image point's covariance."""
    views = [k for k in range(len(cameras)) if k != reference]
    matched = match_patches(
        images[reference],
        xy,
        [images[k] for k in views],
        [start[:, k] for k in views],
        [shape[:, k] for k in views],
        matching,
        row_step=grid.rows.step,
    )
    image_xy = np.full((len(xy), len(cameras), 2), np.nan)
    rig = np.diag([1.0, 1 / grid.rows.step**2]) * rig_sigma_px**2
    K = np.tile(np.eye(2) * TEMPLATE_SIGMA_PX**2 + rig, (len(xy), len(cameras), 1, 1))
    image_xy[:, reference] = xy + matched[0].offset
    for k, m in zip(views, matched):
        image_xy[m.ok, k] = m.transfer_xy[m.ok]
        K[m.ok, k] = m.transfer_covariance[m.ok] + rig
    image_xy[~_enough_rays(matched, pairs)] = np.nan
    point = forward_intersection(cameras, grid.rows.to_frame(image_xy), grid.rows.covariance_to_frame(K))
    return matched, point, cameras[reference].to_camera(point.xyz_m)[:, 2]


def _enough_rays(matched: Sequence[Matches], pairs: bool) -> np.ndarray:
    """(N,) whether as many views as are needed find the point."""
    return np.asarray(np.sum([m.ok for m in matched], axis=0) >= fewest_views(1 + len(matched), pairs))


def _acceptable(
    matched: Sequence[Matches],
    point: Intersection,
    depth: np.ndarray,
    parent_depth: np.ndarray,
    grid: TemplateGrid,
    camera: Camera,
    growing: GrowingSettings,
    limit_px: float,
    foreground: Foreground,
) -> np.ndarray:
    near, far = foreground.depth_range_m
    sigma = np.sqrt(np.nan_to_num(np.trace(point.covariance_m2, axis1=1, axis2=2), nan=0.0))
    across = depth * grid.spacing_px * np.sqrt(2) / camera.focal_px
    with np.errstate(invalid="ignore"):
        continues = ~(np.abs(depth - parent_depth) > growing.max_slope * across + NOISE_SIGMAS * sigma)  # NaN parents bind nothing
        return (
            _enough_rays(matched, growing.pairs)
            & (point.rms_residual_px <= limit_px)
            & (point.sigma0 <= (growing.max_ray_sigma0 or chi2_limit(point.rays)))
            & (depth >= near)
            & (depth <= far)
            & continues
            & ~foreground.excludes(point.xyz_m, point.covariance_m2)
        )


def chi2_limit(rays: np.ndarray) -> np.ndarray:
    """Largest sigma0 (N,) of intersections of so many rays that 999 in 1000 good points have: 2 K − 3 are redundant."""
    redundant = np.maximum(2 * rays - 3, 1)
    return np.asarray(np.sqrt(2 * gammaincinv(redundant / 2, RAY_TEST) / redundant))


def _rows(m: Matches, rows: np.ndarray) -> Matches:
    return Matches(**{name: getattr(m, name)[rows] for name in Matches.__dataclass_fields__})


def _store(
    state: _State,
    cells: np.ndarray,
    matched: Sequence[Matches],
    point: Intersection,
    good: np.ndarray,
    xy: np.ndarray,
    shape: np.ndarray,
    grid: TemplateGrid,
    cameras: Sequence[Camera],
    reference: int,
) -> None:
    views = [k for k in range(state.xy.shape[1]) if k != reference]
    state.accepted[cells] = True
    state.middle[cells, reference], state.xy[cells, reference] = xy, xy + matched[0].offset
    state.shape[cells, reference], state.spread[cells] = np.eye(2), matched[0].spread
    state.covariance[cells, reference] = np.eye(2) * TEMPLATE_SIGMA_PX**2
    for k, m in zip(views, matched):
        # a view that does not see the point goes on from where the point would be, with the shape that was expected there
        unseen = grid.rows.from_frame(cameras[k].project(point.xyz_m[good]))
        state.middle[cells, k] = np.where(m.ok[:, None], m.xy, unseen)
        state.xy[cells, k] = np.where(m.ok[:, None], m.transfer_xy, np.nan)
        state.shape[cells, k] = np.where(m.ok[:, None, None], m.shape, shape[:, k])
        state.covariance[cells, k] = m.transfer_covariance
    state.correlation[cells] = np.min([np.where(m.ok, m.correlation, 1.0) for m in matched], axis=0)
    state.xyz[cells], state.covariance_m2[cells] = point.xyz_m[good], point.covariance_m2[good]
    state.residual[cells], state.sigma0[cells] = point.rms_residual_px[good], point.sigma0[good]


def _next_front(state: _State, fresh: np.ndarray, grid: TemplateGrid, attempts: int) -> tuple[np.ndarray, np.ndarray]:
    """The untaken neighbours of the fresh cells, each with its best fresh parent (smallest variance)."""
    gh, gw = grid.shape
    i = (fresh % gw)[:, None] + NEIGHBOURS[:, 0]
    j = (fresh // gw)[:, None] + NEIGHBOURS[:, 1]
    cells, parents = (j * gw + i).ravel(), np.repeat(fresh, len(NEIGHBOURS))
    usable = ((i >= 0) & (i < gw) & (j >= 0) & (j < gh)).ravel()
    cells, parents = cells[usable], parents[usable]
    open_ = ~state.accepted[cells] & (state.attempts[cells] < attempts)
    cells, parents = cells[open_], parents[open_]
    quality = np.trace(state.covariance_m2[parents], axis1=1, axis2=2)
    order = np.lexsort((parents, quality, cells))
    cells, first = np.unique(cells[order], return_index=True)
    return cells, parents[order][first]


def _field(state: _State, grid: TemplateGrid, limit_px: float) -> TripletField:
    cell = np.flatnonzero(state.accepted)
    return TripletField(
        grid=grid,
        cell=cell,
        xy=state.xy[cell],
        shape=state.shape[cell],
        covariance=state.covariance[cell],
        correlation=state.correlation[cell],
        xyz_m=state.xyz[cell],
        covariance_m2=state.covariance_m2[cell],
        residual_px=state.residual[cell],
        sigma0=state.sigma0[cell],
        spread=state.spread[cell],
        smoothed=state.smoothed[cell],
        limit_px=limit_px,
        tried=int(state.tried.sum()),
    )
