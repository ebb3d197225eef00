"""The sweep along rays: places interpolated between few projections, and how far and how finely depths are searched."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.images.interlace import RowGrid
from tricap.core.matching import seeds
from tricap.core.matching.foreground import NEARER, Foreground, after

XY = np.stack(np.meshgrid(np.linspace(5, 190, 7), np.linspace(5, 140, 6)), axis=-1).reshape(-1, 2)


def views_of(scenes: Any, base_m: float = 0.35, search: tuple[int, ...] = (0, 2)) -> Any:
    cameras = scenes.three_cameras(base_m=base_m).cameras
    rows = RowGrid()
    return SimpleNamespace(cameras=cameras, base=cameras[1], reference=1, search=search, rows=rows)


@pytest.mark.parametrize(("base_m", "nearest_m"), [(0.35, 1.2), (0.35, 0.3), (3.0, 0.05)])
def test_places_along_rays_are_those_of_their_projection(scenes: Any, base_m: float, nearest_m: float) -> None:
    """Also of rays that run through the plane of the other camera, and behind it."""
    views = views_of(scenes, base_m)
    inverse = np.linspace(1 / 8.0, 1 / nearest_m, 301)
    for k in views.search:
        exact = seeds._image_of(views.cameras[k], views.rows, seeds._corners(views.base, views.rows, XY, 1 / inverse[None]))
        at, shape = seeds._along_rays(views, k, XY, inverse)
        w, h = views.cameras[k].size_px
        near = (np.abs(exact[0] - (w / 2, h / 2)) < 2 * w).all(axis=-1)
        assert near.any() and np.abs(at - exact[0])[near].max() < 2e-3 and np.abs(shape - exact[1])[near].max() < 2e-4
        far = ~near & np.isfinite(at).all(axis=-1)
        assert (np.abs(at[far] - (w / 2, h / 2)) > w).any(axis=-1).all(), "nothing is seen where nothing is"


def test_no_points_have_no_places(scenes: Any) -> None:
    at, shape = seeds._along_rays(views_of(scenes), 0, np.zeros((0, 2)), np.linspace(0.1, 1.0, 50))
    assert at.shape == (0, 50, 2) and shape.shape == (0, 50, 2, 2)


def test_cubics_through_neighbours_are_exact_for_cubics() -> None:
    x, knots = np.linspace(0, 9, 57), np.arange(10.0)
    weights = seeds._cubic_weights(x, len(knots))
    for power in range(4):
        assert np.allclose(weights @ knots**power, x**power, atol=1e-9)


def test_a_camera_that_is_not_matched_makes_the_sweep_no_finer(scenes: Any) -> None:
    counts = [len(seeds._inverse_depths(views_of(scenes, search=search), 1.0, 8.0)) for search in ((0, 2), (0,))]
    assert counts[0] == counts[1]
    far = views_of(scenes)
    far.cameras = (far.cameras[0], far.cameras[1], scenes.three_cameras(base_m=5.0).cameras[2])
    far.search = (0,)
    assert len(seeds._inverse_depths(far, 1.0, 8.0)) == counts[0]


def test_a_person_does_not_come_nearer_than_half_her_depth_from_frame_to_frame() -> None:
    depth = np.random.default_rng(2).uniform(0.45, 0.7, 400)
    near, far = after(depth, Foreground(depth_range_m=(0.4, 0.8), method="frame before")).depth_range_m
    assert near == pytest.approx(NEARER * np.percentile(depth, 1)) and far > near + 0.4
