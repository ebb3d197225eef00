"""`tricap demo --set`: the knobs of the recording and of the run, and when the recording is made again."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.cli import stages
from tricap.core.cli.main import main
from tricap.core.run import pipeline
from tricap.core.synthetic.arm import ArmTakeSettings, is_arm_take, make_arm_take
from tricap.core.synthetic.truth import read_truth

SMALL = ["--set", "sample.width_px=96", "--set", "sample.frames=2", "--set", "sample.interlaced=none"]


def test_every_knob_of_the_recording_and_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """The recording is made once for the same settings, and again for others; the run gets its own."""
    asked = []
    for name, result in (("score_run", ""), ("_build_scene", [])):
        monkeypatch.setattr(stages, name, lambda *given, result=result: result)

    def run(take: Path, out: Path, given: Any, monitor: Any, engine: Any) -> Any:
        asked.append(given)
        return SimpleNamespace(record={"warnings": []}, notes=[])

    monkeypatch.setattr(pipeline, "run", run)
    out, picture = tmp_path / "demo", tmp_path / "demo" / "take" / "C" / "0001.png"
    command = ["demo", "--out", str(out), *SMALL, "--quiet"]
    assert main([*command, "--set", "sample.texture=0.1", "--set", "matching.patch_px=17"]) == 0
    assert asked == [{"matching": {"patch_px": 17}}]
    weak, made = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE), picture.stat().st_mtime_ns
    assert json.loads(read_truth(out / "take").settings)["texture"] == 0.1
    assert main([*command, "--set", "sample.texture=0.1"]) == 0 and picture.stat().st_mtime_ns == made
    assert main(command) == 0 and picture.stat().st_mtime_ns != made
    strong = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert cv2.Laplacian(strong, cv2.CV_32F).std() > 1.3 * cv2.Laplacian(weak, cv2.CV_32F).std()
    for wrong, said in (
        ("sample.nois=2", "Did you mean “noise”?"),
        ("matching.patch=2", "patch_px"),
        ("sample.swing_s=0", "between 0.2 and"),
    ):
        assert main([*command, "--set", wrong]) == 2 and said in capsys.readouterr().err


def test_a_slower_swing_moves_less(tmp_path: Path) -> None:
    made = {s: ArmTakeSettings(width_px=96, frames=2, interlaced="none", swing_s=s) for s in (1.36, 5.0)}
    moved = {}
    for swing_s, settings in made.items():
        make_arm_take(folder := tmp_path / str(swing_s), settings)
        assert is_arm_take(folder, settings) and not is_arm_take(folder, ArmTakeSettings())
        wrist = read_truth(folder).joints_m["RightHand"]
        moved[swing_s] = float(np.linalg.norm(wrist[1] - wrist[0]))
    assert moved[5.0] < 0.5 * moved[1.36]
