"""The parts of a joint's sigma, and the words for how well it is known."""

import numpy as np
import pytest

from tricap.core.body.limb_words import limb_joints, limb_words, sentence
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.fitting.stages.sigma_parts import CLOTH_M, GUESSED_M, SEEN_M, known, sigma_parts

SHAPE = default_shape(read_model("arm.R"))
SKELETON, T = SHAPE.skeleton, 40
J = len(SKELETON.joint_names)
ELBOW, WRIST = (SKELETON.joint_names.index(name) for name in ("elbow.R", "wrist.R"))


def _parts(motion: np.ndarray, sigma: np.ndarray, elsewhere: float = 0.0, place: float = 0.0):
    return sigma_parts(SKELETON, SHAPE.lengths_m, motion, sigma, np.full((T, J), elsewhere**2), np.full(J, place))


def test_in_one_posture_the_model_errs_alike_and_in_many_it_does_not() -> None:
    still, moving = np.zeros((T, len(SKELETON.dofs))), np.zeros((T, len(SKELETON.dofs)))
    moving[:, SKELETON.layout["elbow.R flexion"]] = np.radians(np.linspace(0.0, 120.0, T))
    sigma = np.full((T, J), 0.004)
    same, other = _parts(still, sigma), _parts(moving, sigma)
    assert np.allclose(same.frame_m, CLOTH_M) and np.allclose(same.common_m, 0.004)
    assert other.frame_m[:, WRIST].min() > 0.0025 and other.common_m[WRIST] < 0.003
    whole = np.sqrt((other.frame_m**2 - CLOTH_M**2).mean(axis=0) + other.common_m**2)
    assert np.allclose(whole[WRIST], 0.004, rtol=0.01)  # divided, and none lost


def test_what_one_frame_alone_does_not_know_is_its_own() -> None:
    sigma = np.full((T, J), 0.004)
    sigma[7, WRIST] = 0.05
    parts = _parts(np.zeros((T, len(SKELETON.dofs))), sigma, elsewhere=0.03, place=0.01)
    assert parts.frame_m[7, WRIST] == pytest.approx(np.sqrt(0.05**2 - 0.004**2 + 0.03**2 + CLOTH_M**2))
    assert np.allclose(parts.common_m, np.hypot(0.004, 0.01)) and np.allclose(parts.total_m**2, parts.common_m**2 + parts.frame_m**2)


def test_words() -> None:
    sigma = np.full((4, J), 0.9 * SEEN_M)
    sigma[1, WRIST], sigma[2, WRIST] = 1.1 * SEEN_M, 1.1 * GUESSED_M
    contradicted = np.zeros((4, J), dtype=bool)
    contradicted[3, ELBOW] = True
    words = known(SKELETON, np.ones((4, 2), dtype=bool), contradicted, sigma)
    assert [row[WRIST] for row in words] == ["seen", "inferred", "guessed", "seen"]
    assert [row[ELBOW] for row in words] == ["seen", "seen", "seen", "guessed"]
    unobserved = np.array([[True, False], [False, True], [False, False], [True, True]])
    rows = known(SKELETON, unobserved, np.zeros((4, J), dtype=bool), np.full((4, J), 0.001))
    assert [row[WRIST] for row in rows] == ["inferred", "seen", "inferred", "seen"]  # one bone shows both of its ends
    assert [row[ELBOW] for row in rows] == ["seen", "seen", "inferred", "seen"]


def test_a_limb_is_known_as_its_least_known_joint() -> None:
    joints = ("pelvis", "elbow.R", "wrist.R", "knee.L", "toe.L")
    assert limb_joints(joints) == {"trunk and head": [0], "right arm": [1, 2], "left leg": [3]}
    words = limb_words(
        joints, [("seen", "seen", "guessed", "seen", "guessed"), ("seen", "inferred", "seen", "seen", "seen"), ("seen",) * 5]
    )
    assert words["right arm"] == ("guessed", "inferred", "seen") and words["left leg"] == ("seen",) * 3
    line = "right arm: seen in 1 frame, inferred in 1 frame (5), guessed in 1 frame (4)"
    assert sentence("right arm", [4, 5, 6], words["right arm"]) == line
    assert sentence("left leg", [4, 5, 6], words["left leg"]) == "left leg: seen in all frames"
