"""The texture of a skin: a painted arm is filmed, and its paint found again from where it was seen."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.person_skin import rest_skin
from tricap.core.body.skin.posed import Poser
from tricap.core.body.skin.surface_operators import vertex_normals
from tricap.core.body.skin.texture import (
    EDGE_PX,
    MASK,
    NEARER_M,
    RIM_PX,
    TEXTURE,
    Texture,
    TextureBaker,
    View,
    _facing,
    _pictured,
    _unhidden,
    nearest_depth,
    write_texture,
)
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.raster import rasterize
from tricap.core.synthetic.arm import arm_rig

SHAPE = default_shape(read_model("arm.R"))
SKIN = rest_skin(SHAPE, SkinSettings(contours=10, rays=16, cap_contours=3))
TRIANGLES = np.concatenate([SKIN.faces[:, [0, 1, 2]], SKIN.faces[:, [0, 2, 3]]])
PAINT = 120 + 80 * np.stack(
    [np.sin(40 * SKIN.vertices_m[:, 0]), np.cos(30 * SKIN.vertices_m[:, 2]), np.sin(25 * SKIN.vertices_m.sum(axis=1))], axis=1
)
BRIGHTER = 1.25


def poses() -> list[np.ndarray]:
    rest = np.zeros(len(SHAPE.skeleton.dofs))
    bent = rest.copy()
    bent[SHAPE.skeleton.layout["elbow.R flexion"]] = 0.6
    return [at(rest), at(bent)]


def at(motion: np.ndarray) -> np.ndarray:
    """The arm where the cameras of `arm_rig` look."""
    cameras = arm_rig(256).cameras
    axis = np.mean([camera.R_cam_world[2] for camera in cameras], axis=0)
    middle = np.mean([camera.centre_m for camera in cameras], axis=0) + 1.6 * axis / np.linalg.norm(axis)
    moved = motion.copy()
    moved[:3] = middle - SKIN.vertices_m.mean(axis=0)
    return moved


def filmed(camera: Camera, motion: np.ndarray, gain: float) -> View:
    posed = Poser(SHAPE, SKIN.weights).posed(SKIN.vertices_m, motion)
    raster = rasterize(camera, posed, TRIANGLES)
    image = np.full((camera.size_px[1], camera.size_px[0], 3), 30.0)
    image.reshape(-1, 3)[raster.sample] = gain * raster.interpolate(PAINT, TRIANGLES)
    return View(camera=camera, rgb=image.astype(np.float32))


def test_pixels_between_vertices_are_linear() -> None:
    camera, motion = arm_rig(384).cameras[0], poses()[1]
    posed = Poser(SHAPE, SKIN.weights).posed(SKIN.vertices_m, motion)
    middle = posed[TRIANGLES].mean(axis=1)
    found = _pictured(camera, posed, vertex_normals(posed, SKIN.faces))[TRIANGLES].mean(axis=1)
    behind = camera.centre_m - camera.R_cam_world[2:]
    assert np.abs(found[:, :2] - camera.project(middle)).max() < 0.01  # 0.007 here, 0.006 on a walker
    assert np.abs(found[:, 2] - camera.to_camera(middle)[:, 2]).max() < 1e-6
    assert not _facing(_pictured(camera, behind, camera.R_cam_world[2:])).any()


@pytest.fixture(scope="module")
def baked() -> tuple[TextureBaker, Texture]:
    cameras = arm_rig(384).cameras[:2]
    baker = TextureBaker(SKIN, SHAPE, 128, 2)
    for motion in poses():
        baker.add(motion, [filmed(camera, motion, gain) for camera, gain in zip(cameras, (1.0, BRIGHTER))])
    return baker, baker.finished()


def test_the_paint_is_found_again(baked: tuple[TextureBaker, Texture]) -> None:
    baker, texture = baked
    assert texture.exposures[1] / texture.exposures[0] == pytest.approx(BRIGHTER, rel=0.01)
    paint = baker._texels.at(PAINT) / texture.exposures[0]
    seen = texture.seen.ravel()[baker.texel]
    error = np.abs(texture.rgb.reshape(-1, 3)[baker.texel] - paint).max(axis=1)
    assert 0.2 < seen.mean() < 0.7 and texture.covered.sum() == len(seen)
    free = (texture.seen | ~texture.covered).astype(np.uint8)
    inner = cv2.distanceTransform(free, cv2.DIST_L2, 5).ravel()[baker.texel] > 2 * RIM_PX
    assert inner.mean() > 0.1 and np.median(error[inner]) < 2 and np.percentile(error[inner], 95) < 12
    assert np.median(error[seen]) < 4  # at the rim it fades into what is filled


def test_what_no_view_shows_is_filled_and_marked(baked: tuple[TextureBaker, Texture], tmp_path: Path) -> None:
    texture = baked[1]
    hidden = ~texture.seen & texture.covered
    low, high = texture.rgb[texture.seen].min(axis=0), texture.rgb[texture.seen].max(axis=0)
    assert (texture.rgb[hidden] >= low - 1).all() and (texture.rgb[hidden] <= high + 1).all()  # harmonic: between what was seen
    write_texture(tmp_path, texture)
    back = cv2.imread(str(tmp_path / TEXTURE))
    assert np.array_equal(back[:, :, ::-1], texture.rgb)
    assert np.array_equal(cv2.imread(str(tmp_path / MASK), cv2.IMREAD_GRAYSCALE) > 0, texture.seen)


def test_a_nearer_surface_hides_and_an_unknown_place_is_not_trusted() -> None:
    camera, motion = arm_rig(256).cameras[0], poses()[0]
    posed = Poser(SHAPE, SKIN.weights).posed(SKIN.vertices_m, motion)
    depth = nearest_depth(camera, posed, SKIN.faces)
    raster = rasterize(camera, posed, TRIANGLES)
    true = np.full(depth.shape, np.inf, dtype=np.float32)
    true.ravel()[raster.sample] = raster.depth_m
    true = cv2.erode(true, np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8))
    both = np.isfinite(depth) & np.isfinite(true)
    assert both.sum() > 0.97 * np.isfinite(true).sum() and np.percentile(np.abs(depth[both] - true[both]), 95) < 0.01
    sigma = np.where(SKIN.vertices_m[:, 0] < np.median(SKIN.vertices_m[:, 0]), 0.02, 0.001)
    baker = TextureBaker(replace(SKIN, relief_m=0 * sigma, sigma_m=sigma), SHAPE, 64, 1)
    baker.add(motion, [filmed(camera, motion, 1.0)])
    seen = baker.finished().seen.ravel()[baker.texel]
    assert seen.any() and baker._texels.at(sigma)[seen].max() < 0.009


def test_a_surface_that_is_seen_aslant_does_not_hide_itself() -> None:
    """Where a pixel is as large as a quad, its margin reaches places of the same surface that are much nearer: texels were lost in rows."""
    camera, motion = arm_rig(96).cameras[0], poses()[0]
    posed = Poser(SHAPE, SKIN.weights).posed(SKIN.vertices_m, motion)
    at = _pictured(camera, posed, vertex_normals(posed, SKIN.faces))
    aslant = np.flatnonzero(_facing(at) & (at[:, 3] < 0.5) & camera.sees(at[:, :2], EDGE_PX + 1))
    depth = nearest_depth(camera, posed, SKIN.faces)
    pixel = np.rint(at[aslant, :2]).astype(int)
    margin = at[aslant, 2] - depth[pixel[:, 1], pixel[:, 0]]
    assert len(aslant) > 20 and (margin > NEARER_M).any(), "no case"
    assert len(_unhidden(camera, at[aslant], depth)) == len(aslant)
    hidden = depth - 0.15  # as by an arm before it
    assert not len(_unhidden(camera, at[aslant], hidden))


def test_esc_ends_the_filling_of_a_texture(baked: tuple[TextureBaker, Texture]) -> None:
    """It took 1.5 s, and was asked to stop at its end."""

    class Asked(Monitor):
        left = 1000

        def check(self) -> None:
            self.left -= 1
            if self.left < 0:
                raise Cancelled

    never = Asked()
    baked[0].finished(never)
    checks = 1000 - never.left
    assert checks >= 5
    for asked in (1, checks):  # in the middle of the first step, and of the last
        monitor = Asked()
        monitor.left = asked - 1
        with pytest.raises(Cancelled):
            baked[0].finished(monitor)


def test_without_any_view_the_texture_is_plain() -> None:
    texture = TextureBaker(SKIN, SHAPE, 64, 2).finished()
    assert not texture.seen.any() and (texture.rgb[texture.covered] == 127).all() and np.allclose(texture.exposures, 1)
