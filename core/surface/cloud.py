"""From a matched field to a clean cloud: filters, the correction for curvature, normals, covariances, and thinning.

A point must agree with its neighbours and must belong to a large enough group. Its covariance is the sum of the intersection's, of the
neighbours' scatter beyond it, and of half of the curvature correction, for its remaining error.

A written cloud may be thinned evenly: the points in a cube of space are replaced by their centre of gravity (D'Apuzzo et al. 2000, §2.2).
With weights w_i ∝ 1 / tr K_i, Σ w_i = 1,

    X = Σ w_i X_i ,   K = Σ w_i K_i                                                                  (1)

The patches of neighbouring points overlap, so that their errors are correlated: K is the upper limit, that of fully dependent points. A
centre of gravity counts as extended if half of its weight or more is that of extended points.
"""

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from ..foundation.arrays import frozen
from ..foundation.settings import knob
from ..geometry.camera import Camera
from ..matching.region_growing import MatchedField
from ..motion.formats import ply
from .local_surface import LocalSurface, local_surface

FILTERS = ("outlier", "small island", "occlusion")  # reasons for removal, numbered from 1
OUTLIER, SMALL_ISLAND, OCCLUDED = 1, 2, 3  # the last by matching/occlusion_check.py
MIN_NEIGHBOURS = 3  # of a point; one with fewer is an outlier
MIN_DEVIATION = 0.5  # of the spacing on the surface: smaller scatter of the neighbours does not narrow the limit for outliers
REMAINING_BIAS = 0.5  # of the curvature correction, the part that remains as an error
LIMB_SCATTER = 0.06  # of the spacing on the surface, scatter about a quadric that the shape of a round limb explains
ROUGHNESS = 0.7  # of the neighbours' variance beyond that and beyond their own, which enters a point's covariance
MAX_CORRECTION_PX = 3.0  # px; a rounder surface than this implies is noise, not a body


@dataclass(frozen=True, kw_only=True, slots=True)
class SurfaceSettings:
    """How finely the surface is measured, its filters, and the thinning of its files."""

    quality: str = knob(
        "motion",
        "Motion: large images are reduced to what the fit of a body needs, some 2,000 points of the person; surface: every pixel counts, "
        "as it does where no body is asked for.",
        choices=("motion", "surface"),
    )
    min_island: int = knob(20, "Groups of fewer connected points than this are removed.", low=1, high=10_000)
    max_deviation: float = knob(4.0, "Largest distance from the neighbours' surface, in units of their scatter.", low=1.0, high=20.0)
    correct_curvature: bool = knob(
        True, "Correct the flattening of round surfaces by affine patches; matching in object space needs no correction."
    )
    voxel_mm: float = knob(
        0.0, "Side of the cubes in which points are averaged in the written clouds; 0 writes all points.", unit="mm", low=0.0, high=1000.0
    )
    voxel_points: int = knob(2, "Cubes with fewer points than this are left out.", low=1, high=1000)

    @property
    def of_measuring(self) -> "SurfaceSettings":
        """These settings without those that concern only the size of the images and the written files."""
        return replace(self, quality="surface", voxel_mm=0.0, voxel_points=1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PointCloud:
    """The surface of one frame. World metres, full-frame pixels; normals point towards the cameras."""

    frame: int
    xyz_m: np.ndarray  # (N, 3)
    covariance_m2: np.ndarray  # (N, 3, 3)
    normals: np.ndarray  # (N, 3)
    intensity: np.ndarray  # (N,) grey value in the reference view
    xy_px: np.ndarray  # (N, K, 2) where the points were matched
    residual_px: np.ndarray  # (N,) RMS by which the rays miss each other
    extended: np.ndarray  # (N,) measured from the surface of the neighbours, where texture is weak (matching/extension.py)

    def __post_init__(self) -> None:
        n, k = len(self.xyz_m), self.xy_px.shape[1]
        for name, shape in dict(
            xyz_m=(n, 3), covariance_m2=(n, 3, 3), normals=(n, 3), intensity=(n,), xy_px=(n, k, 2), residual_px=(n,)
        ).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))
        object.__setattr__(self, "extended", frozen(self.extended, (n,), bool, "extended"))

    @property
    def sigma_m(self) -> np.ndarray:
        """(N,) root of the trace of the covariance: the standard error of position."""
        return np.sqrt(np.trace(self.covariance_m2, axis1=1, axis2=2))

    @property
    def rays(self) -> np.ndarray:
        """(N,) uint8, how many views each point was measured in."""
        return np.isfinite(self.xy_px).all(axis=2).sum(axis=1).astype(np.uint8)

    def select(self, rows: np.ndarray) -> "PointCloud":
        """The cloud with only these rows (a mask or indices)."""
        return PointCloud(frame=self.frame, **{f.name: getattr(self, f.name)[rows] for f in fields(PointCloud) if f.name != "frame"})


def clean_field(field: MatchedField, camera: Camera, reference: int, settings: SurfaceSettings) -> MatchedField:
    """The field without outliers and small islands."""
    return field.select(why_removed(field, camera, reference, settings) == 0)


def why_removed(field: MatchedField, camera: Camera, reference: int, settings: SurfaceSettings) -> np.ndarray:
    """(N,) uint8, OUTLIER or SMALL_ISLAND where one of these filters removes the point, and 0."""
    why = np.zeros(len(field.cell), dtype=np.uint8)
    if not len(why):
        return why
    surface = local_surface(field, camera, reference)
    spacing_m = field.grid.spacing_px * surface.depth_m / camera.focal_px
    limit = settings.max_deviation * np.maximum(surface.scatter_m, MIN_DEVIATION * spacing_m)
    agrees = (np.abs(surface.depth_m - surface.fitted_m) <= limit) & (surface.neighbours >= MIN_NEIGHBOURS)
    why[~agrees] = OUTLIER
    why[agrees] = np.where(_island_size(field.select(agrees)) >= settings.min_island, 0, SMALL_ISLAND)
    return why


def point_cloud(field: MatchedField, grey: np.ndarray, camera: Camera, reference: int, frame: int, settings: SurfaceSettings) -> PointCloud:
    """The cloud of a cleaned field. `grey` (h', w) is the reference image in rows."""
    n, k = field.xy.shape[:2]
    xyz, K, normal = field.xyz_m, field.covariance_m2, np.zeros((0, 3))
    if n:
        surface = local_surface(field, camera, reference)
        rays = camera.rays(field.grid.rows.to_frame(field.xy[:, reference]))
        explained_m = LIMB_SCATTER * field.grid.spacing_px * surface.depth_m / camera.focal_px
        normal, K = surface.normal, K + _roughness(K, rays, surface.scatter_m, explained_m)
        if settings.correct_curvature:
            shift = rays * _correction_m(surface, camera.focal_px)[:, None]
            xyz, K = xyz + shift, K + REMAINING_BIAS**2 * shift[:, :, None] * shift[:, None]
    pixel = np.rint(field.xy[:, reference]).astype(int)
    return PointCloud(
        frame=frame,
        xyz_m=xyz,
        covariance_m2=K,
        normals=normal,
        intensity=grey[pixel[:, 1], pixel[:, 0]],
        xy_px=field.grid.rows.to_frame(field.xy).reshape(n, k, 2),
        residual_px=field.residual_px,
        extended=field.extended,
    )


def _roughness(covariance_m2: np.ndarray, rays: np.ndarray, scatter_m: np.ndarray, explained_m: np.ndarray) -> np.ndarray:
    """Covariance (N, 3, 3) along the rays: the neighbours' scatter beyond their covariances and beyond `explained_m`."""
    own = np.einsum("ni,nij,nj->n", rays, covariance_m2, rays) / np.einsum("ni,ni->n", rays, rays) ** 2
    more = ROUGHNESS * np.maximum(0.0, scatter_m**2 - own - explained_m**2)
    return more[:, None, None] * rays[:, :, None] * rays[:, None]


def _correction_m(surface: LocalSurface, focal_px: float) -> np.ndarray:
    """(N,) correction of the depths for the curvature."""
    limit = MAX_CORRECTION_PX * surface.depth_m / focal_px
    return np.clip(surface.flattening_m, -limit, limit)


def _island_size(field: MatchedField) -> np.ndarray:
    """(N,) size of the connected group of each point."""
    from scipy.ndimage import label

    taken = np.zeros(field.grid.shape, dtype=bool)
    taken.ravel()[field.cell] = True
    islands, _ = label(taken, structure=np.ones((3, 3)))
    size = np.bincount(islands.ravel())
    return np.asarray(size[islands.ravel()[field.cell]])


def as_written(cloud: PointCloud, settings: SurfaceSettings) -> PointCloud:
    """The cloud that is written to a file, thinned if the settings ask for it."""
    return voxel_filtered(cloud, 1e-3 * settings.voxel_mm, settings.voxel_points) if settings.voxel_mm else cloud


def voxel_filtered(cloud: PointCloud, edge_m: float, fewest: int) -> PointCloud:
    """The cloud with one point for every cube of side `edge_m` that contains `fewest` points or more, in the order of the cubes.

    A view counts for a cube only if all of its points were matched there.
    """
    if not len(cloud.xyz_m):
        return cloud
    _, cube, count = np.unique(np.floor(cloud.xyz_m / edge_m).astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    cube = cube.reshape(-1)
    weight = 1 / np.maximum(np.trace(cloud.covariance_m2, axis1=1, axis2=2), 1e-18)
    weight /= np.bincount(cube, weight)[cube]
    enough = count >= fewest

    def mean(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        columns = [np.bincount(cube, weight * column, minlength=len(count)) for column in flat.T]
        return np.stack(columns, axis=1).reshape(-1, *values.shape[1:])[enough]

    normals = mean(cloud.normals)
    return PointCloud(
        frame=cloud.frame,
        xyz_m=mean(cloud.xyz_m),  # (1)
        covariance_m2=mean(cloud.covariance_m2),
        normals=normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12),
        intensity=mean(cloud.intensity),
        xy_px=mean(cloud.xy_px),
        residual_px=mean(cloud.residual_px),
        extended=mean(cloud.extended.astype(np.float64)) >= 0.5,
    )


def write_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as clouds/NNNN.ply (docs/formats.md), whole or not at all."""
    ply.write_cloud(
        path,
        xyz_m=cloud.xyz_m,
        sigma_m=cloud.sigma_m,
        normals=cloud.normals,
        intensity=cloud.intensity,
        rays=cloud.rays,
        extended=cloud.extended,
    )
