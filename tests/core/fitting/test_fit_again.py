"""Frames around a click are fitted again with the shape as it was: the lost limb is found, and nothing else moves."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tricap.core.body.complete import complete_shape
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import FingerBend, default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.fitting.inputs.fit_input import FitInput
from tricap.core.fitting.observations import JointLimits, PosePrior
from tricap.core.fitting.settings import FitSettings
from tricap.core.fitting.stages.fit_again import (
    HELD,
    EarlierFit,
    _about_earlier,
    _shape_covariance,
    around,
    fit_again,
    limbs_with,
    with_held,
)
from tricap.core.fitting.state import ShapeParameters
from tricap.core.foundation.progress import Cancelled, Monitor

from .limb_scene import front_rig

CLICK, BENT = 12, np.radians(40)


def test_the_frames_around_clicks() -> None:
    frames, time_s = np.arange(100, 150), np.arange(50) / 25
    assert around([120], frames, time_s) == [range(10, 31)]
    assert around([101, 149], frames, time_s) == [range(0, 12), range(39, 50)]
    assert around([120, 125], frames, time_s) == [range(10, 36)] and around([99], frames, time_s) == []
    assert with_held(range(10, 31), 50) == range(10 - HELD, 31 + HELD) and with_held(range(0, 50), 50) == range(50)


def test_the_limbs_of_clicked_joints() -> None:
    parameters = ShapeParameters(default_shape(read_model("full")))
    named = lambda *joints: [parameters.skeleton.bones[limb.bones[0]].name for limb in limbs_with(parameters, joints)]  # noqa: E731
    assert named("wrist.R") == named("elbow.R", "wrist.R") == ["upper_arm.R"] and named("knee.L", "wrist.R") == ["thigh.L", "upper_arm.R"]
    assert named("wrist.R", "pelvis") == [], "the trunk carries all limbs"


def test_a_lost_limb_follows_its_click(make_scene) -> None:
    scene = make_scene(frames=28, seed=3, click=CLICK)
    shape = replace(scene.shape, length_sigma_m=0.01 * scene.shape.lengths_m, radius_sigma_m=0.05 * scene.shape.metaballs.radii_m)
    lost = np.exp(-0.5 * ((np.arange(28) - CLICK) / 3) ** 2)[:, None] * np.where(np.arange(8) >= 6, BENT, 0.0)
    earlier = EarlierFit(
        shape=shape,
        frames=np.arange(28),
        time_s=scene.time_s,
        values=scene.motion + lost,
        common_m=np.full(len(shape.skeleton.joint_names), 0.002),
    )
    (rows,) = around([CLICK], earlier.frames, earlier.time_s)
    inside = with_held(rows, 28)
    given = FitInput(
        rig=scene.rig,
        model=scene.model,
        clouds=[scene.clouds[t] for t in inside],
        clicks={CLICK: scene.clicks},
        time_s=scene.time_s[inside],
        trajectories=scene.trajectories,
    )
    motion = fit_again(given, earlier, rows, ["wrist.R"], FitSettings(voxel_m=0.005), Monitor())
    assert motion.frames.tolist() == list(rows)
    true, before = (
        np.stack(list(joint_positions(shape.skeleton, shape.lengths_m, values).values()), axis=1)
        for values in (scene.motion, earlier.values)
    )
    error, was = (np.linalg.norm(xyz - true[rows], axis=2).max(axis=1) for xyz in (motion.joints_m, before[rows]))
    assert was.max() > 0.15 and error.max() < 0.012  # 0.005
    assert np.abs(motion.values[[0, -1]] - earlier.values[[rows[0], rows[-1]]]).max() < 0.1, "the motion stays continuous"
    assert (motion.joint_sigma_m >= 0.002).all() and set(motion.status) <= {"fitted", "partial"}
    stopped = Monitor()
    stopped.cancel()
    with pytest.raises(Cancelled):
        fit_again(given, earlier, rows, ["wrist.R"], FitSettings(), stopped)


def test_limbs_that_were_clicked_earlier_stay_where_the_fit_put_them() -> None:
    """All joints were clicked in frame 3, the knees badly, and now the right wrist is pulled in frame 5."""
    shape = default_shape(read_model("full"))
    shape = replace(shape, length_sigma_m=0.01 * shape.lengths_m, radius_sigma_m=0.05 * shape.metaballs.radii_m)
    rig, skeleton, frames = front_rig(focal_px=900.0), shape.skeleton, range(10)
    values = np.zeros((len(frames), len(skeleton.dofs)))
    values[:, skeleton.layout["elbow.R flexion"]] = values[:, skeleton.layout["elbow.L flexion"]] = np.radians(30)
    clicked, pulled = values[3].copy(), values[5].copy()
    clicked[skeleton.layout["knee.L flexion"]] = np.radians(25)
    pulled[skeleton.layout["elbow.R flexion"]] = np.radians(45)
    clicks = {
        frame: {name: {c.name: c.project(X) for c in rig.cameras} for name, X in joints.items() if names is None or name in names}
        for frame, pose, names in ((3, clicked, None), (5, pulled, {"wrist.R"}))
        for joints in [joint_positions(skeleton, shape.lengths_m, pose)]
    }
    none, time_s = np.zeros((0, 3)), np.arange(10) / 25
    clouds = [SimpleNamespace(frame=t, xyz_m=none, normals=none, covariance_m2=np.zeros((0, 3, 3))) for t in frames]
    given = FitInput(rig=rig, model="full", clouds=clouds, clicks=clicks, time_s=time_s)
    earlier = EarlierFit(
        shape=shape, frames=np.arange(10), time_s=time_s, values=values, common_m=np.full(len(skeleton.joint_names), 0.002)
    )
    motion = fit_again(given, earlier, range(10), ["wrist.R"], FitSettings(), Monitor())
    arm = limbs_with(ShapeParameters(shape), ["wrist.R"])[0].columns
    change = np.abs(motion.values - values)
    assert change[5, arm].max() > np.radians(5) and np.delete(change, arm, axis=1).max() < 1e-9


def test_what_the_fit_does_not_measure_stays_as_it_was() -> None:
    before = np.array([[0.10, 0.5], [0.12, 0.7]])
    prior = PosePrior(mean=np.zeros(2), sigma=np.radians([0.1, 20.0]))
    np.testing.assert_allclose(_about_earlier(prior, before).mean, [0.11, 0.0])
    limits = JointLimits(low=np.zeros(2), high=np.ones(2), sigma=1.0)
    assert _about_earlier(limits, before) is limits


@pytest.mark.slow
def test_bent_fingers_are_as_uncertain_as_body_toml_says() -> None:
    """Also in the complete model, which keeps the bends of the simplified one."""
    simple = replace(default_shape(read_model("full")), finger_bends={"hand.R": FingerBend(0.3, 0.11)})
    for shape in (simple, complete_shape(simple)):
        parameters = ShapeParameters(shape)
        right, left = (parameters.layout[f"bend hand.{side}"] for side in "RL")
        sigma = np.sqrt(np.diag(_shape_covariance(SimpleNamespace(parameters=parameters), shape)))
        assert (sigma[right], sigma[left]) == (pytest.approx(0.11 / 0.55), 0.0)
        np.testing.assert_allclose([*parameters.bends(parameters.vector()).values()], [0.3, 1.0])
