"""What run.json says about a fitted body."""

from types import SimpleNamespace
from typing import Any

import pytest

from tricap.core.run.record import FEW_FRAMES, fit_warnings, frame_list, limb_name


def _body(contradicted: dict[str, tuple[int, ...]]) -> Any:
    return SimpleNamespace(motion=SimpleNamespace(status=("fitted",) * 30), converged=True, iterations=3, contradicted=contradicted)


def test_a_limb_that_the_images_contradict_is_named_with_its_frames() -> None:
    (warning,) = fit_warnings(_body({"upper_arm.R": (3, 7, 8, 9, 12, 13), "thigh.L": tuple(range(FEW_FRAMES))}))
    assert "the right arm in 6 frames (3, 7–9, 12–13)" in warning and "click its joints" in warning
    assert fit_warnings(_body({})) == []


@pytest.mark.parametrize(("bone", "words"), [("upper_arm.L", "left arm"), ("thigh.R", "right leg"), ("tail_tip", "tail tip")])
def test_limbs_have_names_that_people_use(bone: str, words: str) -> None:
    assert limb_name(bone) == words


def test_frames_in_a_row_are_written_as_one() -> None:
    assert frame_list([5]) == "5" and frame_list([0, 1, 2]) == "0–2" and frame_list([]) == ""
