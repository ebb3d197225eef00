"""The surface continued where texture is weak: cell by cell from the surface of the measured neighbours, in object space.

A patch of affine shape has eight unknowns in every search image. On plain cloth or skin its texture does not determine them: it is not
found, or lost among the noise, although the depth alone is determined well. Here a cell next to measured ones starts from the quadric
through them, whose slopes and curvatures are pseudo-observations, and so is its depth, loosely:

    θ = θ_neighbours ± σ ,   σ_depth = 1 px, σ of slopes and curvatures as in `constraints`                                (1)

(`object_space`; Krupnik & Schenk 1997), so that its texture need only determine one depth. Round after round the measured surface grows by
a cell. A cell beyond the body's outline would be matched by the texture at its patch's rim: a point counts only if the centre of gravity of
its texture, without the noise, lies near its cell. Larger patches would not help: a limb is hardly wider than they are (docs/decisions.md).
"""

from dataclasses import replace

import numpy as np

from ..foundation.arrays import select_rows
from ..foundation.progress import Monitor
from ..geometry.robust import PolynomialFit
from .constraints import (
    MIN_SIGMA_C_PX,
    WINDOW_EXTRA_PX,
    centre_window,
    from_surface,
    in_foreground,
    neighbours_prior,
    over_outline,
    surface_about,
)
from .foreground import Foreground
from .least_squares import MatchingSettings
from .object_space import SurfacePatch, SurfacePrior, SurfaceStarts, match_surface, px_per_inverse_metre
from .region_growing import MatchedField
from .views import RADIUS_CELLS, Views

ROUNDS = 8  # cells by which the surface grows at most
TRIALS = 2  # of a cell, the second when more of its neighbours are measured
FEWEST = 8  # measured cells of the 7×7 about a cell
DEPTH_SIGMA_PX = 1.0  # (1), px in the search view that moves fastest
MAX_ITERATIONS = 10  # most points that need more are no match
MAX_SHIFT_PX = 1.5  # px in that view, from the neighbours' surface
MAX_SIGMA_PX = 0.4  # px, of a matched position
LESS_CORRELATION = 0.1  # below the smallest correlation
MAX_OFFSET_CELLS = 1.25  # cells between a cell and its texture's centre of gravity


def extend(field: MatchedField, views: Views, settings: MatchingSettings, *, foreground: Foreground, monitor: Monitor) -> MatchedField:
    """The field with what could be measured next to it, marked as `extended`; a field of strong texture as it is."""
    if not field.weak_texture:
        return field
    trials = np.zeros(field.grid.shape[0] * field.grid.shape[1], dtype=np.int8)
    for _ in range(ROUNDS):
        monitor.step("surface", len(field.cell), len(trials))
        cell = _next_cells(field, trials)
        trials[cell] += 1
        found = _measured(field, cell, views, settings, monitor) if len(cell) else None
        if found is None:
            break
        found = found.select(in_foreground(found, foreground, views.base))
        field = field.joined(found)
    return field


def _next_cells(field: MatchedField, trials: np.ndarray) -> np.ndarray:
    """Open cells (m,) next to measured ones that have enough of them about them and were not tried too often."""
    from scipy.ndimage import binary_dilation, uniform_filter

    taken = np.zeros(field.grid.shape, dtype=bool)
    taken.ravel()[field.cell] = True
    side = 2 * RADIUS_CELLS + 1
    count = np.rint(uniform_filter(taken.astype(np.float64), side, mode="constant") * side**2)
    next_to = binary_dilation(taken, np.ones((3, 3), dtype=bool)) & ~taken & (count >= FEWEST)
    return np.flatnonzero(next_to.ravel() & (trials < TRIALS))


def _measured(field: MatchedField, cell: np.ndarray, views: Views, settings: MatchingSettings, monitor: Monitor) -> MatchedField | None:
    """The points (m,) that could be measured at cells (n,) next to the field; None without any start."""
    around, visible = surface_about(field, cell, views), _visible(field, cell, views)
    good = np.flatnonzero((around.coefficients[:, 0] > 0) & (visible.sum(axis=1) >= views.required_matches(False)))
    if not len(good):
        return None
    cell, visible = cell[good], visible[good]
    around = select_rows(around, good)
    speed = px_per_inverse_metre(views)
    wide = replace(
        settings,
        patch_px=settings.patch_px + WINDOW_EXTRA_PX,
        max_iterations=MAX_ITERATIONS,
        max_shift_px=MAX_SHIFT_PX,
        max_sigma_px=MAX_SIGMA_PX,
        min_correlation=max(0.0, settings.min_correlation - LESS_CORRELATION),
        max_sigma0=np.inf,
    )
    window = centre_window(wide.patch_px, views.rows.step)
    starts = SurfaceStarts(
        xy=field.grid.xy(cell),
        theta=around.coefficients,
        visible=visible,
        prior=_prior(around, speed, RADIUS_CELLS * field.grid.spacing_px),
        window=np.broadcast_to(window, (len(cell), len(window))),
        without_noise=True,
    )
    found = match_surface(views, starts, wide, sigma_across_px=max(MIN_SIGMA_C_PX, field.rig_sigma_px), monitor=monitor)
    outline = over_outline(around, field.grid, settings.patch_px)
    result = from_surface(_blank(field, cell, views), found, outline, views, field.rig_sigma_px)
    return result.select(found.ok & _own_texture(found, field))


def _visible(field: MatchedField, cell: np.ndarray, views: Views) -> np.ndarray:
    """(n, S) the search views that most of the neighbours of cells (n,) were matched in."""
    near = field.grid.neighbours(field.cell, cell)
    matched = np.isfinite(field.xy[:, views.search]).all(axis=2)[near] & (near >= 0)[..., None]
    return np.asarray(matched.sum(axis=1) * 2 > (near >= 0).sum(axis=1)[:, None])


def _prior(around: PolynomialFit, speed: float, radius_px: int) -> SurfacePrior:
    """The pseudo-observations (1)."""
    prior = neighbours_prior(around.coefficients, speed, around.scatter, radius_px)
    assert prior.error is not None
    sigma, error = prior.sigma.copy(), prior.error.copy()
    sigma[:, 0] = error[:, 0] = DEPTH_SIGMA_PX / speed
    return SurfacePrior(value=prior.value, sigma=sigma, error=error)


def _own_texture(found: SurfacePatch, field: MatchedField) -> np.ndarray:
    """(n,) points whose texture lies near their own cell, and not beyond the outline from it."""
    away = np.linalg.norm(found.offset / field.grid.step, axis=1)
    return np.asarray(away < MAX_OFFSET_CELLS)


def _blank(field: MatchedField, cell: np.ndarray, views: Views) -> MatchedField:
    """A field of cells (n,) before `from_surface` writes into it."""
    n, K = len(cell), len(views.cameras)
    shape = np.broadcast_to(np.eye(2), (n, K, 2, 2))
    return replace(
        field,
        cell=cell,
        xy=np.full((n, K, 2), np.nan),
        shape=shape,
        covariance=np.zeros((n, K, 2, 2)) + field.covariance[:1, views.reference, None],
        correlation=np.zeros(n),
        xyz_m=np.zeros((n, 3)),
        covariance_m2=np.zeros((n, 3, 3)),
        residual_px=np.zeros(n),
        sigma0=np.zeros(n),
        spread=np.zeros((n, 2)),
        smoothed=np.zeros(n, dtype=bool),
        extended=np.ones(n, dtype=bool),
    )
