"""The silhouette's figures against outlines that are known, and outlines over the footage."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skin import SkinSettings
from tricap.core.errors import InputError
from tricap.core.images.background import Background
from tricap.core.progress import Monitor
from tricap.core.report.figures import figure_rows
from tricap.core.report.pages import check_pictured
from tricap.core.report.pictures import BODY_OUTLINE, PERSON_OUTLINE, body_over_footage
from tricap.core.report.silhouettes import body_masks, by_view, outlines_of, silhouettes_of

SHAPE = default_shape(read_model("arm.R"))
MOTION = np.zeros((3, len(SHAPE.skeleton.dofs)))
MOTION[:, :3] = 0.15, 0.0, 2.6
BODY: Any = SimpleNamespace(shape=SHAPE, motion=SimpleNamespace(frames=np.arange(3), values=MOTION))


def _footage(scenes: Any) -> Any:
    return SimpleNamespace(rig=scenes.three_cameras(), frames=range(3))


def _outline(scenes: Any, shift: float = 0.0) -> np.ndarray:
    mask = body_masks(scenes.three_cameras().cameras[1:2], SHAPE, MOTION[0], SkinSettings())[0]
    return max(outlines_of(mask), key=len).astype(np.float64) + (0.0, shift)


def test_the_silhouette_of_a_body_that_is_known(scenes: Any) -> None:
    outlines = {"C": {0: _outline(scenes), 2: _outline(scenes, 6.0)}}
    found = silhouettes_of(_footage(scenes), BODY, SkinSettings(), outlines, {}, Monitor())
    exact, shifted = found.fits
    assert (exact.view, exact.frame, exact.person) == ("C", 0, "outline") and exact.iou > 0.99 and exact.distance_px < 0.5
    mask = body_masks(scenes.three_cameras().cameras[1:2], SHAPE, MOTION[0], SkinSettings())[0]
    lower = np.zeros_like(mask)
    lower[6:] = mask[:-6]
    assert shifted.iou == pytest.approx((mask & lower).sum() / (mask | lower).sum(), abs=0.02)
    assert 3.0 < shifted.distance_px <= 6.0 and shifted.frame == 2
    assert by_view(found.fits)["C"]["least_iou"] == pytest.approx(shifted.iou, abs=1e-3)
    rows = figure_rows({}, [], None, None, found.fits)
    assert [r["name"] for r in rows] == ["silhouette of view C, IoU with the person's outline", "outline of view C from the body's"]


def test_a_silhouette_before_the_background(scenes: Any) -> None:
    rig = scenes.three_cameras()
    mask = body_masks(rig.cameras[:1], SHAPE, MOTION[0], SkinSettings())[0]
    still = np.random.default_rng(0).uniform(60, 90, mask.shape).astype(np.float32)
    image = np.where(mask, 160.0, still).astype(np.float32)
    image[2:14, 150:165] = 10.0  # something else that moved
    footage: Any = SimpleNamespace(rig=rig, frames=range(3), read=lambda frame: [image] * 3)
    fits = silhouettes_of(footage, BODY, SkinSettings(), {}, {"L": Background(grey=still, noise=1.0)}, Monitor()).fits
    assert {(f.view, f.person) for f in fits} == {("L", "background")} and len(fits) == 3
    assert fits[0].iou > 0.9 and fits[0].distance_px <= 1.0
    assert silhouettes_of(footage, BODY, SkinSettings(), {}, {}, Monitor()).fits == ()


def test_outlines_are_drawn_over_the_footage(scenes: Any) -> None:
    camera = scenes.three_cameras().cameras[1]
    grey = np.full(camera.size_px[::-1], 90.0, np.float32)
    picture = body_over_footage(grey, camera, SHAPE, MOTION[0], SkinSettings(), _outline(scenes, 10.0)).astype(int)
    for colour in (BODY_OUTLINE, PERSON_OUTLINE):
        assert (np.abs(picture - colour).sum(axis=2) < 60).sum() > 40


def test_pictures_of_frames_that_are_not_there_are_refused() -> None:
    check_pictured(range(3, 9), [8, 3])
    with pytest.raises(InputError, match="--pictures 9"):
        check_pictured(range(3, 9), [9])
