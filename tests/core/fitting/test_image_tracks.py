"""Points followed in single views: where their rays meet the body, what they say about its motion, and a fit to little else."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.inputs.image_tracks import ImageTracks, meets
from tricap.core.fitting.segmentation import gap_to_bone, surface_points
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.stages.sequence import fit_sequence
from tricap.core.fitting.state import BodyState, ShapeParameters
from tricap.core.foundation.errors import InputError
from tricap.core.tracking.image_points import ImageStep

from .limb_scene import VIEW, Scene, make_scene, surface

SETTINGS = FitSettings()
NOISE_PX = 0.2


def _states(scene: Scene) -> list[BodyState]:
    parameters = ShapeParameters(scene.shape)
    return parameters.states(scene.motion, parameters.vector())


def _views(scene: Scene, noise_px: float = NOISE_PX, names: str = "LCR") -> dict[str, list[ImageStep]]:
    """Points of the true surface that face the cameras, in every view and pair of frames."""
    rng, found = np.random.default_rng(8), dict[str, list[ImageStep]]()
    for camera in (scene.rig[name] for name in names):
        bone, along, angle = np.repeat([0, 1], 300), rng.uniform(0.35, 0.85, 600), rng.uniform(0, 2 * np.pi, 600)
        seen = [surface(scene.shape, m, along, angle, bone) for m in scene.motion]
        xy = np.array([camera.project(X) + noise_px * rng.normal(size=(600, 2)) for X, _ in seen], np.float32)
        facing = np.array([normal @ VIEW < -0.45 for _, normal in seen])
        both = facing[:-1] & facing[1:]
        found[camera.name] = [ImageStep(from_px=a[rows], to_px=b[rows]) for a, b, rows in zip(xy, xy[1:], both)]
    return found


def _tracks(scene: Scene, **given: float) -> ImageTracks:
    return ImageTracks(scene.rig, _views(scene, **given), read_model(scene.model).surface, SETTINGS)


@pytest.mark.parametrize("model", ["arm.R", "full"])
def test_a_ray_meets_the_body_where_it_enters_it(model: str) -> None:
    shape = default_shape(read_model(model))
    parameters = ShapeParameters(shape)
    pose = np.random.default_rng(2).normal(0, 0.3, len(shape.skeleton.dofs))
    state = parameters.state(pose, parameters.vector())
    points, centre = surface_points(state), state.head_m.mean(axis=0) - 3.0 * VIEW
    away = np.linalg.norm(points - centre, axis=1)
    origin, ray = np.broadcast_to(centre, points.shape), (points - centre) / away[:, None]
    rows, bone, X = meets(origin, ray, state, read_model(model).surface)
    t = np.einsum("ni,ni->n", X - centre, ray[rows])
    assert len(rows) > 0.4 * len(points) and np.allclose(np.cross(X - centre, ray[rows]), 0, atol=1e-9)
    assert np.abs(gap_to_bone(X, state, bone)).max() < 0.002
    assert (t < away[rows] + 0.02).mean() > 0.97  # not behind the point of the surface that it was aimed at
    assert len(meets(origin, -ray, state, read_model(model).surface)[0]) == 0  # the body is behind the camera


def test_true_points_agree_with_the_true_motion_and_with_no_other() -> None:
    scene = make_scene("arm.R", frames=8)
    states, tracks = _states(scene), _tracks(scene)
    turned = scene.motion.copy()
    turned[5, scene.shape.skeleton.layout["elbow.R flexion"]] += np.radians(3.0)
    parameters = ShapeParameters(scene.shape)
    wrong = parameters.states(turned, parameters.vector())
    for t in range(7):
        steps = tracks.steps(t, states[t], states[t + 1])
        assert steps is not None and np.median(np.abs(steps.residual(states[t], states[t + 1]))) < 1.0 and len(steps.bone) > 60
    for t in (4, 5):
        true, other = tracks.steps(t, states[t], states[t + 1]), tracks.steps(t, wrong[t], wrong[t + 1])
        assert true is not None and other is not None and set(true.bone.tolist()) == {0, 1}
        r, s = true.residual(states[t], states[t + 1]), other.residual(wrong[t], wrong[t + 1])
        assert np.median(np.abs(s[np.repeat(other.bone, 2) == 1])) > 2 * np.median(np.abs(r))
    ahead, back = tracks.from_fixed(4, states[4], False), tracks.from_fixed(4, states[5], True)
    assert ahead is not None and back is not None and min(ahead.size, back.size) > 120
    assert np.median(np.abs(ahead.residual(states[5]))) < 1.0 and np.median(np.abs(back.residual(states[4]))) < 1.0
    assert np.median(np.abs(ahead.residual(wrong[5]))) > np.median(np.abs(ahead.residual(states[5])))


def test_a_part_of_the_frames_has_their_steps_and_none_over_a_gap() -> None:
    scene = make_scene("arm.R", frames=5)
    states, tracks = _states(scene), _tracks(scene)
    part = tracks.stretch([0, 1, 3, 4])
    own, whole = part.steps(2, states[3], states[4]), tracks.steps(3, states[3], states[4])
    assert own is not None and whole is not None and np.array_equal(own.from_m, whole.from_m)
    assert part.steps(1, states[1], states[3]) is None
    assert part.counts(1, states[1]).sum() > 60 and part.counts(3, states[4]).sum() > 60  # of the step to the frame, where none begins


def _given(scene: Scene, **more: object) -> FitInput:
    none = np.zeros((0, 3))
    clouds = [SimpleNamespace(frame=t, xyz_m=none, normals=none, covariance_m2=np.zeros((0, 3, 3))) for t in range(len(scene.motion))]
    return FitInput(rig=scene.rig, model=scene.model, clouds=clouds, time_s=scene.time_s, clicks={0: scene.clicks}, **more)  # type: ignore[arg-type]


def test_a_limb_is_followed_from_its_clicks_by_points_of_single_views_alone() -> None:
    scene = make_scene("arm.R", frames=8, click_px=0.5)
    settings = replace(SETTINGS, sequence_steps=10)
    fit = fit_sequence(_given(scene, image_tracks=_views(scene)), settings)
    error = np.linalg.norm(fit.motion.joints_m - scene.joints_m, axis=2)
    moved = np.linalg.norm(scene.joints_m[-1] - scene.joints_m[0], axis=1).max()
    assert error.max() < 0.02 < 0.15 * moved
    assert {known for row in fit.motion.known for known in row[:2]} == {"seen"}  # no background tells that the wrist is nowhere else


def test_without_them_nothing_is_known_of_the_limb() -> None:
    scene = make_scene("arm.R", frames=3)
    with pytest.raises(InputError, match="no measured surface, and no outlines"):
        fit_sequence(_given(scene), SETTINGS)
    beside = {n: [ImageStep(from_px=s.from_px + 400, to_px=s.to_px + 400) for s in steps] for n, steps in _views(scene).items()}
    with pytest.raises(InputError, match="no measured surface, and no outlines"):
        fit_sequence(_given(scene, image_tracks=beside), SETTINGS)
