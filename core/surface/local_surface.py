"""The surface about each measured point: a quadric of its depth over the neighbouring cells, fitted robustly.

    D(a, b) = D0 + Da a + Db b + ½ Daa a² + Dab a b + ½ Dbb b² ,   a, b in full-frame pixels of the reference image        (1)

It gives the normal, the outliers among the neighbours, and the curvature that an affine patch averages away: a patch is matched at the mean
of (1) over its texture, so that a round body is measured too flat. With the variances s_a², s_b² of the texture's energy

    D0 − D̄ = −½ (Daa s_a² + Dbb s_b²)                                                                                       (2)
"""

from dataclasses import dataclass

import numpy as np

from ..foundation.threads import equal_pieces, in_threads
from ..geometry.camera import Camera
from ..geometry.robust import fit_polynomial
from ..matching.region_growing import MatchedField
from ..matching.views import RADIUS_CELLS

LARGEST = 512  # points whose neighbours stay in the cache
MIN_SCALE = 0.15  # of the spacing on the surface: smaller scatter is not distinguished from the surface's own shape


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LocalSurface:
    """N points' neighbourhoods. Depths along the reference camera's axis."""

    depth_m: np.ndarray  # (N,) as measured
    fitted_m: np.ndarray  # (N,) D0 of (1)
    scatter_m: np.ndarray  # (N,) robust scatter of the neighbours about (1)
    neighbours: np.ndarray  # (N,) how many cells support the fit
    flattening_m: np.ndarray  # (N,) correction (2) of the depth
    normal: np.ndarray  # (N, 3) unit, towards the reference camera


def local_surface(field: MatchedField, camera: Camera, reference: int) -> LocalSurface:
    """Fit (1) about every point of the field, from the cells within RADIUS_CELLS."""
    coefficients, scatter, support = _quadrics(field, camera, reference, np.arange(len(field.cell)))
    depth = camera.to_camera(field.xyz_m)[:, 2]
    across = field.spread * (1.0, field.grid.rows.step**2)
    return LocalSurface(
        depth_m=depth,
        fitted_m=depth + coefficients[:, 0],
        scatter_m=scatter,
        neighbours=support,
        flattening_m=-0.5 * (coefficients[:, 3] * across[:, 0] + coefficients[:, 5] * across[:, 1]),  # (2)
        normal=_normals(field, camera, reference, depth, coefficients),
    )


def curvatures(field: MatchedField, camera: Camera, reference: int, rows: np.ndarray) -> np.ndarray:
    """Daa and Dbb (n, 2) of (1) about these rows (n,) of the field, the depth in pixels of the reference view as well [1/px]."""
    coefficients, _, _ = _quadrics(field, camera, reference, rows)
    return coefficients[:, [3, 5]] * (camera.focal_px / camera.to_camera(field.xyz_m[rows])[:, 2])[:, None]


def _quadrics(field: MatchedField, camera: Camera, reference: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(1) about these rows: coefficients (n, 6), the neighbours' scatter (n,) about it and their number (n,)."""
    depth, at = camera.to_camera(field.xyz_m)[:, 2], field.grid.rows.to_frame(field.xy[:, reference])
    neighbour = field.grid.neighbours(field.cell, field.cell[rows])
    spacing_m = field.grid.spacing_px * depth / camera.focal_px

    def fit(piece: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        near, middle = neighbour[piece], rows[piece, None]
        own, spacing, valid = depth[middle], spacing_m[middle], near >= 0
        a, b = np.moveaxis(np.where(valid[..., None], at[near] - at[middle], 0.0), -1, 0)
        D = np.where(valid, depth[near], 0.0)
        weight = valid & (np.abs(D - own) < 3.0 * spacing * np.hypot(a, b) / field.grid.spacing_px + spacing)
        radius, scale = RADIUS_CELLS * field.grid.spacing_px, MIN_SCALE * spacing[:, 0]
        found = fit_polynomial(a, b, D - own, weight, degree=2, radius=radius, min_scale=scale)
        return found.coefficients, found.scatter, weight.sum(axis=1) - 1

    parts = in_threads(fit, equal_pieces(len(rows), LARGEST, LARGEST))
    coefficients, scatter, support = (np.concatenate(part) for part in zip(*parts))
    return coefficients, scatter, support


def _normals(field: MatchedField, camera: Camera, reference: int, depth: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Unit normals from the tangents ∂X/∂a, ∂X/∂b of the fitted depth, turned towards the camera."""
    xy = field.grid.rows.to_frame(field.xy[:, reference])
    rays, along_a, along_b = camera.rays(xy), camera.rays(xy + (1.0, 0.0)), camera.rays(xy + (0.0, 1.0))
    tangent_a = coefficients[:, 1:2] * rays + depth[:, None] * (along_a - rays)
    tangent_b = coefficients[:, 2:3] * rays + depth[:, None] * (along_b - rays)
    normal = np.cross(tangent_a, tangent_b)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.where(np.einsum("ni,ni->n", normal, rays)[:, None] > 0, -normal, normal)
