"""Clicks in further frames: the fit follows them, they correct the frames around them, and a warning names those it does not follow."""

from dataclasses import replace

import numpy as np
import pytest

from tricap.core.checking.run_check import beyond_limits, far_from_clicks
from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.stages.sequence import fit_sequence

from .limb_scene import Scene, measured_cloud

SETTINGS = FitSettings(model_sigma_m=0.001, voxel_m=0.004)


def given_of(scene: Scene, clicks: dict) -> FitInput:
    return FitInput(rig=scene.rig, model=scene.model, clouds=scene.clouds, clicks=clicks, click_frame=0, time_s=scene.time_s)


def projected(scene: Scene, frame: int, *joints: str) -> dict:
    names = scene.shape.skeleton.joint_names
    return {name: {c.name: c.project(scene.joints_m[frame, names.index(name)]) for c in scene.rig.cameras} for name in joints}


@pytest.mark.slow
@pytest.mark.parametrize(("shoulder", "elbow"), [(-75, 45), (-110, 60), (60, -60)])
def test_a_limb_that_went_wrong_is_corrected_by_a_click_after_it_and_before_it(make_scene, shoulder: int, elbow: int) -> None:
    scene = make_scene(frames=9, seed=1)
    layout = scene.shape.skeleton.layout
    for t in range(3, 9):  # at once far from where it was, with a quarter of the points
        scene.motion[t, layout["shoulder.R flexion"]] += np.radians(shoulder)
        scene.motion[t, layout["elbow.R flexion"]] += np.radians(elbow)
        scene.clouds[t] = measured_cloud(scene.shape, scene.motion[t], t, np.random.default_rng(t), points=60, noise=0.003, gross=0.0)
    errors = []
    for clicks in ({0: scene.clicks}, {0: scene.clicks, 6: projected(scene, 6, "elbow.R", "wrist.R")}):
        fit = fit_sequence(given_of(scene, clicks), SETTINGS)
        errors.append(np.linalg.norm(fit.motion.joints_m[:, 2] - scene.joints_m[:, 2], axis=1))
    assert (errors[0][4:] > 0.15).all(), "or there is nothing to correct"
    assert errors[1][6] < 0.01
    assert errors[1][4] < 0.19 and (errors[1][[5, 7, 8]] < 0.04).all()  # frame 3 is next to those that stay wrong


def test_joints_that_do_not_lie_where_they_were_clicked_are_told(make_scene) -> None:
    scene = make_scene(frames=3)
    given = given_of(scene, {0: scene.clicks, 2: projected(scene, 2, "wrist.R")})
    fit = fit_sequence(given, SETTINGS)
    assert far_from_clicks(given, fit.motion, 5.0) == []
    joints = fit.motion.joints_m.copy()
    joints[2, 2] += (0.1, 0.0, 0.0)
    (said,) = far_from_clicks(given, replace(fit.motion, joints_m=joints), 5.0)
    off = scene.rig["C"].project(joints[2, 2]) - given.clicks[2]["wrist.R"]["C"]
    assert f"wrist.R by {np.linalg.norm(off):.0f} px in frame 2" in said and "frame 0" not in said


def test_joints_that_are_bent_too_far_are_told(make_scene) -> None:
    scene = make_scene(frames=3)
    given = given_of(scene, {0: scene.clicks})
    fit = fit_sequence(given, SETTINGS)
    assert beyond_limits(given, fit.motion) == []
    values, flexion = fit.motion.values.copy(), fit.motion.dof_names.index("elbow.R flexion")
    values[1, flexion] = np.radians(226.0)
    (said,) = beyond_limits(given, replace(fit.motion, values=values))
    assert "elbow.R flexion by up to 76° (frame 1)" in said
    wider = replace(given, limits={"elbow.R flexion": (0.0, np.radians(230.0))})
    assert beyond_limits(wider, replace(fit.motion, values=values)) == []
