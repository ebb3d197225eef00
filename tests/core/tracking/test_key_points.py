"""Key points on a turning plane: places, distances and sigmas against the truth; clicks that are wrong or too few."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.commands import main
from tricap.core.errors import InputError
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.images.fields import Instants
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.progress import Monitor
from tricap.core.tracking.key_points import KeyPoints, distances, track_key_points
from tricap.core.tracking.settings import TrackingSettings, TrackStatus
from tricap.core.tracking.step import TrackingView

FRAMES = 8


def follow(scenes: Any, off_px: float, views: tuple[str, ...] = ("L", "C", "R"), tilt: float = 0.25) -> tuple[KeyPoints, np.ndarray]:
    rig = scenes.three_cameras()
    plane = scenes.Body(half_m=(0.24, 0.18), R=rotation_from_vector(np.array([0.1, tilt, 0.0])))
    bodies = [plane.moved(rotation_from_vector(np.array([0.0, 0.01, 0.03]) * i), [0.008 * i, -0.003 * i, 0.002 * i]) for i in range(FRAMES)]
    own = np.array([[-0.08, -0.05, 0], [0.08, -0.05, 0], [0.08, 0.05, 0], [-0.08, 0.05, 0], [0.0, 0.0, 0.0]])
    truth = np.stack([own @ b.R.T + b.t for b in bodies])
    random = np.random.default_rng(0)
    seeing = [c for c in rig.cameras if c.name in views]
    clicks = {
        str(n): {c.name: c.project(truth[0, n]) + (c.name != "C") * off_px * random.uniform(-1, 1, 2) for c in seeing} for n in range(5)
    }
    view = TrackingView(
        cameras=rig.cameras, reference=1, instants=Instants(), matching=MatchingSettings(), tracking=TrackingSettings(), limit_px=0.7
    )
    read = lambda i: [scenes.render(c, [bodies[i]], noise=1.5, seed=i) for c in rig.cameras]  # noqa: E731
    return track_key_points(read, range(FRAMES), clicks, view, Monitor()), truth


@pytest.mark.parametrize(("off_px", "views"), [(0.0, ("L", "C", "R")), (2.5, ("L", "C", "R")), (0.5, ("C", "R"))])
def test_key_points(scenes: Any, off_px: float, views: tuple[str, ...]) -> None:
    points, truth = follow(scenes, off_px, views)
    assert (points.status == TrackStatus.MEASURED).all()
    error = points.xyz_m - truth
    assert np.abs(error[..., :2]).max() < 0.5 * scenes.pixel_m and np.abs(error[..., 2]).max() < 0.012
    change = [distances(points, a, b) - np.linalg.norm(truth[:, a] - truth[:, b], axis=1) for a in range(5) for b in range(a)]
    assert np.sqrt(np.mean(np.square(change))) < 1e-3
    z = np.linalg.norm(error, axis=2) / points.sigma_m
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.8  # forty points
    assert points.xy_px.shape == (FRAMES, 5, 3, 2) and np.isfinite(points.xy_px).all()


def test_a_steep_surface(scenes: Any) -> None:
    """At 45° a patch is wider in one view than in the other by a third, and a point is still found from rough clicks."""
    points, _ = follow(scenes, 2.5, tilt=0.8)
    assert (points.status[0] == TrackStatus.MEASURED).all()


def test_one_click_is_not_enough(scenes: Any) -> None:
    with pytest.raises(InputError, match="two views"):
        follow(scenes, 0.0, ("C",))


def test_the_command(tmp_path: Path, scenes: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """`tricap track --points` from a frame in the middle: both ways, in space within 1 mm across the line of sight."""
    bodies = [scenes.Body().moved(np.eye(3), [0.01 * i, 0.0, 0.0]) for i in range(4)]
    rig = scenes.three_cameras()
    take = scenes.write_take(tmp_path / "take", rig, [[b] for b in bodies], noise=1.0)
    true = np.array([[0.03, 0.02, 0.0]]) @ bodies[2].R.T + bodies[2].t
    lines = ["point,view,x,y", *(f"nose,{c.name},{c.project(true)[0][0]:.2f},{c.project(true)[0][1]:.2f}" for c in rig.cameras[:2])]
    (tmp_path / "points.csv").write_text("\n".join(lines))
    command = ["track", str(take), "--out", str(tmp_path / "out"), "--points", str(tmp_path / "points.csv"), "--quiet"]
    assert main([*command, "--points-frame", "2"]) == 0
    rows = list(csv.DictReader((tmp_path / "out" / "points3d.csv").open(encoding="utf-8")))
    found = np.array([[float(r[a]) for a in "xyz"] for r in rows])
    assert [r["frame"] for r in rows] == list("0123") and {r["status"] for r in rows} == {"measured"}
    assert np.abs(found - true - [[0.01 * (i - 2), 0, 0] for i in range(4)])[:, :2].max() < 1e-3
    pixels = list(csv.DictReader((tmp_path / "out" / "points2d.csv").open(encoding="utf-8")))
    assert len(pixels) == 12 and {p["view"] for p in pixels} == {"L", "C", "R"}
    assert main([*command, "--points-frame", "9"]) == 2 and "--points-frame 9" in capsys.readouterr().err
    (tmp_path / "points.csv").write_text("point,view,x,y\nnose,L,20,2000\n")
    assert main(command) == 2 and "outside the image" in capsys.readouterr().err
