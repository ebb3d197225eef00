"""A finished body, here that of the sample, fitted again around new clicks."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from tricap.__main__ import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rig import read_rig
from tricap.core.motion.tables import read_joints
from tricap.core.run.around_clicks import FITTED_WITH, besides_clicks, fit_around_clicks, fitted_with
from tricap.core.run.file_digests import FileDigests
from tricap.core.run.settings import settings_of
from tricap.core.run.stages import CONTENT
from tricap.core.synthetic.sample import unpack
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

SAMPLE = Path(__file__).resolve().parents[3] / "addon" / "sample.zip"
FRAME, SHIFT_M = 6, np.array([0.0, 0.0, 0.03])


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    """The sample as if its body had been chosen automatically, with its wrist clicked 3 cm above where the fit has it, in one frame."""
    take = tmp_path / "sample"
    unpack(SAMPLE, take)
    said, file = (take / "take.toml").read_text(), take / "results" / "run.json"
    (take / "take.toml").write_text(said.replace('model = "full"\n', "", 1))
    run = json.loads(file.read_text())
    opened = read_take(take)
    settings = settings_of(opened.settings, {}, "take.toml")
    given = open_take(opened), settings, file.parent
    with_content = {**fitted_with(*given), CONTENT: besides_clicks(*given, FileDigests().stamp)}
    run["stages"]["fit"] |= {FITTED_WITH: with_content, "chosen_model": "full"}
    file.write_text(json.dumps(run))
    place = read_joints(take / "results" / "joints.csv").joints_m["wrist.R"][FRAME] + SHIFT_M
    at = ", ".join(f"{c.name} = {c.project(place[None])[0].round(2).tolist()}" for c in read_rig(take / "rig.toml").cameras)
    with (take / "take.toml").open("a", encoding="utf-8") as file:
        file.write(f'\n[[keyframes]]\nframe = {FRAME}\n[keyframes.joints]\n"wrist.R" = {{ {at} }}\n')
    return take


@pytest.mark.slow
def test_a_body_that_was_chosen_automatically(sample: Path) -> None:
    out = sample / "results"
    before = read_joints(out / "joints.csv").joints_m
    found = fit_around_clicks(sample, out, {}, Monitor())
    assert found is not None and FRAME in found.frames
    after = read_joints(out / "joints.csv").joints_m
    assert (after["wrist.R"] - before["wrist.R"])[FRAME] @ SHIFT_M > 0.3 * SHIFT_M @ SHIFT_M, "towards the click"
    assert np.abs(after["wrist.L"] - before["wrist.L"]).max() < 1e-4, "the other arm stays"


@pytest.mark.slow
def test_images_with_other_times_need_no_whole_fit_and_other_images_do(sample: Path) -> None:
    """The first are those of a copied project."""
    out, image = sample / "results", next(iter(sorted((sample / "C").iterdir())))
    os.utime(image, ns=(0, image.stat().st_mtime_ns + 5_000_000_000))
    assert fit_around_clicks(sample, out, {}, Monitor()) is not None
    with pytest.raises(InputError, match="No joints were clicked or pulled since"):
        fit_around_clicks(sample, out, {}, Monitor())
    content, time = bytearray(image.read_bytes()), image.stat().st_mtime_ns
    content[-1] ^= 1
    image.write_bytes(content)
    os.utime(image, ns=(0, time + 5_000_000_000))
    assert fit_around_clicks(sample, out, {}, Monitor()) is None


@pytest.mark.slow
def test_the_command(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = sample / "results"
    given = ["fit", str(sample), "--out", str(out), "--around-clicks"]
    assert main(given) == 0
    assert "were fitted again, with the shape as it was. `tricap scene` builds" in capsys.readouterr().out
    assert main(given) == 2 and "No joints were clicked or pulled since" in capsys.readouterr().err
    assert main([*given, "--set", "fitting.length_sigma=0.2"]) == 2 and "without --around-clicks" in capsys.readouterr().err


def test_what_the_command_refuses(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["fit", str(sample), "--around-clicks", "--out"]
    assert main([*given, str(sample / "other")]) == 2 and "There is no fitted body in" in capsys.readouterr().err
    assert not (sample / "other").exists()
    assert main([*given, str(sample / "results"), "--restart"]) == 2 and "--restart is of a whole fit" in capsys.readouterr().err
    assert main([*given, str(sample / "results"), "--frames", "0:4"]) == 2 and "with other --frames" in capsys.readouterr().err


def test_a_body_that_is_not_ours_is_not_read(sample: Path) -> None:
    file = sample / "results" / "run.json"
    run = json.loads(file.read_text())
    run["stages"]["fit"]["chosen_model"] = str(sample / "other.toml")
    file.write_text(json.dumps(run))
    with pytest.raises(InputError, match="does not say which body was fitted"):
        fit_around_clicks(sample, sample / "results", {}, Monitor())
