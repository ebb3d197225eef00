"""What clothes allow: the bound of a match, the precision that follows, and what would help."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.checking.texture import MEDIAN, PATCH_PX, Clothes, _mm_per_px, bound_px
from tricap.core.foundation.progress import Monitor
from tricap.core.images.sampling import noise_sigma
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.run.check import check_take
from tricap.core.take.footage import open_take
from tricap.core.take.take import FrameClicks, read_take

PRINTED = {"upper_arm.R": 0.02, "forearm.R": 0.03, "hip.L": 0.025, "thigh.L": 0.02}


def test_the_bound_of_waves_is_known() -> None:
    """f = A (sin kx + sin ky): the smaller eigenvalue of (1) is n A² k² / 2, for central differences (sin k)² in place of k²."""
    rng, k, amplitude, noise = np.random.default_rng(0), 0.5, 20.0, 1.5
    y, x = np.mgrid[:160, :160]
    grey = (120 + amplitude * (np.sin(k * x) + np.sin(k * y)) + rng.normal(0, noise, x.shape)).astype(np.float32)
    expected = np.sqrt(2) * noise_sigma(grey) / np.sqrt(25 * 25 * amplitude**2 * np.sin(k) ** 2 / 2)
    assert np.isclose(np.median(bound_px(grey, 25, 1)[20:-20, 20:-20]), expected, rtol=0.03)
    assert np.isinf(bound_px(np.full((60, 60), 99, np.float32), 13, 1)).all()


def _said(clothes: Clothes) -> list[str]:
    return [str(finding) for finding in clothes.findings()]


def test_printed_clothes_get_a_number_and_plain_ones_advice() -> None:
    printed = Clothes(view="C", frame=0, bound_px=PRINTED, mm_per_px=25.0, max_sigma_px=0.25)
    assert _said(printed) == ["Note: By the texture, half of the measured points should be within 0.8 mm (left leg), "
                              "0.9 mm (right arm, trunk and head) of the surface."]  # fmt: skip
    assert printed.findings()[0].harmless
    plain = replace(printed, bound_px=PRINTED | {"thigh.L": 0.12, "shin.L": 0.3})
    weak, note = _said(plain)
    assert "The texture of shin.L is too poor in view C: a match there has a sigma of 0.3 px" in weak
    half, closer = (MEDIAN * 25 * np.hypot(bound, PATCH_PX) * share for bound, share in ((0.105, 1.0), (0.21, 4 / 9)))
    assert (
        "3.6 mm (left leg)" in note and f"half the noise (more light) to {half:.1f} mm, two thirds of the distance to {closer:.1f}" in note
    )
    assert len(_said(replace(plain, mm_per_px=float("nan")))) == 1  # no distance, no precision
    assert "within 0.5 mm of the surface." in _said(replace(printed, bound_px={"what moves": 0.1}, mm_per_px=7.0))[0]  # near: not plain
    lost = replace(printed, bound_px={"forearm.R": np.inf})
    assert len(_said(lost)) == 1 and "lost in the noise" in _said(lost)[0] and not lost.figures()["texture_bound_px"]
    assert "has no texture in frame 0: nothing in it can be matched" in _said(replace(printed, bound_px={}, is_blank=True))[0]


def test_the_distance_is_known_without_clicks(arm_recording: Callable[..., Path]) -> None:
    footage = open_take(read_take(arm_recording()))
    bare = replace(footage, take=replace(footage.take, clicks=FrameClicks()))
    clicked, found = Clothes.of(footage, MatchingSettings()), Clothes.of(bare, MatchingSettings())
    assert [*found.bound_px] == ["what moves"] and {*clicked.bound_px} == {"upper_arm.R", "forearm.R"}
    assert np.isclose(found.mm_per_px, clicked.mm_per_px, rtol=0.15)
    middle, outer = (
        footage.rig.cameras[footage.take.reference],
        [c for k, c in enumerate(footage.rig.cameras) if k != footage.take.reference],
    )
    base = np.sqrt(sum(np.sum((c.centre_m - middle.centre_m) ** 2) for c in outer))
    assert np.isclose(_mm_per_px(footage, 2.0), 4e3 / (middle.focal_px * base), rtol=0.02)


def test_what_counts_as_texture_follows_the_limit_of_matching(arm_recording: Callable[..., Path]) -> None:
    footage = open_take(read_take(arm_recording()))
    assert not Clothes.of(footage, MatchingSettings()).is_blank
    assert Clothes.of(footage, MatchingSettings(max_sigma_px=0.01)).is_blank


@pytest.mark.slow
def test_check_says_what_to_expect(arm_recording: Callable[..., Path], tmp_path: Path) -> None:
    take = tmp_path / "take"
    take.symlink_to(arm_recording())
    checked = check_take(take, Monitor())
    assert any(note.startswith("Note: By the texture, half of the measured points should be within ") for note in checked.notes)
    assert not checked.findings and set(checked.figures["expected_mm"]) == {"right arm"}
