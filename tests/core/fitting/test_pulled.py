"""A joint is dragged: its limb follows within its limits, from the fitted pose, and nothing else moves."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.fitting.stages.pulled import moved_by_pull, pulled_pose
from tricap.core.fitting.state import ShapeParameters
from tricap.core.foundation.errors import InputError
from tricap.core.run.pulled_limb import FittedLimbs

REACHED_M = 1e-3  # of a place that the limb reaches; the preview is drawn, not measured


@lru_cache
def person() -> ShapeParameters:
    return ShapeParameters(default_shape(read_model("full")))


def place(pose: np.ndarray, joint: str) -> np.ndarray:
    parameters = person()
    return np.asarray(parameters.state(pose, parameters.vector()).joints_m[parameters.skeleton.joint_names.index(joint)])


def bent() -> np.ndarray:
    """Standing, with elbows and knees bent."""
    pose = np.zeros(len(person().skeleton.dofs))
    for name in ("elbow.R flexion", "elbow.L flexion", "knee.R flexion", "knee.L flexion"):
        pose[person().skeleton.layout[name]] = np.radians(40.0)
    return pose


@pytest.mark.parametrize("joint", ["wrist.R", "elbow.L", "ankle.R", "knee.L", "toe.L"])
def test_a_limb_reaches_where_its_joint_is_dragged(joint: str) -> None:
    skeleton, rng = person().skeleton, np.random.default_rng(3)
    columns, bones = moved_by_pull(person(), joint)
    low, high = np.array([skeleton.dofs[c].limits for c in columns]).T
    for _ in range(10):
        other = bent()
        other[columns] = np.clip(other[columns] + rng.normal(0, np.radians(15.0), len(columns)), low, high)
        found = pulled_pose(person(), bent(), joint, place(other, joint))
        assert np.linalg.norm(place(found, joint) - place(other, joint)) < REACHED_M
        assert (found[columns] >= low - 1e-12).all() and (found[columns] <= high + 1e-12).all()
        rest = np.setdiff1d(np.arange(len(found)), columns)
        assert np.array_equal(found[rest], bent()[rest]), "nothing but the limb moves"
    still = {name for name in skeleton.joint_names if name.endswith(joint[-2:]) and name.startswith(("hip", "shoulder"))}
    assert all(np.array_equal(place(found, name), place(bent(), name)) for name in still)
    assert {skeleton.bones[b].name for b in bones} >= {"hand" + joint[-2:] if "w" in joint[:5] else skeleton.bones[bones[0]].name}


def test_a_joint_that_is_not_moved_stays_as_it_was_fitted() -> None:
    pose = bent()
    pose[person().skeleton.layout["elbow.R flexion"]] = np.radians(-3.0)  # a measured pose beyond the limit
    np.testing.assert_allclose(pulled_pose(person(), pose, "wrist.R", place(pose, "wrist.R")), pose, atol=1e-9)


def test_a_straight_arm_bends_at_the_elbow() -> None:
    pose = np.zeros(len(person().skeleton.dofs))
    shoulder, wrist = place(pose, "shoulder.R"), place(pose, "wrist.R")
    goal = shoulder + 0.8 * (wrist - shoulder)
    found = pulled_pose(person(), pose, "wrist.R", goal)
    assert np.linalg.norm(place(found, "wrist.R") - goal) < REACHED_M
    assert found[person().skeleton.layout["elbow.R flexion"]] > np.radians(30.0)


def test_out_of_reach_the_limb_points_there() -> None:
    pose, joint = bent(), "wrist.R"
    shoulder = place(pose, "shoulder.R")
    direction = place(pose, joint) - shoulder
    found = pulled_pose(person(), pose, joint, shoulder + 3 * direction)
    towards, reach = place(found, joint) - shoulder, person().template.lengths_m
    bones = [bone.name for bone in person().skeleton.bones]
    assert np.linalg.norm(towards) > 0.99 * (reach[bones.index("upper_arm.R")] + reach[bones.index("forearm.R")])
    assert towards @ direction / np.linalg.norm(towards) / np.linalg.norm(direction) > 0.999


def test_a_joint_of_the_trunk_carries_the_body() -> None:
    pose = bent()
    columns, bones = moved_by_pull(person(), "pelvis")
    assert len(bones) == len(person().skeleton.bones)
    goal = place(pose, "pelvis") + (0.1, 0.05, -0.02)
    found = pulled_pose(person(), pose, "pelvis", goal)
    np.testing.assert_allclose(place(found, "pelvis"), goal, atol=REACHED_M)
    limbs = np.setdiff1d(np.arange(len(pose)), columns)
    assert np.array_equal(found[limbs], pose[limbs]), "limbs hang on as they are"


def test_without_a_fitted_body(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no fitted body yet: body.toml"):
        FittedLimbs.read(tmp_path)
