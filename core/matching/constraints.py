"""Geometric constraints: every point of a matched field is measured again in all views at once, and points that then disagree are removed.

`constraint = "epipolar"`: affine patches with collinearity observations (`multi_image`, Gruen & Baltsavias 1988).
`constraint = "object"`: one curved piece of surface per point (`object_space`). A quadric of inverse depth through the cells around gives
the starts, and its slopes and curvatures are pseudo-observations: the neighbourhood constraint. It restores the curvature that an affine
patch averages away (simulated bodies: the median error along the normal grows from −0.2 to −0.7 mm from patches of 7 to 17 px), so that a
round body is measured without bias, with a patch large enough to be precise. The patch is wider than the unconstrained one and fades out
(Gaussian window): its precision is that of the centre, not that of its rim.

Every point is measured in the views that matched it; if more than the required views are left without it, a view whose patch then
correlates badly (an occlusion, a reflection) is left out.

The calibration's own error is estimated from the points: σ_c² = median of the squared shifts across the epipolar lines − their own
variance (of a first adjustment in which these shifts are free). Where σ_c is large, the calibration contradicts the images, and the field
is returned as it was matched.
"""

from dataclasses import replace
from typing import TypeVar

import numpy as np

from ..foundation.arrays import concatenated
from ..foundation.progress import Monitor
from ..foundation.threads import equal_pieces, in_threads
from ..geometry.camera import Camera
from ..geometry.robust import PolynomialFit, fit_polynomial
from .foreground import Foreground
from .least_squares import MatchingSettings, MatchStatus
from .multi_image import MultiImageMatches, MultiImageStarts, match_multi_image
from .object_space import Epipolar, SurfacePatch, SurfacePrior, SurfaceStarts, match_surface, normal_to, px_per_inverse_metre
from .patches import monomials, patch_offsets
from .region_growing import RETRY_SMOOTHING_PX, MatchedField, loosened
from .views import RADIUS_CELLS, TemplateGrid, Views

WEAK_SIGMA_PX = 0.05  # px, median of the patches' sigmas, beyond which texture is weak: cloth of 8 % contrast has 0.06–0.07, prints 0.02
WINDOW_EXTRA_PX = 4  # px by which the window is wider than `patch_px`
WINDOW_SIGMA = 0.38  # sigma of the Gaussian window, in units of `patch_px`
SLOPE_SIGMA = 0.1  # px/px in the search view that moves fastest: prior of the slopes
CURVATURE_SIGMA = 0.001  # px/px² in that view: prior of the curvatures, and
CURVATURE_SHARE = 1.0  # of the curvature itself in addition
SLOPE_ERROR = 0.8  # error of the slopes of a quadric over −1…1 by 49 neighbours of scatter 1, of which five are independent
CURVATURE_ERROR = 3.0  # error of its curvatures
SAME_PLACE = 0.25  # of the patch's width: distance allowed from the point that was matched without constraint,
UNSURE_PX = 0.08  # px, half of it where the patch's sigma is this,
SAME_PLACE_M = 0.003  # m, and never less than this
SMOOTH_EXTRA_PX = 4  # px by which the window is wider still where texture is weak
STIFF = 0.1  # of the prior's sigmas in the second try
FREE_SIGMA_PX = 1.0  # rows' px, σ_c of the sample whose shifts are to be free
MIN_SIGMA_C_PX = 0.03  # px, smallest σ_c
RAY_SIGMA_PX = 0.01  # px across the ray, on which the point lies by definition: keeps the covariance regular
MAX_RIG_SIGMA_PX = 1.0  # px; a worse rig does not belong to these images, and up to there its weight decreases
SAMPLE = 300  # points from which the rig's quality is estimated
NEIGHBOUR_NOISE_PX = 0.05  # px: smaller residuals of neighbours have full weight
LARGEST = 512  # points whose neighbours stay in the cache
MEDIAN_OF_CHI2 = 0.4549  # of one degree of freedom
LOOSER_SIGMA0 = 2.0  # times the largest sigma0: a piece of surface that all views and its neighbours determine may fit each view less well
MAX_STEEPNESS = 5.0  # change of depth per distance across
OUTLINE_ACROSS_PX = 1.6  # px across the ray, error where all of a patch's window hangs over an outline
OUTLINE_ALONG_PX = 0.6  # px along the ray

Found = TypeVar("Found", SurfacePatch, MultiImageMatches)
Measured = tuple[MatchedField, np.ndarray]  # and (N,) which points are good


def constrain(
    field: MatchedField,
    views: Views,
    settings: MatchingSettings,
    *,
    foreground: Foreground,
    monitor: Monitor,
    pairs: bool = False,
) -> MatchedField:
    """The field measured again under `settings.constraint`; points that fail are left out. "none" returns the field as it is.

    A point needs three rays, or both of two views; with `pairs` two.
    """
    if settings.constraint == "none" or not len(field.cell):
        return field
    measure = _object_space if settings.constraint == "object" else _epipolar
    measured = measure(field, views, settings, monitor, views.required_matches(pairs))
    if measured is None:
        return field
    result, ok = measured
    return result.select(ok & in_foreground(result, foreground, views.base))


def surface_about(field: MatchedField, cell: np.ndarray, views: Views) -> PolynomialFit:
    """The quadric of inverse depth about cells (n,) through the points of the field."""
    return fit_neighbours(
        field.grid.neighbours(field.cell, cell),
        field.xy[:, views.reference],
        1 / views.base.to_camera(field.xyz_m)[:, 2],
        field.grid.xy(cell),
        degree=2,
        min_scale=np.full(len(cell), NEIGHBOUR_NOISE_PX / px_per_inverse_metre(views)),
        radius_px=RADIUS_CELLS * field.grid.spacing_px,
    )


def fit_neighbours(
    neighbour: np.ndarray, xy: np.ndarray, values: np.ndarray, query_xy: np.ndarray, *, degree: int, min_scale: np.ndarray, radius_px: float
) -> PolynomialFit:
    """Fit polynomials about `query_xy` (M, 2) to `values` (N,) at `xy` (N, 2) of the rows `neighbour` (M, m), by Tukey's weights.

    Residuals below `min_scale` (M,) count fully; `radius_px` is the reach of the neighbourhood. Where there is no neighbour,
    coefficients are zero.
    """

    def fit(rows: slice) -> PolynomialFit:
        return _fitted(neighbour[rows], xy, values, query_xy[rows], degree, min_scale[rows], radius_px)

    parts = in_threads(fit, equal_pieces(len(neighbour), LARGEST, LARGEST))
    return concatenated(parts)


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


def _object_space(field: MatchedField, views: Views, settings: MatchingSettings, monitor: Monitor, required: int) -> Measured | None:
    """The field by pieces of surface; None where the calibration contradicts the images."""
    around = surface_about(field, field.cell, views)
    theta = around.coefficients[:, : 6 if settings.neighbours else 3]
    visible = field.matched_in(views.search)
    prior = neighbours_prior(theta, px_per_inverse_metre(views), around.scatter, RADIUS_CELLS * field.grid.spacing_px)
    wide = replace(loosened(settings), patch_px=settings.patch_px + WINDOW_EXTRA_PX, max_sigma0=LOOSER_SIGMA0 * settings.max_sigma0)
    starts = SurfaceStarts(
        xy=field.grid.xy(field.cell),
        theta=theta,
        visible=visible,
        prior=prior,
    )

    def match(which: np.ndarray, starts: SurfaceStarts, sigma_c: float, images: Views = views, extra_px: int = 0) -> SurfacePatch:
        weight = centre_window(wide.patch_px + extra_px, views.rows.step)
        chosen = replace(starts.select(which), window=np.broadcast_to(weight, (len(which), len(weight))))
        larger = replace(wide, patch_px=wide.patch_px + extra_px)
        return match_surface(images, chosen, larger, sigma_across_px=sigma_c, monitor=monitor)

    inner = np.flatnonzero(around.support >= np.median(around.support))  # at an outline other errors than the rig's shift a patch
    sample = match(inner[:: max(1, len(inner) // SAMPLE)], starts, FREE_SIGMA_PX)
    measured = sample.ok[:, None] & sample.visible
    rig_sigma_px = _rig_sigma(sample.across_px[measured], sample.across_sigma_px[measured])
    if rig_sigma_px > MAX_RIG_SIGMA_PX:
        return None
    sigma_c = max(MIN_SIGMA_C_PX, rig_sigma_px)
    weak = settings.neighbours and bool(sample.ok.any()) and float(np.median(sample.sigma_px[sample.ok])) > WEAK_SIGMA_PX
    starts = replace(starts, without_noise=weak)
    found = match(np.arange(len(field.cell)), starts, sigma_c)
    visible, again = _without_unlike(visible, found, settings.min_correlation, required)
    starts = replace(starts, visible=visible)
    if len(again):
        _replace(found, again, match(again, starts, sigma_c))
    if settings.neighbours:
        stiff = replace(starts, prior=replace(prior, sigma=prior.sigma * np.array([1, STIFF, STIFF, STIFF, STIFF, STIFF])))
        again = np.flatnonzero(~found.ok)
        _replace(found, again, match(again, stiff, sigma_c))
        again = np.flatnonzero(~found.ok & field.smoothed)
        if len(again):
            _replace(found, again, match(again, stiff, sigma_c, views.smoothed(RETRY_SMOOTHING_PX), SMOOTH_EXTRA_PX))
    agrees = _agrees(field, found, views, settings.patch_px)
    result = from_surface(field, found, over_outline(around, field.grid, settings.patch_px), views, rig_sigma_px)
    return replace(result, rig_sigma_px=rig_sigma_px, weak_texture=weak), found.ok & agrees


def _agrees(field: MatchedField, found: SurfacePatch, views: Views, patch_px: int) -> np.ndarray:
    """(N,) where the piece of surface contains the point that was matched without constraint.

    On one surface both methods give the same point; where a patch covers two (an outline in front of a background, a border of
    occlusion), each settles on another mixture. The grey values fit neither surface there, so that the patch's sigma is large as well:
    the larger it is, the more closely must both agree.
    """
    base = views.base
    u, v = (field.xy[:, views.reference] - field.grid.xy(field.cell)).T
    w = np.einsum("ni,ni->n", monomials(u, v, 2 if found.theta.shape[1] == 6 else 1), found.theta)
    depth = base.to_camera(field.xyz_m)[:, 2]
    allowed = SAME_PLACE / (1 + found.sigma_px / UNSURE_PX) * patch_px * depth / base.focal_px
    return np.abs(1 / np.maximum(w, 1e-6) - depth) < np.maximum(allowed, SAME_PLACE_M)


def _without_unlike(visible: np.ndarray, found: Found, smallest: float, required: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows (m,) of points that failed though enough of their views correlate, and `visible` (N, S) without the other views of these."""
    alike = visible & (found.correlation >= smallest)
    rows = np.flatnonzero(~found.ok & (alike.sum(axis=1) >= required) & (alike.sum(axis=1) < visible.sum(axis=1)))
    visible = visible.copy()
    visible[rows] = alike[rows]
    return visible, rows


def neighbours_prior(start: np.ndarray, speed: float, scatter: np.ndarray, radius_px: int) -> SurfacePrior:
    """The prior of slopes and curvatures from the neighbours, the weaker the rounder the surface; planes (N, 3) have none.

    Its errors follow from the neighbours' scatter (N,) about the quadric, of radius `radius_px`.
    """
    sigma = np.full(start.shape, np.inf)
    if start.shape[1] < 6:
        return SurfacePrior(value=start, sigma=sigma)
    sigma[:, 1:3] = SLOPE_SIGMA / speed
    sigma[:, 3:] = CURVATURE_SIGMA / speed + CURVATURE_SHARE * np.linalg.norm(start[:, 3:], axis=1, keepdims=True)
    error = np.zeros(start.shape)
    error[:, 1:3] = SLOPE_ERROR / radius_px * scatter[:, None]
    error[:, 3:] = CURVATURE_ERROR / radius_px**2 * scatter[:, None]
    return SurfacePrior(value=start, sigma=sigma, error=np.minimum(error, sigma))


def centre_window(patch_px: int, row_step: int) -> np.ndarray:
    """Weights (n,) of a patch's pixels: a Gaussian about its centre."""
    u, v, _ = patch_offsets(patch_px, row_step)
    return np.exp(-0.5 * (u**2 + (v * row_step) ** 2) / (WINDOW_SIGMA * (patch_px - WINDOW_EXTRA_PX)) ** 2)


def _rig_sigma(across_px: np.ndarray, sigma_px: np.ndarray) -> float:
    """Standard deviation [px] of the calibration's errors, from the shifts across the epipolar lines."""
    if not len(across_px):
        return 0.0
    return float(np.sqrt(max(0.0, float(np.median(across_px**2)) / MEDIAN_OF_CHI2 - float(np.median(sigma_px**2)))))


def _replace(found: Found, rows: np.ndarray, other: Found) -> None:
    """Replace `rows` of `found` by the good ones of `other`."""
    for name in type(found).__dataclass_fields__:
        if name != "status":
            getattr(found, name)[rows[other.ok]] = getattr(other, name)[other.ok]
    found.status[rows[other.ok]] = other.status[other.ok]


def from_surface(field: MatchedField, found: SurfacePatch, outline: np.ndarray, views: Views, rig_sigma_px: float) -> MatchedField:
    """The field with the positions, shapes and covariances of pieces of surface, at the texture's centre of gravity.

    `outline` (N,) is the share of each patch that hangs over the edge.
    """
    base, rows, o = views.base, views.rows, found.offset
    curved = found.theta.shape[1] == 6
    m = monomials(o[:, 0], o[:, 1], 2 if curved else 1).astype(np.float64)
    w = np.maximum(np.einsum("ni,ni->n", m, found.theta), 1e-6)
    at, slope = field.grid.xy(field.cell) + o, found.theta[:, 1:3]
    if curved:
        slope = slope + np.einsum("nij,nj->ni", found.theta[:, [3, 4, 4, 5]].reshape(-1, 2, 2), o)
    steepness = np.linalg.norm(slope / (1.0, rows.step), axis=1) * base.focal_px / w
    variance = np.einsum("ni,nij,nj->n", m, found.covariance, m)
    xy, shape, K = field.xy.copy(), field.shape.copy(), field.covariance.copy()
    xy[:, views.reference] = at
    square, speed = np.zeros(len(w)), np.zeros(len(w))
    for i, k in enumerate(views.search):
        c, e, A, _ = Epipolar(base, views.cameras[k], rows, at).centre(np.column_stack([w, slope]))
        n = normal_to(e)
        visible = found.visible[:, i]
        xy[:, k], shape[:, k] = np.where(visible[:, None], c + found.across_px[:, i, None] * n, np.nan), A
        K[:, k] = (
            variance[:, None, None] * e[:, :, None] * e[:, None]
            + (found.across_sigma_px[:, i] ** 2)[:, None, None] * n[:, :, None] * n[:, None]
        )
        square += np.where(visible, np.sum((found.across_px[:, i, None] * n * (1.0, rows.step)) ** 2, axis=1), 0.0)
        speed = np.where(visible, np.maximum(speed, np.linalg.norm(e, axis=1)), speed)
    found.status[(found.status == MatchStatus.OK) & (steepness > MAX_STEEPNESS)] = MatchStatus.SHAPE_TOO_LARGE
    ray = base.rays(rows.to_frame(at))
    excess = found.across_px / np.sqrt(found.across_sigma_px**2 + max(rig_sigma_px, MIN_SIGMA_C_PX) ** 2)
    return replace(
        field,
        xy=xy,
        shape=shape,
        covariance=K,
        correlation=found.correlation.min(axis=1),
        xyz_m=base.centre_m + ray / w[:, None],
        covariance_m2=ray[:, :, None] * ray[:, None] * (variance / w**4)[:, None, None]
        + _model_covariance(ray, w, speed, outline, rig_sigma_px, base),
        residual_px=np.sqrt(square / (1 + found.visible.sum(axis=1))),
        sigma0=np.sqrt(np.sum(excess**2, axis=1) / found.visible.sum(axis=1)),
        spread=np.zeros_like(field.spread) if curved else found.spread,  # with curvatures adjusted nothing is left to correct
    )


def _model_covariance(
    ray: np.ndarray, w: np.ndarray, speed: np.ndarray | float, outline: np.ndarray, rig_sigma_px: float, base: Camera
) -> np.ndarray:
    """Covariance (N, 3, 3) that matching cannot estimate: of the calibration's errors, and of the body's outline.

    A patch of which a share `outline` (N,) hangs over the edge is displaced across the ray: off a surface that turns away there, and hardly
    off one that faces the camera up to its edge.
    """
    px_m2 = 1 / (base.focal_px * w) ** 2
    less_along = (OUTLINE_ACROSS_PX**2 - OUTLINE_ALONG_PX**2) * outline**2 * px_m2 / np.einsum("ni,ni->n", ray, ray)
    of_ray = (rig_sigma_px / np.maximum(speed, 1e-9)) ** 2 / w**4 - less_along
    of_all = (RAY_SIGMA_PX**2 + rig_sigma_px**2 + (OUTLINE_ACROSS_PX * outline) ** 2) * px_m2
    return ray[:, :, None] * ray[:, None] * of_ray[:, None, None] + of_all[:, None, None] * np.eye(3)


def over_outline(around: PolynomialFit, grid: TemplateGrid, patch_px: int) -> np.ndarray:
    """The share (N,) of each patch's window where no neighbour belongs to the same surface."""
    cells = np.arange(-RADIUS_CELLS, RADIUS_CELLS + 1) * grid.spacing_px
    window = np.exp(-0.5 * np.add.outer(cells**2, cells**2).ravel() / (WINDOW_SIGMA * patch_px) ** 2)
    return (1 - around.weights) @ (window / window.sum())


def _epipolar(field: MatchedField, views: Views, settings: MatchingSettings, monitor: Monitor, required: int) -> Measured:
    """The field by affine patches with collinearity observations."""
    rows, base, search, xy = views.rows, views.base, views.search, field.grid.xy(field.cell)
    around = surface_about(field, field.cell, views)
    theta, ray = around.coefficients[:, :3], base.rays(rows.to_frame(xy))
    lines = [Epipolar(base, views.cameras[k], rows, xy).centre(theta) for k in search]
    centre, shape = (np.stack([line[i] for line in lines], axis=1) for i in (0, 2))
    xyz_m = base.points_at_depth(rows.to_frame(xy), 1 / theta[:, 0])
    visible = field.matched_in(views.search)
    starts = MultiImageStarts(xy=xy, centre=centre, shape=shape, xyz_m=xyz_m, visible=visible)

    def match(which: np.ndarray, starts: MultiImageStarts, sigma_c: float) -> MultiImageMatches:
        return match_multi_image(views, starts.select(which), settings, sigma_c_px=sigma_c, neighbours=settings.neighbours, monitor=monitor)

    every = np.arange(len(xy))
    sample = match(every[:: max(1, len(xy) // SAMPLE)], starts, FREE_SIGMA_PX)
    measured = sample.ok[:, None] & sample.visible
    rig_sigma_px = _rig_sigma(sample.residual_px[:, 1:, 1][measured], np.sqrt(sample.covariance[:, :, 1, 1][measured]) * rows.step)
    sigma_c = max(MIN_SIGMA_C_PX, rig_sigma_px)
    found = match(every, starts, sigma_c)
    visible, again = _without_unlike(visible, found, settings.min_correlation, required)
    if len(again):
        _replace(found, again, match(again, replace(starts, visible=visible), sigma_c))
    rays = 1 + found.visible.sum(axis=1)
    at, A, K = field.xy.copy(), field.shape.copy(), field.covariance.copy()
    at[:, views.reference] = xy + found.offset
    at[:, search], A[:, search], K[:, search] = np.where(found.visible[..., None], found.xy, np.nan), found.shape, found.covariance
    square = np.sum(found.residual_px**2, axis=(1, 2))
    outline = over_outline(around, field.grid, settings.patch_px)
    of_model = _model_covariance(ray, theta[:, 0], px_per_inverse_metre(views), outline, rig_sigma_px, base)
    result = replace(
        field,
        xy=at,
        shape=A,
        covariance=K,
        correlation=found.correlation.min(axis=1),
        xyz_m=found.xyz_m,
        covariance_m2=found.covariance_m2 + of_model,
        residual_px=np.sqrt(square / rays),
        sigma0=np.sqrt(square / (2 * rays - 3)) / sigma_c,
        spread=found.spread,
    )
    return result, found.ok


def in_foreground(field: MatchedField, foreground: Foreground, base: Camera) -> np.ndarray:
    """(N,) points whose rays meet and that lie in the foreground."""
    near, far = foreground.depth_range_m
    depth = base.to_camera(field.xyz_m)[:, 2]
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (depth >= near)
            & (depth <= far)
            & (field.residual_px <= field.limit_px)
            & ~foreground.excludes(field.xyz_m, field.covariance_m2)
        )
