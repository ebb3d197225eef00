"""The coarse surface: right to its sigma, nearly complete, the same on any number of threads, and empty where no views are alike."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.fitting.inputs.completed_clouds import CompletedClouds
from tricap.core.fitting.inputs.fit_input import BackgroundDistances, Packed
from tricap.core.geometry.camera import Camera
from tricap.core.images.interlace import RowGrid
from tricap.core.matching.semi_global import CoarseSurface, coarse_surface
from tricap.core.surface.cloud import PointCloud

BOARD_M, STRIP_M = 2.16, 2.0  # depths of a board with weak texture, and of a strip before it that is no wider than two patches
HALF_M, STRIP_HALF_M = (0.2, 0.15), (0.03, 0.1)
NEAR_M = np.array([[x, y, BOARD_M] for x in (-0.2, 0.2) for y in (-0.15, 0.15)])


def _bodies(scenes: Any) -> list[Any]:
    board = scenes.Body(half_m=HALF_M, contrast=8.0, seed=1)
    return [board, scenes.Body(half_m=STRIP_HALF_M, t=np.array([0.0, 0.0, STRIP_M]), contrast=8.0, seed=2)]


def _seen(scenes: Any, cameras: Sequence[Camera], rows: RowGrid | None = None) -> CoarseSurface:
    images = [scenes.render(camera, _bodies(scenes), noise=2.0, seed=k) for k, camera in enumerate(cameras)]
    images = [(rows or RowGrid()).rows(image) for image in images]
    return coarse_surface(images, cameras, min(1, len(cameras) - 1), NEAR_M, rows)


@pytest.mark.parametrize("views, rows", [((0, 1, 2), None), ((0, 1), None), ((0, 1, 2), RowGrid(step=2, offset=1))])
def test_a_strip_before_a_board_with_weak_texture(scenes: Any, views: tuple[int, ...], rows: RowGrid | None) -> None:
    """All of both surfaces, with normals towards the camera; half of the points within half of their sigma and 1 cm."""
    cameras = [scenes.three_cameras(height=300).cameras[k] for k in views]
    found = _seen(scenes, cameras, rows)
    own = (np.abs(found.xyz_m[:, :2]) < HALF_M).all(axis=1) & (found.xyz_m[:, 2] < BOARD_M + 0.2)
    depth = found.xyz_m[own, 2]
    error = np.minimum(np.abs(depth - BOARD_M), np.abs(depth - STRIP_M))
    assert np.median(error) < 0.01 and np.median(error / found.sigma_m[own]) < 0.67 and (error > 0.05).mean() < 0.03
    for z, half in ((BOARD_M, HALF_M), (STRIP_M, STRIP_HALF_M)):
        surface = found.xyz_m[np.abs(found.xyz_m[:, 2] - z) < 0.05]
        x, y = (np.linspace(-0.8 * h, 0.8 * h, 9) for h in half)
        places = np.stack([*np.meshgrid(x, y), np.full((9, 9), z)], axis=-1).reshape(-1, 3)
        behind = (z == BOARD_M) & (np.abs(places[:, 0]) < 2.5 * STRIP_HALF_M[0])  # the strip hides it in one of the views
        gap = np.linalg.norm(places[~behind, None] - surface, axis=2).min(axis=1)
        assert (gap < 0.025).mean() > 0.9
    known = found.normals[own].any(axis=1)
    assert known.mean() > 0.7 and np.median(-found.normals[own][known][:, 2]) > 0.97


def test_bytes_do_not_depend_on_threads(scenes: Any) -> None:
    cameras, before = scenes.three_cameras().cameras, cv2.getNumThreads()
    found = []
    try:
        for threads in (1, 3):
            cv2.setNumThreads(threads)
            found.append(_seen(scenes, cameras))
    finally:
        cv2.setNumThreads(before)
    assert found[0].xyz_m.tobytes() == found[1].xyz_m.tobytes() and found[0].normals.tobytes() == found[1].normals.tobytes()


def test_large_images_are_reduced(scenes: Any) -> None:
    """Twice the pixels give about as many points, which lie as well."""
    small, large = (scenes.three_cameras(width=k * 200, height=k * 150, focal=k * 600.0).cameras for k in (1, 2))
    few, many = _seen(scenes, small), _seen(scenes, large)
    near = [np.abs(found.xyz_m[:, 2] - BOARD_M) < 0.05 for found in (few, many)]
    assert 0.8 < near[1].sum() / near[0].sum() < 1.25
    assert np.median(np.abs(many.xyz_m[near[1], 2] - BOARD_M)) < 0.01


def test_nothing_without_a_view_nearby_or_a_person(scenes: Any) -> None:
    left, centre, _ = scenes.three_cameras().cameras
    turned = replace(left, t_cam_world_m=-left.R_cam_world @ np.array([-3.0, 0.0, 0.0]))  # 3 m aside, of something 2 m away
    assert not len(_seen(scenes, [turned, centre]).xyz_m)
    assert not len(coarse_surface([np.zeros((150, 200))] * 2, [left, centre], 1, np.zeros((0, 3))).xyz_m)
    behind = NEAR_M - (0.0, 0.0, 2 * BOARD_M)
    assert not len(coarse_surface([np.zeros((150, 200))] * 2, [left, centre], 1, behind).xyz_m)


def test_clouds_are_completed_where_the_person_is_and_nothing_was_measured(scenes: Any) -> None:
    rig = scenes.three_cameras()
    coarse = _seen(scenes, rig.cameras)
    measured = np.array([[0.0, 0.0, STRIP_M]])
    cloud = PointCloud(
        frame=0, xyz_m=measured, covariance_m2=np.eye(3)[None] * 1e-6, normals=-np.eye(3)[2:], intensity=np.zeros(1),
        xy_px=np.zeros((1, 3, 2)), residual_px=np.zeros(1), extended=np.zeros(1),
    )  # fmt: skip
    shown = scenes.render(rig["C"], _bodies(scenes)[1:], background=-1.0) >= 0  # the strip is the person
    distance = Packed([np.where(shown, 0, 9)])
    view = BackgroundDistances(view="C", frame=np.array([0]), distance=distance, step_px=1, unit_px=0.5)
    (completed,) = CompletedClouds(clouds=[cloud], coarse=[coarse], rig=rig, background=[view])
    added = completed.xyz_m[1:]
    assert completed.xyz_m[0].tolist() == measured[0].tolist() and completed.covariance_m2.shape == (len(added) + 1, 3, 3)
    assert len(added) > 50 and (np.abs(added[:, :2]) < np.add(STRIP_HALF_M, 0.01)).all()
    assert np.linalg.norm(added - measured, axis=1).min() > 0.012
    (alone,) = CompletedClouds(clouds=[cloud], coarse=[coarse], rig=rig, background=[])
    assert len(alone.xyz_m) == 1
