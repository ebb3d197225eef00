"""Outlines of the region that covers the still background: where its edge is, and which way is out."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.fitting.inputs.fit_input import UNKNOWN, BackgroundDistances, Packed
from tricap.core.fitting.inputs.silhouettes import PersonOutlines, Silhouettes
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.state import ShapeParameters

from .limb_scene import outlines
from .test_evidence import _empty, _given

SETTINGS = FitSettings()
SURFACE = read_model("arm.R").surface
STEP_PX = 4
J, I = np.indices((100, 140))  # of cells
MIDDLE = np.array([70.0, 50.0])


def _outlines(*persons: np.ndarray) -> PersonOutlines:
    tables = Packed(np.where(person, 0, 9) for person in persons)
    return PersonOutlines(
        regions=BackgroundDistances(view="C", frame=5 + np.arange(len(persons)), distance=tables, step_px=STEP_PX, unit_px=0.5)
    )


def _from(middle: np.ndarray) -> np.ndarray:
    return np.asarray(np.hypot(I - middle[0], J - middle[1]))


@pytest.mark.parametrize(("inner", "outer"), [(0.0, 12.0), (0.0, 40.0), (20.0, 40.0)])
def test_of_a_disc_and_of_a_ring(inner: float, outer: float) -> None:
    r = _from(MIDDLE)
    found = _outlines((r >= inner) & (r < outer)).of_frame(5)
    assert found is not None
    xy, normal, sigma = found
    assert np.allclose(np.linalg.norm(normal, axis=1), 1.0) and (sigma == STEP_PX).all()
    away = (xy - (STEP_PX - 1) / 2) / STEP_PX - MIDDLE
    radius = np.linalg.norm(away, axis=1)
    outwards = np.einsum("ni,ni->n", away / radius[:, None], normal)
    outside = radius > (inner + outer) / 2
    assert len(outside) == len(xy) > 50 and (~outside).any() == (inner > 0)
    assert np.abs(radius - np.where(outside, outer, inner)).max() < 0.8  # cells
    assert abs((radius - np.where(outside, outer, inner))[outside].mean()) < 0.4
    assert (outwards[outside] > 0.98).all() and (outwards[~outside] < -0.98).all()


def test_none_is_at_the_border_of_the_image() -> None:
    """A person of whom the lower half is out of the picture: what cuts her is no outline."""
    found = _outlines(_from(np.array([70.0, 95.0])) < 30, _from(np.array([0.0, 0.0])) < 30).of_frame(5)
    assert found is not None
    xy, normal, _ = found
    assert (xy[:, 1] < 98.6 * STEP_PX).all() and len(xy) > 80
    away = (xy - (STEP_PX - 1) / 2) / STEP_PX - (70, 95)
    radius = np.linalg.norm(away, axis=1)
    assert np.abs(radius - 30).max() < 2.0 and (np.einsum("ni,ni->n", away, normal) > 0.8 * radius).all()


def test_none_is_where_nothing_is_known_of_the_background() -> None:
    """A person of whom the left half stands before a wall that was never seen."""
    r = _from(MIDDLE)
    table = np.where(r < 30, 0, np.where(I < MIDDLE[0], UNKNOWN, 9))
    regions = BackgroundDistances(view="C", frame=np.array([5]), distance=Packed([table]), step_px=STEP_PX, unit_px=0.5)
    found, all_around = PersonOutlines(regions=regions, beside_unknown=False).of_frame(5), PersonOutlines(regions=regions).of_frame(5)
    assert found is not None and all_around is not None and len(all_around[0]) > 1.8 * len(found[0])
    xy, normal, _ = found
    assert (xy[:, 0] > (MIDDLE[0] - 1) * STEP_PX).all() and len(xy) > 60 and normal[:, 0].min() > -0.2


def test_specks_have_none_nor_frames_in_which_nothing_is_known() -> None:
    person, everywhere = _from(MIDDLE) < 20, np.ones(J.shape, dtype=bool)
    speck = _from(np.array([20.0, 20.0])) < 4
    both = _outlines(person | speck, everywhere, ~everywhere, speck)
    assert both.view == "C"
    found = both.of_frame(5)
    assert found is not None and (found[0][:, 0] > 40 * STEP_PX).all()
    assert [both.of_frame(frame) for frame in (6, 7, 8, 99)] == [None] * 4


def test_they_are_used_in_views_without_drawn_ones_and_less_exactly(make_scene) -> None:
    scene = make_scene(frames=1)
    parameters = ShapeParameters(scene.shape)
    state = parameters.state(scene.motion[0], parameters.vector())
    given = _given(scene, contours=outlines(scene)[:1], background=_empty(scene, 1))
    drawn, *others = (camera.centre_m for camera in scene.rig.cameras)
    (rays,) = Silhouettes(given, SURFACE, SETTINGS).observe(0, state)
    count = [int((rays.origin_m == centre).all(axis=1).sum()) for centre in (drawn, *others)]
    assert sum(count) == len(rays.origin_m) and 0 < max(count[1:]) < 0.6 * count[0] and min(count[1:]) > 10
    mine = (rays.origin_m == drawn).all(axis=1)
    assert rays.sigma_m[mine].max() < rays.sigma_m[~mine].min()
    assert np.median(np.abs(rays.residual(state)[~mine]) * rays.sigma_m[~mine]) < 0.003  # m: they touch the true body
    (without,) = Silhouettes(given, SURFACE, replace(SETTINGS, use_background=False)).observe(0, state)
    assert (without.origin_m == drawn).all()
