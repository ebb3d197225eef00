"""Thinning a cloud evenly: the points in a cube of space are replaced by their centre of gravity (D'Apuzzo et al. 2000, §2.3).

With weights w_i ∝ 1 / tr K_i, Σ w_i = 1,

    X = Σ w_i X_i ,   K = Σ w_i K_i                                                                  (1)

The patches of neighbouring points overlap, so their errors are alike: K is what the mean of wholly dependent points has, at most.
"""

import numpy as np

from .cloud import PointCloud, SurfaceSettings


def as_written(cloud: PointCloud, settings: SurfaceSettings) -> PointCloud:
    """The cloud that is written to a file: thinned where that was asked for."""
    return voxel_filtered(cloud, 1e-3 * settings.voxel_mm, settings.voxel_points) if settings.voxel_mm else cloud


def voxel_filtered(cloud: PointCloud, edge_m: float, fewest: int) -> PointCloud:
    """The cloud with one point for every cube of side `edge_m` that holds `fewest` points or more, in the order of the cubes.

    A point of cubes counts a view only if all of its points were measured there.
    """
    if not len(cloud.xyz_m):
        return cloud
    _, cube, count = np.unique(np.floor(cloud.xyz_m / edge_m).astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    cube = cube.reshape(-1)
    weight = 1 / np.maximum(np.trace(cloud.covariance_m2, axis1=1, axis2=2), 1e-18)
    weight /= np.bincount(cube, weight)[cube]
    kept = count >= fewest

    def mean(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        columns = [np.bincount(cube, weight * column, minlength=len(count)) for column in flat.T]
        return np.stack(columns, axis=1).reshape(-1, *values.shape[1:])[kept]

    normals = mean(cloud.normals)
    return PointCloud(
        frame=cloud.frame,
        xyz_m=mean(cloud.xyz_m),  # (1)
        covariance_m2=mean(cloud.covariance_m2),
        normals=normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12),
        intensity=mean(cloud.intensity),
        xy_px=mean(cloud.xy_px),
        residual_px=mean(cloud.residual_px),
    )
