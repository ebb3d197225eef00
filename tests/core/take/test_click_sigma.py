"""One knob, fitting.click_sigma_px, decides whether clicks contradict each other: where a run begins, in the check, in the fit and while
clicking."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.checking.take_check import check_take, seed_findings
from tricap.core.fitting.inputs.clicks import read_clicks
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.intersection import CLICK_SIGMA_PX, MOST_MISS_SIGMAS
from tricap.core.matching.proposals import where_rays_meet
from tricap.core.run import take_run
from tricap.core.run.stages import stage_keys
from tricap.core.take.clicked_points import clicked_point
from tricap.core.take.footage import Footage, open_take
from tricap.core.take.take import read_take

X = np.array([0.05, 0.02, 2.1])
APART_PX = 40.0  # across the epipolar lines: each click misses the point between them by half of it
SIGMAS = [(4.0, False), (CLICK_SIGMA_PX, False), (0.45 * APART_PX / MOST_MISS_SIGMAS, False), (0.55 * APART_PX / MOST_MISS_SIGMAS, True)]


def opened(scenes: Any, folder: Path, line: str, sigma_px: float) -> Footage:
    """A take with the contradicting clicks, and the knob in its take.toml."""
    rig = scenes.three_cameras()
    take = scenes.write_take(folder, rig, [[scenes.Body()]])
    at = {name: rig[name].project(X) + (0.0, side * APART_PX / 2) for name, side in (("L", -1), ("R", 1))}
    said = ", ".join(f"{name} = [{x:.2f}, {y:.2f}]" for name, (x, y) in at.items())
    with (take / "take.toml").open("a") as file:
        file.write(line.replace("{}", f"{{ {said} }}") + f"\n[settings.fitting]\nclick_sigma_px = {sigma_px}\n")
    return open_take(read_take(take), click_sigma_px=sigma_px)


def refused(what: Any) -> bool:
    try:
        what()
    except InputError as error:
        assert "elbow.R" in str(error)
        return True
    return False


@pytest.mark.parametrize(("sigma_px", "accepted"), SIGMAS)
def test_raising_the_knob_accepts_a_click_and_lowering_it_refuses_it(tmp_path: Path, scenes: Any, sigma_px: float, accepted: bool) -> None:
    footage = opened(scenes, tmp_path / "take", '[seeds.joints]\n"elbow.R" = {}', sigma_px)
    folder, cameras = footage.take.folder, footage.rig.cameras
    at = footage.take.clicks.joints["elbow.R"]

    def begin(overrides: Any = None) -> None:
        with take_run.open_run(folder, tmp_path / "out", overrides):
            pass

    assert refused(begin) != accepted
    assert refused(lambda: clicked_point(footage, "elbow.R", at)) != accepted
    assert refused(lambda: read_clicks(footage.rig, ("elbow.R",), {"elbow.R": at}, sigma_px)) != accepted
    assert (not seed_findings(footage)) == accepted
    found = where_rays_meet(cameras, {0: at["L"], 2: at["R"]}, sigma_px)
    assert (found[1] is not None) == accepted
    other = 100.0 if not accepted else 1.0  # what the command sets goes before take.toml
    assert refused(lambda: begin({"fitting": {"click_sigma_px": other}})) == accepted


def test_the_check_reads_the_knob_of_the_take(tmp_path: Path, scenes: Any) -> None:
    for sigma_px, contradicts in ((5.0, True), (20.0, False)):
        opened(scenes, tmp_path / f"take{sigma_px}", '[seeds.joints]\n"elbow.R" = {}', sigma_px)
        found = check_take(tmp_path / f"take{sigma_px}", Monitor()).findings
        assert any("miss each other" in f.sentence for f in found) == contradicts


def test_clicked_surface_is_measured_again_with_another_sigma(tmp_path: Path, scenes: Any) -> None:
    """How far the depth about a clicked surface point is swept depends on it; nothing of the surface does for clicked joints."""
    for line, again in (("[seeds]\nsurface = [{}]", True), ('[seeds.joints]\n"elbow.R" = {}', False)):
        footage = [opened(scenes, tmp_path / f"{again} {sigma}", line, sigma) for sigma in (5.0, 8.0)]
        settings = take_run.settings_of({}, {}, "take.toml")
        keys = [stage_keys(replace(footage[0], click_sigma_px=f.click_sigma_px), settings, tmp_path) for f in footage]
        assert (keys[0]["measure"] != keys[1]["measure"]) == again


def test_clicks_whose_rays_do_not_meet_are_refused_without_a_distance(scenes: Any) -> None:
    rig = scenes.three_cameras()
    first = rig.cameras[0]
    at_one_place = replace(rig, cameras=(first, replace(first, name="beside")))
    with pytest.raises(InputError, match=r"elbow\.R.* do not meet.*rig\.toml"):
        read_clicks(at_one_place, ("elbow.R",), {"elbow.R": {first.name: (300.0, 200.0), "beside": (305.0, 220.0)}}, CLICK_SIGMA_PX)
