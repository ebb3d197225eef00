"""The measured surface against planes and cylinders that are known exactly: bias, scatter, sigma, curvature, fields, mirrors."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.surface.cloud import LIMB_SCATTER, ROUGHNESS, PointCloud, SurfaceSettings, point_cloud, why_removed
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

TILT = rotation_from_vector(np.array([0.1, 0.25, 0.0]))


def inner(body: Any, cloud: PointCloud, margin_m: float) -> np.ndarray:
    """Points (N,) whose patch lies on the body, by their own coordinates."""
    own = (cloud.xyz_m - body.t) @ body.R
    return (np.abs(own[:, :2]) < np.array(body.half_m) - margin_m).all(axis=1)


def along_normal(body: Any, cloud: PointCloud) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance (N,) and its reported standard deviation (N,) along the true normal, in metres."""
    own = (cloud.xyz_m - body.t) @ body.R
    normal = np.tile([0.0, 0.0, -1.0], (len(own), 1)) if body.radius_m is None else own * [1, 0, 1]
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True) @ body.R.T
    return body.distance_m(cloud.xyz_m), np.sqrt(np.einsum("ni,nij,nj->n", normal, cloud.covariance_m2, normal))


@pytest.mark.slow
@pytest.mark.parametrize(("interlaced", "noise"), [("none", 0.5), ("none", 2.0), ("none", 4.0), ("odd", 2.0), ("even", 2.0)])
def test_a_plane(tmp_path: Path, scenes: Any, interlaced: str, noise: float) -> None:
    """Bias, scatter and sigma along the normal, away from the plane's edge. 1 px of disparity is 22 mm here: measured bias −0.07 mm at
    every noise level (0.003 px: the affine patch on a perspective image); scatter 0.065, 0.25, 0.53 and, in fields, 0.35 mm; z 0.8."""
    plane = scenes.Body(half_m=(0.3, 0.25), R=TILT)
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[plane]], noise=noise, interlaced=interlaced)
    (m,) = scenes.measure(take, tmp_path / "out", {"surface": {"correct_curvature": False}})
    inside = inner(plane, m.cloud, 0.03)
    distance, sigma = (k[inside] for k in along_normal(plane, m.cloud))
    assert inside.sum() > 950  # of 1134 cells there
    assert abs(distance.mean()) < 1.5e-4
    assert distance.std() < {0.5: 1.1e-4, 2.0: 4.5e-4, 4.0: 7.5e-4}[noise]
    assert 0.6 < (distance / sigma).std() < 1.25
    assert np.abs(distance).max() < 30 * max(noise, 1) * 1e-4  # nothing gross
    assert np.degrees(np.arccos(m.cloud.normals[inside] @ -plane.R[:, 2])).max() < 4.0 * max(1.0, noise)


@pytest.mark.parametrize("interlaced", ["none", "odd", "even"])
def test_points_lie_at_their_place_in_the_full_frame(tmp_path: Path, scenes: Any, interlaced: str) -> None:
    """The stored pixels of every view are the projections of the surface's point, to 0.05 px also down the rows of a field."""
    rig, plane = scenes.three_cameras(), scenes.Body(half_m=(0.3, 0.25), R=TILT)
    take = scenes.write_take(tmp_path / "take", rig, [[plane]], noise=0.5, interlaced=interlaced)
    (m,) = scenes.measure(take, tmp_path / "out")
    inside = inner(plane, m.cloud, 0.03)
    base = rig.cameras[1]
    s, _ = plane.hit(base.centre_m, base.rays(m.cloud.xy_px[:, 1]))  # the true point behind the template's pixel
    true = base.points_at_depth(m.cloud.xy_px[:, 1], s)
    for k, camera in enumerate(rig.cameras):
        error = (m.cloud.xy_px[:, k] - camera.project(true))[inside]
        assert np.abs(np.median(error, axis=0)).max() < 0.01, camera.name
        assert np.percentile(np.abs(error), 99, axis=0).max() < 0.05, camera.name  # measured 0.03
    rows = open_rows(interlaced)
    nearest = np.abs(m.cloud.xy_px[:, 1, 1] - rows[np.abs(m.cloud.xy_px[:, 1, 1][:, None] - rows).argmin(axis=1)])
    assert nearest.max() < 6.5  # the texture's centre of gravity lies within the patch


def open_rows(interlaced: str) -> np.ndarray:
    return {"none": np.arange(150), "odd": np.arange(0, 150, 2), "even": np.arange(1, 150, 2)}[interlaced].astype(float)


def test_curvature_correction_halves_the_bias_of_a_cylinder(tmp_path: Path, scenes: Any) -> None:
    """Radius 40 mm at 3.6 mm/px, patch 13: the whole cylinder is 22 px wide. Without the correction every point lies 3 mm inside; with it
    the mean is 0.42–0.48 of that over all points (at the outline a patch lies half on the background), −0.2 of it where patches fit."""
    all_mean, inner_median = [], []
    for seed in range(2):
        cylinder = scenes.Body(radius_m=0.040, half_m=(1.0, 0.2), seed=seed)
        take = scenes.write_take(tmp_path / f"take{seed}", scenes.three_cameras(), [[cylinder]], noise=1.0)
        of_all, of_inner = [], []
        for correct in (False, True):
            (m,) = scenes.measure(take, tmp_path / f"out{seed}{correct}", {"surface": {"correct_curvature": correct}})
            own = (m.cloud.xyz_m - cylinder.t) @ cylinder.R
            on_it = (np.abs(own[:, 0]) < 0.0165) & (np.abs(own[:, 1]) < 0.17)
            assert len(own) > 150 and on_it.sum() > 25
            distance = cylinder.distance_m(m.cloud.xyz_m)
            of_all.append(distance.mean())
            of_inner.append(np.median(distance[on_it]))
        all_mean.append(of_all)
        inner_median.append(of_inner)
    (plain, corrected), (plain_inner, corrected_inner) = np.mean(all_mean, axis=0), np.mean(inner_median, axis=0)
    assert -4.5e-3 < min(plain, plain_inner)  # ½ · 14 px² · (3.6 mm)² / 40 mm = 2.3 mm on its axis, more beside it
    small = 0.25 * scenes.pixel_m  # where the matching itself knows the curvature, there is little left to correct
    assert abs(corrected_inner) < max(0.5 * abs(plain_inner), small)
    assert abs(corrected) < max(0.52 * abs(plain), small)


def test_a_rounder_bodys_sigma_tells_what_is_left(tmp_path: Path, scenes: Any) -> None:
    """Radius 120 mm: measured −1.0 mm without and −0.05 mm with the correction (medians); the sigma contains half of the correction."""
    cylinder = scenes.Body(radius_m=0.120, half_m=(1.0, 0.2))
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[cylinder]], noise=1.0)
    (m,) = scenes.measure(take, tmp_path / "out")
    own = (m.cloud.xyz_m - cylinder.t) @ cylinder.R
    on_it = (np.abs(own[:, 0]) < 0.08) & (np.abs(own[:, 1]) < 0.17)
    distance, sigma = (k[on_it] for k in along_normal(cylinder, m.cloud))
    assert abs(np.median(distance)) < 2.5e-4
    assert np.mean(np.abs(distance) < 2 * sigma) > 0.85
    assert 0.4 < np.sqrt(np.mean((distance / sigma) ** 2)) < 1.5
    normal = (own * [1, 0, 1])[on_it]
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True) @ cylinder.R.T
    assert np.median(np.degrees(np.arccos(np.clip((normal * m.cloud.normals[on_it]).sum(axis=1), -1, 1)))) < 5


def mirrored(rig: Rig) -> Rig:
    """The rig seen in a mirror x → −x, whose pictures are the mirrored pictures."""
    M, cameras = np.diag([-1.0, 1.0, 1.0]), []
    for c in rig.cameras:
        matrix = c.matrix.copy()
        matrix[0, 2] = c.size_px[0] - 1 - matrix[0, 2]
        cameras.append(
            Camera(name=c.name, size_px=c.size_px, matrix=matrix, distortions=c.distortions * [1, 1, 1, -1, 1],
                   R_cam_world=M @ c.R_cam_world @ M, t_cam_world_m=M @ c.t_cam_world_m)
        )  # fmt: skip
    return Rig(cameras=tuple(cameras))


def test_mirrored_pictures_give_the_mirrored_cloud(tmp_path: Path, scenes: Any) -> None:
    import cv2

    rig = scenes.three_cameras(width=201)  # 201 = 50 cells of 4 px and one: the grid is its own mirror image
    plane = scenes.Body(half_m=(0.2, 0.15), R=TILT)
    take = scenes.write_take(tmp_path / "take", rig, [[plane]], noise=1.0)
    other = scenes.write_take(tmp_path / "mirror", mirrored(rig), [[]], noise=0.0)
    for view in "LCR":
        picture = cv2.imdecode(np.fromfile(take / view / "0000.png", np.uint8), cv2.IMREAD_UNCHANGED)
        (other / view / "0000.png").write_bytes(cv2.imencode(".png", picture[:, ::-1])[1].tobytes())
    a, b = (scenes.measure(folder, tmp_path / f"out {folder.name}")[0].cloud for folder in (take, other))
    inside = inner(plane, a, 0.03)
    distance = np.linalg.norm(a.xyz_m[inside][:, None] - (b.xyz_m * [-1, 1, 1])[None], axis=2).min(axis=1)
    assert abs(len(a.xyz_m) - len(b.xyz_m)) < 0.02 * len(a.xyz_m)
    assert np.mean(distance < 5e-5) > 0.97  # 0.002 px of disparity, where the iteration ends; the rest came from another neighbour
    assert np.abs(distance).max() < 1e-3


def test_nothing_is_measured_on_what_has_no_texture(tmp_path: Path, scenes: Any) -> None:
    """A textured plane before a bare wall: the cloud ends at the plane, except for patches that hang over its edge."""
    plane = scenes.Body(half_m=(0.12, 0.12))
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[plane]], noise=1.0)
    (m,) = scenes.measure(take, tmp_path / "out")
    own = (m.cloud.xyz_m - plane.t) @ plane.R
    assert len(own) > 150 and np.abs(own[:, :2]).max() < 0.12 + 3 * scenes.pixel_m
    assert np.mean(np.abs(plane.distance_m(m.cloud.xyz_m)) < 0.002) > 0.9


def test_clouds_and_fields_of_nothing(scenes: Any) -> None:
    z = np.zeros
    empty = PointCloud(frame=0, xyz_m=z((0, 3)), covariance_m2=z((0, 3, 3)), normals=z((0, 3)), intensity=z(0),
                       xy_px=z((0, 3, 2)), residual_px=z(0), extended=z(0))  # fmt: skip
    assert empty.sigma_m.shape == (0,)
    with pytest.raises(ValueError):
        empty.xyz_m[...] = 1


def test_each_filter_says_what_it_took(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    """Points moved off a plane disagree with it; a corner that is cut off is a small island; with a small limit it remains."""
    footage = open_take(read_take(plane_take))
    field, ref = scenes.measure(plane_take, tmp_path / "out")[0].field, footage.take.reference
    camera = footage.rig.cameras[ref]
    row, column = field.cell // field.grid.shape[1], field.cell % field.grid.shape[1]
    near = (row - row.min() < 3) & (column - column[row - row.min() < 3].min() < 4)
    far = row - row.min() > 8
    kept = field.select(near | far)
    moved = np.zeros(len(kept.cell), dtype=bool)
    moved[[len(moved) // 2, len(moved) - 200]] = True
    shifted = replace(kept, xyz_m=np.where(moved[:, None], camera.centre_m + 1.3 * (kept.xyz_m - camera.centre_m), kept.xyz_m))
    why = why_removed(shifted, camera, ref, SurfaceSettings(min_island=int(near.sum()) + 1))
    assert near.sum() >= 6 and (why[moved] == 1).all() and (why[near[near | far]] == 2).all()
    assert (why[~moved & far[near | far]] == 0).mean() > 0.97
    assert not (why_removed(kept, camera, ref, SurfaceSettings(min_island=1)) == 2).any()


def test_neighbours_that_scatter_make_a_point_less_sure(tmp_path: Path, scenes: Any) -> None:
    """A plane with the noise of its covariances: nothing is added. Rougher than that: the excess is added along the ray."""
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[scenes.Body()]], noise=0.5)
    (m,) = scenes.measure(take, tmp_path / "out")
    camera, sigma_m, random = scenes.three_cameras().cameras[1], 1e-3, np.random.default_rng(0)
    ray = camera.rays(m.cloud.xy_px[:, 1])
    depth = camera.to_camera(m.cloud.xyz_m)[:, 2]
    explained_m = LIMB_SCATTER * m.field.grid.spacing_px * scenes.pixel_m
    added = []
    for scatter_m in (0.3e-3, 4e-3):
        xyz = camera.centre_m + ray * (depth + scatter_m * random.standard_normal(len(ray)))[:, None]
        K = sigma_m**2 * ray[:, :, None] * ray[:, None]
        cloud = point_cloud(replace(m.field, xyz_m=xyz, covariance_m2=K), np.zeros((150, 200)), camera, 1, 0, SurfaceSettings())
        added.append(np.einsum("ni,nij,nj->n", ray, cloud.covariance_m2 - K, ray) / np.einsum("ni,ni->n", ray, ray) ** 2)
    assert np.abs(added[0]).max() < 1e-12
    assert np.median(added[1]) == pytest.approx(ROUGHNESS * (4e-3**2 - sigma_m**2 - explained_m**2), rel=0.25)
