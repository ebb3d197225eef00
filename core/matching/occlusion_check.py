"""Does a point's own middle lie on the surface that its patch found?

A patch that holds two surfaces (an outline before something behind it, a border of occlusion) settles between them, and all views agree
on it. In the few pixels about the point itself only one of them is seen, or nothing that tells the depth. There the surface is matched
once more, its slopes held and its depth known to half a pixel. How far the point may be off is said by how much its depth moves, by the
sigmas of both matches, and by the share R² of the texture's variance s² that is explained, in the view where it is least, by the surface
or by the noise σ_n of the image,

    u = √(shift² + σ_middle² + σ²) / R² ,   1 − R² = max(0, (1 − ρ²) s² − σ_n²) / s²                          (1)
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..geometry.camera import Camera
from ..images.interlace import RowGrid
from ..images.sampling import SplineImage
from .least_squares import MatchingSettings
from .object_space import Epipolar, SurfacePrior, match_surface
from .patches import TemplatePatches
from .region_growing import TripletField

MIDDLE_PX = 5
DEPTH_SIGMA_PX, SLOPE_SIGMA = 0.5, 0.01  # px, px/px in the search view that moves fastest: what a mixture may be off; held
ACROSS_SIGMA_PX = 0.03
LEAST_EXPLAINED = 0.25  # of R²: what explains less is as far off
LARGEST_M, MEDIANS = 0.011, 2.2  # of (1) that is believed; more where most points are worse


def in_doubt(
    field: TripletField, images: Sequence[SplineImage], cameras: Sequence[Camera], reference: int, settings: MatchingSettings
) -> np.ndarray:
    """(N,) the points whose depths (1) leaves in doubt; none of those matched without constraints, which stay as it was published."""
    if settings.constraint == "none" or not len(field.cell):
        return np.zeros(len(field.cell), dtype=bool)
    base = cameras[reference]
    speed = max(base.focal_px * float(np.linalg.norm(c.centre_m - base.centre_m)) for c in cameras if c is not base)
    seen = np.delete(np.isfinite(field.xy).all(axis=2), reference, axis=1)
    sigma_m = np.sqrt(np.trace(field.covariance_m2, axis1=1, axis2=2))
    planes = _planes(field, cameras, reference)
    at = field.xy[:, reference]
    return ~believed(depth_doubt(images, cameras, reference, field.grid.rows, at, planes, sigma_m, settings, speed=speed, seen=seen))


def _planes(field: TripletField, cameras: Sequence[Camera], reference: int) -> np.ndarray:
    """Inverse depth and its slopes (N, 3) at the field's points: the mean of what their shapes A = A_0 + e slopeᵀ say in every view."""
    base, rows, at = cameras[reference], field.grid.rows, field.xy[:, reference]
    planes = np.zeros((len(field.cell), 3))
    planes[:, 0] = 1 / base.to_camera(field.xyz_m)[:, 2]
    slopes = []
    for k, camera in enumerate(cameras):
        if camera is not base:
            _, e, A0, _ = Epipolar(base, camera, rows, at).centre(planes)
            slope = np.einsum("ni,nij->nj", e, field.shape[:, k] - A0) / np.maximum(np.sum(e * e, axis=1), 1e-12)[:, None]
            slopes.append(np.where(np.isfinite(field.xy[:, k]).all(axis=1)[:, None], slope, np.nan))
    planes[:, 1:] = np.nan_to_num(np.nanmean(slopes, axis=0))
    return planes


def depth_doubt(
    images: Sequence[SplineImage],
    cameras: Sequence[Camera],
    reference: int,
    rows: RowGrid,
    xy: np.ndarray,
    planes: np.ndarray,
    sigma_m: np.ndarray,
    settings: MatchingSettings,
    *,
    speed: float,
    seen: np.ndarray,
) -> np.ndarray:
    """(1) in metres (N,), of the points `xy` (N, 2) (rows' pixels of the reference) on planes (N, 3) of inverse depth, 1/m and per pixel.

    `sigma_m` (N,) are the points' own; `speed` [px m] is that of the fastest search view with inverse depth, `seen` (N, S) the search
    views that take part. A middle without texture says nothing, which leaves half a pixel.
    """
    held = SurfacePrior(value=planes, sigma=np.broadcast_to(np.array([DEPTH_SIGMA_PX, SLOPE_SIGMA, SLOPE_SIGMA]) / speed, planes.shape))
    free = replace(settings, patch_px=MIDDLE_PX, min_correlation=-1.0, max_sigma_px=np.inf, max_sigma0=np.inf, max_shear=np.inf)
    found = match_surface(images, cameras, reference, rows, xy, planes, free, sigma_across_px=ACROSS_SIGMA_PX, prior=held, seen=seen)
    metres = 1 / (speed * planes[:, 0] ** 2)  # a pixel of the fastest view
    off_px = np.where(found.ok, np.hypot((found.theta[:, 0] - planes[:, 0]) * speed, found.sigma_px), DEPTH_SIGMA_PX)
    middle = TemplatePatches(images[reference], xy, MIDDLE_PX, rows.step)
    variance = np.maximum(middle.contrast**2 / middle.pixels, 1e-9)
    left = (1 - found.correlation.min(axis=1) ** 2) * variance - images[reference].noise ** 2
    explained = np.where(found.ok, np.clip(1 - left / variance, LEAST_EXPLAINED, 1.0), 1.0)
    return np.asarray(np.hypot(off_px * metres, sigma_m) / explained)


def believed(doubt_m: np.ndarray) -> np.ndarray:
    """(N,) which points' depths are known well enough, by (1), for a body, or for these images where most are known less well."""
    usual = float(np.median(doubt_m)) if len(doubt_m) else 0.0
    return np.asarray(doubt_m <= max(LARGEST_M, MEDIANS * usual))
