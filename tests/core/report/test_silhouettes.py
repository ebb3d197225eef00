"""The silhouette's figures against outlines that are known, and outlines over the footage."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import BodyShape, default_shape
from tricap.core.body.skin.contour_skin import SkinSettings, body_skin
from tricap.core.body.skin.extremities import shape_with_ends
from tricap.core.fitting.inputs.fit_input import BackgroundDistances, Packed
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.report.body_pictures import agreement_words
from tricap.core.report.figures import figure_rows
from tricap.core.report.pages import check_pictured
from tricap.core.report.pictures import BODY_OUTLINE, PERSON_OUTLINE, body_over_footage
from tricap.core.report.silhouettes import body_masks, by_view, is_whole_body, outlines_of, overlap, person_mask, silhouettes_of

ARM = default_shape(read_model("arm.R"))
ARM_MOTION = np.zeros((3, len(ARM.skeleton.dofs)))
ARM_MOTION[:, :3] = 0.15, 0.0, 2.6
PERSON = default_shape(read_model("full"))
PERSON_MOTION = np.zeros((3, len(PERSON.skeleton.dofs)))
PERSON_MOTION[:, :3] = 0.0, 0.0, 9.0
PERSON_MOTION[:, PERSON.skeleton.layout["pelvis tilt"]] = np.pi / 2  # upright for cameras that look along z, y down


def _body(shape: BodyShape, motion: np.ndarray) -> Any:
    return SimpleNamespace(shape=shape, motion=SimpleNamespace(frames=np.arange(3), values=motion))


def _skin_at(shape: BodyShape) -> Any:
    return lambda pose: body_skin(shape_with_ends(shape, SkinSettings()), pose)


def _footage(scenes: Any) -> Any:
    return SimpleNamespace(rig=scenes.three_cameras(), frames=range(3))


def _mask(scenes: Any, shape: BodyShape, motion: np.ndarray) -> np.ndarray:
    return body_masks(scenes.three_cameras().cameras[1:2], _skin_at(shape)(motion[0]))[0]


def _outline(scenes: Any, shape: BodyShape, motion: np.ndarray, shift: float = 0.0) -> np.ndarray:
    return max(outlines_of(_mask(scenes, shape, motion)), key=len).astype(np.float64) + (0.0, shift)


@pytest.mark.slow
def test_the_silhouette_of_a_body_that_is_known(scenes: Any) -> None:
    person = PERSON, PERSON_MOTION
    outlines = {"C": {0: _outline(scenes, *person), 2: _outline(scenes, *person, 6.0)}}
    found = silhouettes_of(_footage(scenes), _body(*person), _skin_at(PERSON), outlines, [], Monitor())
    exact, shifted = found.fits
    assert (exact.view, exact.frame, exact.person) == ("C", 0, "outline") and exact.iou > 0.97 and exact.distance_px < 0.5
    mask = _mask(scenes, *person)
    lower = np.zeros_like(mask)
    lower[6:] = mask[:-6]
    assert shifted.iou == pytest.approx((mask & lower).sum() / (mask | lower).sum(), abs=0.02)
    assert 1.0 <= shifted.distance_px <= 6.0 and shifted.frame == 2
    assert by_view(found.fits)["C"]["least_iou"] == pytest.approx(shifted.iou, abs=1e-3)
    rows = figure_rows({}, [], None, None, found.fits)
    assert [r["name"] for r in rows] == ["silhouette of view C, IoU with the person's outline", "outline of view C from the body's"]


def test_the_overlap_of_masks_that_are_known(scenes: Any) -> None:
    mask = _mask(scenes, ARM, ARM_MOTION)
    iou, inside, distance = overlap(mask, mask, whole=True)
    assert iou == 1.0 and np.isnan(inside) and distance < 0.5
    lower = np.zeros_like(mask)
    lower[6:] = mask[:-6]
    iou, _, distance = overlap(mask, lower, whole=True)
    assert iou == (mask & lower).sum() / (mask | lower).sum() and 3.0 < distance <= 6.0
    assert overlap(mask, lower, whole=False)[1] == (mask & lower).sum() / mask.sum()
    assert np.isnan(overlap(mask, mask & False, whole=False)).all() and np.isnan(overlap(mask & False, mask, whole=False)).all()


def test_an_arm_is_not_compared_with_the_whole_person(scenes: Any) -> None:
    """Only the arm's own silhouette is compared: it is inside the person's, or beside it."""
    arm = _mask(scenes, ARM, ARM_MOTION)
    person = np.zeros(arm.shape, bool)
    person[:, : arm.shape[1] // 2 + 60] = True
    assert (arm & person).sum() == arm.sum() and (arm & person).sum() / (arm | person).sum() < 0.2
    height, width = arm.shape
    outlines = {
        "C": {
            0: np.array([[0, 0], [width // 2 + 60, 0], [width // 2 + 60, height], [0, height]], float),
            2: np.array([[0, 0], [9, 0], [9, 9]], float),
        }
    }
    found = silhouettes_of(_footage(scenes), _body(ARM, ARM_MOTION), _skin_at(ARM), outlines, [], Monitor())
    inside, beside = found.fits
    assert not found.whole and inside.inside == 1.0 and beside.inside < 0.02
    assert all(np.isnan([fit.iou, fit.distance_px]).all() for fit in found.fits)
    assert by_view(found.fits) == {
        "C": {
            "inside": pytest.approx((1.0 + beside.inside) / 2, abs=1e-4),
            "least_inside": pytest.approx(beside.inside, abs=1e-4),
            "frames": 2,
        }
    }
    rows = figure_rows({}, [], None, None, found.fits)
    assert [r["name"] for r in rows] == ["silhouette of view C, share inside the person's outline"]
    assert agreement_words(found, "C", 0).endswith("share inside the person's outline (red): 100 %") and not agreement_words(found, "L", 0)


@pytest.mark.parametrize(("model", "whole"), [("full", True), ("upper_body", False), ("arm.R", False), ("leg.L", False)])
def test_which_models_are_whole_bodies(model: str, whole: bool) -> None:
    assert is_whole_body(read_model(model).skeleton) == whole


def _regions(view: str, person: np.ndarray, step_px: int, *others: np.ndarray) -> BackgroundDistances:
    """Of frame 0 the distance from a person (h, w), of the next ones others (h', w')."""
    h, w = (n // step_px * step_px for n in person.shape)
    cells = person[:h, :w].reshape(h // step_px, step_px, w // step_px, step_px).mean(axis=(1, 3)) >= 0.5
    tables = Packed([np.where(cells, 0, 9), *others])
    return BackgroundDistances(view=view, frame=np.arange(len(tables)), distance=tables, step_px=step_px, unit_px=0.5)


@pytest.mark.parametrize("step_px", [1, 4])
def test_a_silhouette_before_the_background(scenes: Any, step_px: int) -> None:
    rig = scenes.three_cameras()
    mask = body_masks(rig.cameras[:1], _skin_at(ARM)(ARM_MOTION[0]))[0]
    hollow = mask.copy()
    y, x = np.argwhere(mask).mean(axis=0).astype(int)
    hollow[y - 3 : y + 4, x - 3 : x + 4] = False  # what is surrounded by the person is the person
    shape = np.array(mask.shape) // step_px
    regions = _regions("L", hollow, step_px, np.zeros(shape), np.full(shape, 200))  # frames 1 and 2: nothing known, and nobody there
    found = person_mask(regions, 0, rig.cameras[0].size_px)
    assert found is not None and found.shape == mask.shape and found[y, x]
    assert (found & mask).sum() / (found | mask).sum() > {1: 0.98, 4: 0.85}[step_px]
    assert [person_mask(regions, frame, rig.cameras[0].size_px) for frame in (1, 2, 3)] == [None] * 3
    fits = silhouettes_of(_footage(scenes), _body(ARM, ARM_MOTION), _skin_at(ARM), {}, [regions], Monitor()).fits
    assert [(f.view, f.frame, f.person) for f in fits] == [("L", 0, "background")]
    assert fits[0].inside > {1: 0.98, 4: 0.9}[step_px]
    rows = figure_rows({}, [], None, None, fits)
    assert [r["name"] for r in rows] == ["silhouette of view L, share inside the person in front of the background"]
    assert silhouettes_of(_footage(scenes), _body(ARM, ARM_MOTION), _skin_at(ARM), {}, [], Monitor()).fits == ()
    assert silhouettes_of(_footage(scenes), _body(ARM, ARM_MOTION), None, {}, [regions], Monitor()).fits == ()


def test_an_outline_goes_before_the_background(scenes: Any) -> None:
    mask = _mask(scenes, ARM, ARM_MOTION)
    outlines = {"C": {0: _outline(scenes, ARM, ARM_MOTION)}}
    regions = [_regions("C", ~mask, 4, np.where(mask[2::4, 2::4], 0, 9))]
    found = silhouettes_of(_footage(scenes), _body(ARM, ARM_MOTION), _skin_at(ARM), outlines, regions, Monitor())
    assert [(f.frame, f.person) for f in found.fits] == [(0, "outline"), (1, "background")] and found.fits[0].inside > 0.95


def test_outlines_are_drawn_over_the_footage(scenes: Any) -> None:
    camera = scenes.three_cameras().cameras[1]
    grey = np.full(camera.size_px[::-1], 90.0, np.float32)
    picture = body_over_footage(
        grey, camera, ARM, ARM_MOTION[0], body_skin(ARM, ARM_MOTION[0]), _outline(scenes, ARM, ARM_MOTION, 10.0)
    ).astype(int)
    for colour in (BODY_OUTLINE, PERSON_OUTLINE):
        assert (np.abs(picture - colour).sum(axis=2) < 60).sum() > 40


def test_pictures_of_frames_that_are_not_there_are_refused() -> None:
    check_pictured(range(3, 9), [8, 3])
    with pytest.raises(InputError, match="--pictures 9"):
        check_pictured(range(3, 9), [9])
