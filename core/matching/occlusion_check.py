"""Occlusion check: does the centre of a patch lie on the surface that the whole patch was matched on?

A patch that covers two surfaces (at an outline in front of something, at a border of occlusion) settles between them, and all views agree
on the mixture. The few pixels about the point itself show only one of them, or too little texture to determine the depth. There the surface
is matched once more, with its slopes fixed and a prior of half a pixel for its depth. The uncertainty of the point's depth combines the
shift of that depth, the sigmas of both matches, and the share R² of the texture's variance s² that the surface or the image's noise σ_n
explains, in the view where it is smallest,

    u = √(shift² + σ_centre² + σ²) / R² ,   1 − R² = max(0, (1 − ρ²) s² − σ_n²) / s²                          (1)

Where texture is weak, most centres show none of it. There a point that is surrounded by points of its own surface passes with a larger
uncertainty: there is no other surface for a mixture. Points that were measured from their neighbours' surface (`extension`) are judged more
strictly elsewhere.
"""

from dataclasses import replace

import numpy as np

from ..images.sampling import SplineImage
from .constraints import over_outline, surface_about
from .least_squares import MatchingSettings
from .object_space import Epipolar, SurfacePrior, SurfaceStarts, match_surface, px_per_inverse_metre
from .patches import patch_offsets
from .region_growing import MatchedField
from .views import Views

CENTRE_PX = 5  # side of the patch about the point itself
DEPTH_SIGMA_PX = 0.5  # px in the search view that moves fastest: prior of the centre's depth, by which a mixture may be off
SLOPE_SIGMA = 0.01  # px/px in that view: the slopes are practically fixed
ACROSS_SIGMA_PX = 0.03  # rows' px across the epipolar line
LEAST_EXPLAINED = 0.25  # lower limit of R² in (1)
LARGEST_M = 0.011  # m, acceptable uncertainty (1); of persons at 4 mm/px it removes two thirds of the gross errors with 3–8 % of the points
MEDIANS = 2.2  # medians of (1) that are acceptable where most points are worse
EXTENDED_M = 0.013  # m, acceptable uncertainty of points measured from their neighbours' surface
SURROUNDED_M = 0.025  # m, and of points on weak texture, if no more than
SURROUNDED = 0.3  # of their patch lacks points of the same surface


def fails_occlusion_check(field: MatchedField, views: Views, settings: MatchingSettings) -> np.ndarray:
    """(N,) the points whose depth (1) is too uncertain; none of those matched without constraints, which follow the published method."""
    if settings.constraint == "none" or not len(field.cell):
        return np.zeros(len(field.cell), dtype=bool)
    starts = SurfaceStarts(
        xy=field.xy[:, views.reference],
        theta=_planes(field, views),
        visible=field.matched_in(views.search),
    )
    sigma_m = np.sqrt(np.trace(field.covariance_m2, axis1=1, axis2=2))
    u_m = depth_uncertainty(views, starts, sigma_m, settings, px_per_inverse_metre=px_per_inverse_metre(views))
    if not field.weak_texture:
        return ~acceptable(u_m)
    good = np.where(field.extended, u_m <= EXTENDED_M, acceptable(u_m, ~field.extended))
    outline = over_outline(surface_about(field, field.cell, views), field.grid, settings.patch_px)
    return np.asarray(~good & ~((outline < SURROUNDED) & (u_m <= SURROUNDED_M)))


def _planes(field: MatchedField, views: Views) -> np.ndarray:
    """Inverse depth and its slopes (N, 3) at the field's points: the mean over the views of those that follow from A = A_0 + e slopeᵀ."""
    base, at = views.base, field.xy[:, views.reference]
    planes = np.zeros((len(field.cell), 3))
    planes[:, 0] = 1 / base.to_camera(field.xyz_m)[:, 2]
    slopes = []
    for k in views.search:
        _, e, A0, _ = Epipolar(base, views.cameras[k], views.rows, at).centre(planes)
        slope = np.einsum("ni,nij->nj", e, field.shape[:, k] - A0) / np.maximum(np.sum(e * e, axis=1), 1e-12)[:, None]
        slopes.append(np.where(np.isfinite(field.xy[:, k]).all(axis=1)[:, None], slope, np.nan))
    planes[:, 1:] = np.nan_to_num(np.nanmean(slopes, axis=0))
    return planes


def depth_uncertainty(
    views: Views, planes: SurfaceStarts, sigma_m: np.ndarray, settings: MatchingSettings, *, px_per_inverse_metre: float
) -> np.ndarray:
    """(1) in metres (N,), of points on planes (N, 3) of inverse depth; `sigma_m` (N,) are the points' own sigmas.

    `px_per_inverse_metre` [px m]: how fast the fastest search view moves with inverse depth. A centre without texture leaves the depth
    uncertain by half a pixel.
    """
    sigma = np.array([DEPTH_SIGMA_PX, SLOPE_SIGMA, SLOPE_SIGMA]) / px_per_inverse_metre
    fixed = SurfacePrior(value=planes.theta, sigma=np.broadcast_to(sigma, planes.theta.shape))
    free = replace(settings, patch_px=CENTRE_PX, min_correlation=-1.0, max_sigma_px=np.inf, max_sigma0=np.inf, max_shear=np.inf)
    found = match_surface(views, replace(planes, prior=fixed), free, sigma_across_px=ACROSS_SIGMA_PX)
    inverse = planes.theta[:, 0]
    metres = 1 / (px_per_inverse_metre * inverse**2)  # a pixel of the fastest view
    off_px = np.where(found.ok, np.hypot((found.theta[:, 0] - inverse) * px_per_inverse_metre, found.sigma_px), DEPTH_SIGMA_PX)
    variance = np.maximum(_variance(views.template, planes.xy, views.rows.step), 1e-9)
    left = (1 - found.correlation.min(axis=1) ** 2) * variance - views.template.noise**2
    explained = np.where(found.ok, np.clip(1 - left / variance, LEAST_EXPLAINED, 1.0), 1.0)
    return np.asarray(np.hypot(off_px * metres, sigma_m) / explained)


def _variance(image: SplineImage, xy: np.ndarray, row_step: int) -> np.ndarray:
    """Variance (N,) of the grey values in the centres of the patches about xy (N, 2)."""
    u, v, _ = patch_offsets(CENTRE_PX, row_step)
    x, y = (xy[:, i, None].astype(np.float32) + d for i, d in ((0, u), (1, v)))
    return image.sample(x, y).astype(np.float64).var(axis=1)


def acceptable(uncertainty_m: np.ndarray, usual_ones: np.ndarray | slice = slice(None)) -> np.ndarray:
    """(N,) which points' uncertainties (1) are small enough for a body, or for these images where most of the `usual_ones` are larger."""
    of = uncertainty_m[usual_ones]
    usual = float(np.median(of)) if len(of) else 0.0
    return np.asarray(uncertainty_m <= max(LARGEST_M, MEDIANS * usual))
