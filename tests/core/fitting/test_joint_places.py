"""Joints lie in the body where they were clicked, in every frame, and the surface stays where it was measured."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.inputs.fit_input import JointPlaces as Table
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.solve.solver import Solution
from tricap.core.fitting.stages.joint_places import has_both_sides, joints_in_place
from tricap.core.fitting.stages.sequence import fit_sequence
from tricap.core.fitting.stages.set_up import fit_context

SHIFT = np.array([0.012, 0.0, -0.012])  # of the elbow in the upper arm's axes; the cameras see 17 mm aside at most
SETTINGS = FitSettings(model_sigma_m=0.001, voxel_m=0.004)


def _clicked(scene, shift: np.ndarray, frame: int = 0, joint: str = "elbow.R") -> dict:
    """Clicks of a joint that is not where the model has it."""
    fit = fit_context(_given(scene, {0: scene.clicks}), SETTINGS)
    state = fit.parameters.state(scene.motion[frame], fit.parameters.vector(scene.shape))
    j = scene.shape.skeleton.joint_names.index(joint)
    place = state.joints_m[j] + state.R[scene.shape.skeleton.joint_bones[j][0]] @ shift
    return {joint: {c.name: c.project(place) for c in scene.rig.cameras}}


def _given(scene, clicks: dict) -> FitInput:
    return FitInput(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks=clicks, click_frame=0, time_s=scene.time_s)


def _true(scene, clicks: dict, **settings):
    """Context and solution with the true body."""
    fit = fit_context(_given(scene, clicks), replace(SETTINGS, **settings))
    solution = Solution(motion=scene.motion, vector=fit.parameters.vector(scene.shape), cost=0.0, iterations=1, converged=True)
    return fit, solution, joints_in_place(fit, scene.motion, solution.vector, scene.time_s)


def test_a_joint_moves_to_its_clicks_and_the_flesh_stays(make_scene) -> None:
    scene = make_scene(frames=6, click_px=0.0)
    fit, solution, places = _true(scene, {0: {**scene.clicks, **_clicked(scene, SHIFT)}})
    j = scene.shape.skeleton.joint_names.index("elbow.R")
    moved, after = places.applied(fit, solution)
    states = fit.parameters.states(scene.motion, solution.vector), moved.parameters.states(after.motion, after.vector)
    for before, now in zip(*states):
        wanted = before.R[before.skeleton.joint_bones[j][0]] @ SHIFT
        assert np.linalg.norm(now.joints_m[j] - before.joints_m[j] - wanted) < 0.6 * np.linalg.norm(SHIFT), "in every frame"
        others = np.delete(now.joints_m - before.joints_m, j, axis=0)
        assert np.linalg.norm(others, axis=1).max() < 0.004
        centres = [
            s.head_m[s.balls.bone_index] + np.einsum("mij,mj->mi", s.R[s.balls.bone_index], s.balls.centres_m(s.lengths_m))
            for s in (before, now)
        ]
        assert np.linalg.norm(centres[1] - centres[0], axis=1).max() < 0.002


def test_clicks_where_the_joints_are_change_nothing(make_scene) -> None:
    scene = make_scene(frames=4, click_px=0.0)
    fit, solution, places = _true(scene, {0: scene.clicks})
    assert np.abs(places.shift).max() < 1e-9
    _, after = places.applied(fit, solution)
    assert np.abs(after.motion - scene.motion).max() < 1e-9 and np.abs(after.vector - solution.vector).max() < 1e-9


def _usually(fit, places: dict[str, np.ndarray]):
    return replace(fit, model=replace(fit.model, joint_places_m=places))


def test_a_joint_without_a_click_moves_to_its_usual_place(make_scene) -> None:
    scene = make_scene(frames=6, click_px=0.0)
    fit, solution, _ = _true(scene, {0: {joint: at for joint, at in scene.clicks.items() if joint != "elbow.R"}})
    fit = _usually(fit, {"elbow.R": SHIFT})
    places = joints_in_place(fit, scene.motion, solution.vector, scene.time_s)
    assert places is not None
    moved, after = places.applied(fit, solution)
    j = scene.shape.skeleton.joint_names.index("elbow.R")
    for before, now in zip(fit.parameters.states(scene.motion, solution.vector), moved.parameters.states(after.motion, after.vector)):
        wanted = before.R[before.skeleton.joint_bones[j][0]] @ SHIFT
        assert np.linalg.norm(now.joints_m[j] - before.joints_m[j] - wanted) < 0.4 * np.linalg.norm(SHIFT), "in every frame"


def test_keypoints_of_a_joint_leave_it_where_they_had_it(make_scene) -> None:
    """Usual places are those beside a fit to the surface alone."""
    scene = make_scene(frames=4, click_px=0.0)
    j = scene.shape.skeleton.joint_names.index("elbow.R")
    table = Table(view="", frame=np.arange(4), joint=["elbow.R"] * 4, place=scene.joints_m[:, j], sigma=np.full(4, 0.01))
    fit = fit_context(replace(_given(scene, {0: scene.clicks}), keypoints=[table]), SETTINGS)
    fit, vector = _usually(replace(fit, clicked={}), {"elbow.R": SHIFT, "wrist.R": SHIFT}), fit.parameters.vector(scene.shape)
    found = joints_in_place(fit, scene.motion, vector, scene.time_s)
    assert found is not None and np.linalg.norm(found.shift[j]) < 0.2 * np.linalg.norm(SHIFT) < np.linalg.norm(found.shift[j + 1])


def test_clicks_count_more_than_the_usual_place(make_scene) -> None:
    scene = make_scene(frames=6, click_px=0.0)
    fit, solution, _ = _true(scene, {0: scene.clicks} | {t: _clicked(scene, 0 * SHIFT, t) for t in (2, 4)})
    j = scene.shape.skeleton.joint_names.index("elbow.R")
    found = joints_in_place(_usually(fit, {"elbow.R": SHIFT}), scene.motion, solution.vector, scene.time_s)
    assert found is not None and np.linalg.norm(found.shift[j]) < 0.5 * np.linalg.norm(SHIFT)


def test_lengths_follow_the_usual_places(make_scene) -> None:
    """A bone whose joint is usually further on is longer, however firm the belief in its length is."""
    scene = make_scene(frames=4, click_px=0.0)
    fit, solution, _ = _true(scene, {0: scene.clicks}, length_sigma=0.001)
    fit, further = replace(fit, clicked={}), np.array([0.0, 0.02, 0.0])
    assert joints_in_place(fit, scene.motion, solution.vector, scene.time_s) is None, "nothing tells the places"
    found = joints_in_place(_usually(fit, {"elbow.R": further}), scene.motion, solution.vector, scene.time_s)
    assert found is not None
    lengths = fit.parameters.body(found.vector)[0] - fit.parameters.body(solution.vector)[0]
    assert lengths[0] > 0.015 and lengths[1] < -0.01


def test_clicks_far_from_a_joint_are_those_of_another_pose(make_scene) -> None:
    scene = make_scene(frames=4, click_px=0.0)
    _, _, places = _true(scene, {0: {**scene.clicks, **_clicked(scene, 10 * SHIFT)}})
    assert np.abs(places.shift).max() < 0.003


def test_clicks_of_several_frames_count_more_than_those_of_one(make_scene) -> None:
    scene = make_scene(frames=6, click_px=0.0)
    j, found = scene.shape.skeleton.joint_names.index("elbow.R"), []
    for frames in ([0], [0, 2, 5]):
        clicks = {0: scene.clicks} | {t: {} for t in frames}
        clicks = {t: {**(scene.clicks if t == 0 else {}), **_clicked(scene, SHIFT, t)} for t in clicks}
        found.append(_true(scene, clicks)[2].shift[j] @ SHIFT / (SHIFT @ SHIFT))
    assert 0.2 < found[0] < found[1] < 1.0


@pytest.mark.parametrize(("place", "least", "most"), [("on", 0.004, 0.017), ("off", 0.0, 0.004), ("auto", 0.0, 0.004)])
def test_the_fit_does_so_if_it_is_asked_to(make_scene, place: str, least: float, most: float) -> None:
    scene = make_scene(frames=5, click_px=0.0)
    given = _given(scene, {0: {**scene.clicks, **_clicked(scene, SHIFT)}})
    fit = fit_sequence(given, replace(SETTINGS, place_joints=place))
    j = fit.motion.joint_names.index("elbow.R")
    off = np.linalg.norm(fit.motion.joints_m[1:, j] - scene.joints_m[1:, j], axis=1)
    assert least <= off.min() and off.max() <= most


def test_one_side_alone_is_left_where_it_is() -> None:
    assert has_both_sides(["neck", "shoulder.L", "shoulder.R"])
    assert not has_both_sides(["shoulder.R", "elbow.R", "wrist.R"]) and not has_both_sides(["neck", "shoulder.L", "elbow.R"])
