"""The surface continued over weak texture: more of it, no worse, with true sigmas, and nothing where texture is strong."""

from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tricap.core.foundation.progress import Monitor
from tricap.core.images.interlace import RowGrid
from tricap.core.images.sampling import SplineImage
from tricap.core.matching import occlusion_check
from tricap.core.matching.constraints import constrain
from tricap.core.matching.extension import extend
from tricap.core.matching.foreground import Foreground
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.matching.occlusion_check import EXTENDED_M, SURROUNDED_M, fails_occlusion_check
from tricap.core.matching.patches import TemplatePatches
from tricap.core.matching.region_growing import GrowingSettings, MatchedField, grow_regions
from tricap.core.matching.seeds import sweep_seeds
from tricap.core.matching.views import Views, template_grid
from tricap.core.surface.cloud import SurfaceSettings, point_cloud
from tricap.core.surface.measure import MeasuredFrame

EVERYWHERE = Foreground(depth_range_m=(1.0, 2.0), method="everything")
SETTINGS = MatchingSettings()


def measured(surfaces: ModuleType, kind: str, noise: float) -> tuple[Views, MatchedField, Any]:
    """The views of a cylinder, its constrained field, and the cylinder."""
    surface = surfaces.cylinder(0.06)
    rig, grey = surfaces.render(surface, kind, seed=3, noise=noise)
    views = Views(images=[SplineImage(g) for g in grey], cameras=rig, reference=1, rows=RowGrid())
    grid = template_grid(views.template.shape, RowGrid(), 4)
    seeds = sweep_seeds(views, grid, SETTINGS, spacing_px=24, depth_range_m=(1.1, 1.8), monitor=Monitor())
    field = grow_regions(views, grid, seeds, SETTINGS, GrowingSettings(bigger_patches=1), foreground=EVERYWHERE, monitor=Monitor())
    return views, constrain(field, views, SETTINGS, foreground=EVERYWHERE, monitor=Monitor()), surface


@pytest.fixture(scope="module")
def weak(surfaces: ModuleType) -> tuple[Views, MatchedField, Any]:
    return measured(surfaces, "weak", noise=3.0)


def test_seeds_about_places_are_those_that_lie_there(weak: tuple[Views, MatchedField, Any]) -> None:
    views, field, _ = weak
    everywhere = sweep_seeds(views, field.grid, SETTINGS, spacing_px=24, depth_range_m=(1.1, 1.8), monitor=Monitor())
    places, reach = everywhere.xy[[3, 12], views.reference] + 5.0, np.array([40.0, 30.0])
    found = sweep_seeds(views, field.grid, SETTINGS, spacing_px=24, depth_range_m=(1.1, 1.8), near_px=(places, reach), monitor=Monitor())
    there = (np.abs(everywhere.xy[:, None, views.reference] - places) <= reach).all(axis=2).any(axis=1)
    assert 1 < there.sum() < len(there)
    assert np.array_equal(found.xy, everywhere.xy[there])


def extended(views: Views, field: MatchedField) -> MatchedField:
    return extend(field, views, SETTINGS, foreground=EVERYWHERE, monitor=Monitor())


def test_weak_texture_is_extended(weak: tuple[Views, MatchedField, Any]) -> None:
    """A third more points (measured: 43 %), as good as the others, with sigmas that are not too small, each cell once."""
    views, field, surface = weak
    more = extended(views, field)
    new = more.extended
    assert field.weak_texture and not field.extended.any()
    assert new.sum() > 0.3 * len(field.cell) and np.array_equal(more.cell[~new], field.cell)
    assert (np.diff(more.cell) > 0).all()
    off = np.abs(surface.distance_m(more.xyz_m))
    assert np.median(off[new]) < 1.5 * np.median(off[~new])
    assert np.percentile(off[new], 95) < 6e-3
    sigma = np.sqrt(np.trace(more.covariance_m2, axis1=1, axis2=2))
    assert np.sqrt(np.mean((off / sigma)[new] ** 2)) < 1.0


def test_strong_texture_stays_as_it_was(surfaces: ModuleType) -> None:
    views, field, _ = measured(surfaces, "strong", noise=1.0)
    assert not field.weak_texture
    assert extended(views, field) is field


def test_points_outside_the_foreground_are_left_out(weak: tuple[Views, MatchedField, Any]) -> None:
    views, field, _ = weak
    nowhere = Foreground(depth_range_m=(0.1, 0.2), method="nowhere")
    assert not extend(field, views, SETTINGS, foreground=nowhere, monitor=Monitor()).extended.any()


def test_an_empty_image_gives_no_points(weak: tuple[Views, MatchedField, Any]) -> None:
    """The neighbours' surface invents nothing where the images show only noise."""
    views, field, _ = weak
    random = np.random.default_rng(0)
    empty = [SplineImage((100 + 3 * random.standard_normal(image.shape)).astype(np.float32)) for image in views.images]
    assert extended(replace(views, images=empty), field).extended.sum() < 0.02 * len(field.cell)


def test_the_centre_of_weak_texture_is_not_drawn_by_noise() -> None:
    """Texture on one side of a patch, and noise of three quarters of the gradients' energy everywhere."""
    random = np.random.default_rng(1)
    x = np.arange(64.0)
    texture = 6 * np.sin(x / 1.5) * np.exp(-0.5 * ((x - 36) / 2.0) ** 2)
    image = SplineImage((100 + texture + 1.5 * random.standard_normal((64, 64))).astype(np.float32))
    at = np.column_stack([np.full(24, 32.0), np.arange(20.0, 44.0)])
    plain, clean = (TemplatePatches(image, at, 17, 1, without_noise=flag).offset[:, 0].mean() for flag in (False, True))
    assert plain < 3.3 and 3.5 < clean < 4.5


def test_surrounded_points_on_weak_texture_need_no_texture_of_their_own(
    weak: tuple[Views, MatchedField, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Uncertain points pass within a surface; at its rim, and on strong texture, they do not. Extended ones have their own limit."""
    views, field, _ = weak
    column, row = field.cell % field.grid.shape[1], field.cell // field.grid.shape[1]
    block = (np.abs(column - np.median(column)) <= 7) & (np.abs(row - np.median(row)) <= 7)
    field = field.select(block)
    between = np.full(len(field.cell), (EXTENDED_M + SURROUNDED_M) / 2)
    between[: len(between) // 3 * 2] = 1e-3  # most points are certain
    monkeypatch.setattr(occlusion_check, "depth_uncertainty", lambda *a, **k: between)
    monkeypatch.setattr(occlusion_check, "over_outline", lambda *a: np.zeros(len(between)))
    assert not fails_occlusion_check(field, views, SETTINGS).any()
    assert fails_occlusion_check(replace(field, weak_texture=False), views, SETTINGS).any()
    monkeypatch.setattr(occlusion_check, "over_outline", lambda *a: np.ones(len(between)))
    assert fails_occlusion_check(field, views, SETTINGS).any()
    between[:] = 0.012
    between[0] = 0.1
    assert fails_occlusion_check(field, views, SETTINGS).sum() == 1
    between[:] = (EXTENDED_M + SURROUNDED_M) / 2  # usual in these images, but not enough for points from their neighbours
    assert not fails_occlusion_check(field, views, SETTINGS).any()
    assert fails_occlusion_check(replace(field, extended=np.ones(len(between), dtype=bool)), views, SETTINGS).all()


def test_tracks_start_from_patches_alone(weak: tuple[Views, MatchedField, Any]) -> None:
    views, field, _ = weak
    more = extended(views, field)
    grey = np.full(views.template.shape, 100.0)
    cloud = point_cloud(more, grey, views.base, views.reference, 0, SurfaceSettings())
    none = np.zeros((0, 3, 2)), np.zeros(0, dtype=np.uint8)
    frame = MeasuredFrame(
        frame=0, field=more, cloud=cloud, foreground=EVERYWHERE, key="", removed_px=none[0], removed_why=none[1], smoothed_px=0.0
    )
    assert np.array_equal(cloud.extended, more.extended) and 0 < cloud.extended.sum() < len(more.cell)
    assert np.array_equal(frame.of_patches.field.cell, field.cell)
    assert np.array_equal(frame.of_patches.cloud.xyz_m, cloud.xyz_m[~more.extended])
    only = frame.of_patches
    assert only.of_patches is only
