"""`tricap contour` on a plane before a calm background."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.commands import main


@pytest.mark.slow
def test_the_command(tmp_path: Path, scenes: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """The outline of a rectangle that travels: the median vertex within 1.5 px, and nothing is written for an unknown view."""
    bodies = [scenes.Body(half_m=(0.2, 0.15)).moved(np.eye(3), [0.01 * i, 0.0, 0.0]) for i in range(3)]
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in bodies], noise=1.0)
    assert main(["contour", str(take), "--view", "C", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    rows = list(csv.DictReader((tmp_path / "out" / "contours" / "C.csv").open(encoding="utf-8")))
    camera = scenes.three_cameras().cameras[1]
    for i, body in enumerate(bodies):
        corners = np.array([[-0.2, -0.15, 0], [0.2, -0.15, 0], [0.2, 0.15, 0], [-0.2, 0.15, 0]])
        own = np.concatenate([np.linspace(a, b, 400) for a, b in zip(corners, np.roll(corners, -1, axis=0))])
        true = camera.project(own @ body.R.T + body.t)
        found = np.array([[float(r["x"]), float(r["y"])] for r in rows if int(r["frame"]) == i])
        assert np.median(np.linalg.norm(found[:, None] - true, axis=2).min(axis=1)) < 1.5
    capsys.readouterr()
    assert main(["contour", str(take), "--view", "X", "--out", str(tmp_path / "none"), "--quiet"]) == 2
    assert "“X”" in capsys.readouterr().err
