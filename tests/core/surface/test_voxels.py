"""One point for a cube of space: weighted by sigma, on the surface, with a calibrated sigma; in the written cloud only."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.progress import Monitor
from tricap.core.motion.formats.ply import read_ply
from tricap.core.run import pipeline, take_run
from tricap.core.surface import measure
from tricap.core.surface.cloud import PointCloud, voxel_filtered

EDGE_M = 0.01


def scattered(random: np.random.Generator, n: int = 4000) -> PointCloud:
    """Points of the plane z = 0.5004 with errors of 0.2 mm in one half and 2 mm in the other, all alike within a cube."""
    xyz = np.column_stack([random.uniform(0, 0.2, n), random.uniform(0, 0.1, n), np.full(n, 0.5044)])
    sigma = np.where(np.arange(n) % 2, 2e-3, 2e-4)
    cube = np.unique(np.floor(xyz / EDGE_M).astype(int), axis=0, return_inverse=True)[1].reshape(-1)
    xyz[:, 2] += sigma * np.clip(random.standard_normal(cube.max() + 1), -2, 2)[cube]
    K = sigma[:, None, None] ** 2 * np.diag([1e-4, 1e-4, 1.0])
    seen = np.ones((n, 3, 2))
    seen[::50, 2] = np.nan
    return PointCloud(frame=3, xyz_m=xyz, covariance_m2=K, normals=np.tile([0, 0, -1.0], (n, 1)), intensity=np.full(n, 90.0), xy_px=seen,
                      residual_px=np.zeros(n), extended=np.arange(n) % 2)  # fmt: skip


def test_the_centre_of_gravity_and_its_sigma() -> None:
    cloud = scattered(np.random.default_rng(1))
    thin = voxel_filtered(cloud, EDGE_M, 2)
    cubes = np.floor(thin.xyz_m / EDGE_M).astype(int)
    assert len(thin.xyz_m) == len(np.unique(cubes, axis=0)) == 200 and thin.frame == 3
    error = thin.xyz_m[:, 2] - 0.5044
    assert error.std() < 3e-4  # the poor half hardly counts
    assert 0.7 < (error / np.sqrt(thin.covariance_m2[:, 2, 2])).std() < 1.3
    assert np.allclose(thin.normals, (0, 0, -1)) and np.allclose(thin.intensity, 90)
    assert cloud.extended.mean() == 0.5 and not thin.extended.any()  # the poor half is the extended one
    pair = np.unique(np.floor(cloud.xyz_m[::50] / EDGE_M).astype(int), axis=0)
    assert ((thin.rays == 2) == (cubes[:, None] == pair).all(axis=2).any(axis=1)).all()


def test_lonely_points_are_left_out() -> None:
    cloud = scattered(np.random.default_rng(2), 300)
    _, count = np.unique(np.floor(cloud.xyz_m / EDGE_M).astype(int), axis=0, return_counts=True)
    assert [len(voxel_filtered(cloud, EDGE_M, n).xyz_m) for n in (1, 2, 3)] == [len(count), (count > 1).sum(), (count > 2).sum()]
    assert len(voxel_filtered(cloud.select(slice(0, 0)), EDGE_M, 2).xyz_m) == 0


def test_only_the_file_is_thinned(plane_take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same checkpoints serve any size of cube; the frames that the fit takes stay as they were measured."""
    sizes = []
    for edge_mm in (0.0, 30.0):
        settings = {"growing": {"spacing_px": 6}, "surface": {"voxel_mm": edge_mm}}
        with take_run.open_run(plane_take, tmp_path / "out", settings, (0, 1)) as run:
            pipeline.measure(run, Monitor())
            sizes.append((len(read_ply(tmp_path / "out" / "clouds" / "0000.ply").xyz_m), len(run.clouds[0].xyz_m)))
        monkeypatch.setattr(measure, "_measure", None)
    assert sizes[0][0] == sizes[0][1] == sizes[1][1] > 3 * sizes[1][0] > 300
