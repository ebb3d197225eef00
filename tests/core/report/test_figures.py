"""The figures of a report: a unit and a sigma each, the same in the page and in report.json, and a command that repeats the run."""

import json
import math
import shlex
from pathlib import Path

import pytest

from tricap.core.cli import main
from tricap.core.report.figures import quoted
from tricap.core.run import pipeline


@pytest.mark.parametrize(
    ("value", "sigma", "said"),
    [(259.7154, 3.1069, ("259.7", "3.1")), (0.014352, 0.00025, ("0.01435", "0.00025")), (2967.3, 55.87, ("2967", "56")),
     (-5.0, 0.0, ("-5", "–")), (1.5, math.nan, ("1.5", "–")), (12345.6, 1234.0, ("12346", "1234"))],
)  # fmt: skip
def test_a_sigma_has_two_digits_that_count(value: float, sigma: float, said: tuple[str, str]) -> None:
    assert quoted(value, sigma) == said


@pytest.mark.slow
def test_every_figure_has_a_unit_and_a_sigma(plane_take: Path, tmp_path: Path) -> None:
    out = tmp_path / "out put"
    pipeline.run(plane_take, out, {"growing": {"spacing_px": 6}, "surface": {"correct_curvature": False}}, frames=(0, 3))
    report = json.loads((out / "report" / "report.json").read_text())
    page = (out / "report" / "report.html").read_text()
    assert report["format"] == "tricap-report" and len(report["figures"]) >= 4 and report["settings"]["growing"]["spacing_px"] == 6
    for row in report["figures"]:
        assert row["unit"] and row["sigma_of"] and row["sigma"] >= 0 and row["name"] in page
        assert quoted(row["value"], row["sigma"])[0] in page and f"<td>{row['unit']}</td>" in page
    command = shlex.split(report["repeat"])
    assert command[:2] == ["tricap", "run"] and {"growing.spacing_px=6", "surface.correct_curvature=false", "0:3"} <= set(command)
    again = [str(tmp_path / "again") if word == "OUT" else word for word in command[2:]]
    assert main.main(["track", *again, "--quiet"]) == 0
    for name in ("0000.ply", "0002.ply"):
        assert (tmp_path / "again" / "clouds" / name).read_bytes() == (out / "clouds" / name).read_bytes()
