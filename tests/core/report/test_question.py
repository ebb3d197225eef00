"""The picture beside a question about a start."""

import cv2
import numpy as np

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.fitting.inputs.start_joints import UNTRIED, NeedsClick, StartJoints
from tricap.core.report.question import ASKED, FOUND, LEFT, RIVAL, question_picture

from ..conftest import DEPTH_M, three_cameras


def start(**more: object) -> StartJoints:
    """A whole person before the three cameras, and a rival who stands aside."""
    shape = default_shape(read_model("full"))
    pose = np.zeros(len(shape.skeleton.dofs))
    joints = {n: xyz @ np.diag([1.0, -1.0, 1.0]) for n, xyz in joint_positions(shape.skeleton, shape.lengths_m, pose).items()}
    middle = np.mean([*joints.values()], axis=0)
    joints = {n: 0.3 * (xyz - middle) + (0, 0, DEPTH_M) for n, xyz in joints.items()}
    given = dict(rivals={"front and back": 0.3}, rival_m={n: xyz + (0.1, 0, 0) for n, xyz in joints.items()}, ask="wrist.R") | more
    return StartJoints(frame=7, xyz_m=joints, stature=1.0, model="full", probability=0.7, **given)  # type: ignore[arg-type]


def shown(picture: np.ndarray, colour: tuple[int, ...]) -> int:
    """How many pixels of the panels have a colour."""
    return int((np.abs(picture[40:-40].astype(int) - colour).max(axis=-1) <= 3).sum())


def test_both_poses_are_shown_and_the_joint_to_click() -> None:
    rig = three_cameras()
    images = [np.full(c.size_px[::-1], 90.0, np.float32) for c in rig.cameras]
    both = question_picture(start(), rig.cameras, ("L", "C", "R"), images)
    dark = tuple(round(LEFT * value) for value in FOUND)
    assert both.dtype == np.uint8 and both.shape[1] > 3 * 200
    assert min(shown(both, colour) for colour in (FOUND, dark, RIVAL, ASKED)) > 100
    alone = question_picture(start(rival_m={}), rig.cameras, ("L", "C", "R"), images)
    assert shown(alone, FOUND) > 100 and not shown(alone, RIVAL)
    assert cv2.imencode(".png", alone)[0]


def test_a_joint_behind_a_camera_is_left_out() -> None:
    """Improbable poses may have one."""
    rig, asked = three_cameras(), start()
    behind = {**asked.rival_m, "wrist.R": np.array([0.0, 0.0, -1.0]), "ankle.L": np.array([0.3, 0.0, 1e-9])}
    picture = question_picture(start(rival_m=behind), rig.cameras, ("L", "C", "R"), [np.zeros(c.size_px[::-1]) for c in rig.cameras])
    assert shown(picture, RIVAL) > 100


def test_the_question_names_the_rival_and_the_picture() -> None:
    asked = NeedsClick(start(), "OUT/report/question.png shows both.")
    assert "in frame 7 (70%): front and back. Click the right wrist" in str(asked) and str(asked).endswith("question.png shows both.")
    both = start(rivals={UNTRIED: 0.2, "front and back": 0.1}).question
    assert "(70%): front and back or whether another pose fits better. Click" in both
    assert asked.joint == "wrist.R" and asked.frame == 7 and "(70%). Click" in start(rivals={}).question
