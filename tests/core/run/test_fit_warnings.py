"""What run.json says about a fitted body."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.body.limb_words import FEW_FRAMES, frame_list
from tricap.core.run.record import fit_warnings, limb_name


def _body(contradicted: dict[str, tuple[int, ...]], known: tuple[tuple[str, ...], ...] = (("seen", "seen"),) * 30) -> Any:
    motion = SimpleNamespace(status=("fitted",) * 30, frames=np.arange(30), joint_names=("elbow.L", "wrist.L"), known=known)
    return SimpleNamespace(motion=motion, converged=True, iterations=3, contradicted=contradicted)


def test_a_limb_that_the_images_contradict_is_named_with_its_frames() -> None:
    (warning,) = fit_warnings(_body({"upper_arm.R": (3, 7, 8, 9, 12, 13), "thigh.L": tuple(range(FEW_FRAMES))}))
    assert "the right arm in 6 frames (3, 7–9, 12–13)" in warning and "click its joints" in warning
    assert fit_warnings(_body({})) == []


def test_a_limb_that_is_guessed_is_named_with_its_frames() -> None:
    rows = lambda n: (("seen", "guessed"),) * n + (("seen", "seen"),) * (30 - n)  # noqa: E731
    (warning,) = fit_warnings(_body({}, rows(FEW_FRAMES + 1)))
    assert f"The place of the left arm is guessed in {FEW_FRAMES + 1} frames (0–{FEW_FRAMES})" in warning
    assert "click wrist.L in a frame in which a view shows it" in warning
    assert fit_warnings(_body({}, rows(FEW_FRAMES))) == []


def test_a_limb_that_is_seldom_seen_is_named() -> None:
    rows = lambda n: (("seen", "seen"),) * n + (("inferred", "seen"),) * (30 - n)  # noqa: E731
    (warning,) = fit_warnings(_body({}, rows(14)))
    assert "The left arm is seen well in 14 of 30 frames only" in warning and warning.endswith("click elbow.L.")
    assert fit_warnings(_body({}, rows(15))) == []


@pytest.mark.parametrize(("bone", "words"), [("upper_arm.L", "left arm"), ("thigh.R", "right leg"), ("tail_tip", "tail tip")])
def test_limbs_have_names_that_people_use(bone: str, words: str) -> None:
    assert limb_name(bone) == words


def test_frames_in_a_row_are_written_as_one() -> None:
    assert frame_list([5]) == "5" and frame_list([0, 1, 2]) == "0–2" and frame_list([]) == ""
    assert frame_list([3, 7, 8, 9], 1) == "3 …" and frame_list([3, 7, 8, 9], 2) == "3, 7–9"
