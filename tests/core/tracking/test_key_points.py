"""Key points on a turning plane: places, distances and sigmas against the truth; clicks that are wrong or too few."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.images.interlace import FieldLayout
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.tracking.key_points import KeyPoints, distances, track_key_points
from tricap.core.tracking.settings import KeyPointSettings, TrackingSettings, TrackStatus
from tricap.core.tracking.step import TrackingView

FRAMES = 8


def follow(
    scenes: Any,
    off_px: float,
    views: tuple[str, ...] = ("L", "C", "R"),
    tilt: float = 0.25,
    shown: Callable[[int, str, np.ndarray], np.ndarray] = lambda frame, view, image: image,
    **settings: Any,
) -> tuple[KeyPoints, np.ndarray]:
    """Five points of a turning plane; `shown` changes the pictures of the cameras."""
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
        cameras=rig.cameras, reference=1, field_layout=FieldLayout(), matching=MatchingSettings(), tracking=TrackingSettings(**settings),
        limit_px=0.7,
    )  # fmt: skip
    read = lambda i: [shown(i, c.name, scenes.render(c, [bodies[i]], noise=1.5, seed=i)) for c in rig.cameras]  # noqa: E731
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


@pytest.mark.slow
@pytest.mark.parametrize("missing", [(3,), (3, 4, 5)])
def test_black_frames_are_bridged(scenes: Any, missing: tuple[int, ...]) -> None:
    """The reference view is black: the points report it and resume after it; without bridging and waiting they end."""

    def black(frame: int, view: str, image: np.ndarray) -> np.ndarray:
        return image * np.float32(frame not in missing or view != "C")

    points, truth = follow(scenes, 0.0, shown=black)
    seen = points.status == TrackStatus.MEASURED
    assert not seen[list(missing)].any() and np.delete(seen, missing, axis=0).all()
    assert (points.status[missing[0]] > TrackStatus.MEASURED).all()
    assert np.nanmax(np.abs(points.xyz_m - truth)[..., :2]) < 0.5 * scenes.pixel_m
    ended, _ = follow(scenes, 0.0, shown=black, bridge_frames=len(missing) - 1, wait_frames=0)
    assert (ended.status[missing[-1] + 1 :] != TrackStatus.MEASURED).all()


@pytest.mark.slow
def test_an_occluded_point_resumes(scenes: Any) -> None:
    """The point in the middle is occluded for two frames: it resumes under its name in its place, or ends without waiting."""

    def hidden(frame: int, view: str, image: np.ndarray) -> np.ndarray:
        if frame in (3, 4) and view == "C":
            image = image.copy()
            image[62:84, 97:119] = 60 + 40 * np.random.default_rng(frame).standard_normal((22, 22))
        return image

    points, truth = follow(scenes, 0.0, shown=hidden)
    seen = points.status == TrackStatus.MEASURED
    assert not seen[3:5, 4].any() and seen[5:, 4].all() and seen[:, :4].all()
    assert np.nanmax(np.abs(points.xyz_m - truth)[..., :2]) < 0.5 * scenes.pixel_m
    ended, _ = follow(scenes, 0.0, shown=hidden, wait_frames=2)
    assert not (ended.status[3:, 4] == TrackStatus.MEASURED).any() and (ended.status[:, :4] == TrackStatus.MEASURED).all()


def test_retroreflective_markers(scenes: Any) -> None:
    """Two bright blobs on a dark ground, clicked roughly: their centres are tracked to 0.1 mm across and 0.5 mm along the line of sight."""
    rig = scenes.three_cameras()
    truth = np.array([[[-0.1 + 0.012 * i, 0.02 * np.sin(i / 2), 2.1 + 0.004 * i], [0.05, -0.08 + 0.01 * i, 2.2]] for i in range(10)])

    def picture(camera: Any, i: int) -> np.ndarray:
        y, x = np.mgrid[0 : camera.size_px[1], 0 : camera.size_px[0]].astype(float)
        light = sum(240 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 1.6**2)) for u, v in camera.project(truth[i]))
        noise = 2 * np.random.default_rng([i, ord(camera.name)]).standard_normal(x.shape)
        return np.asarray(np.minimum(30 + light, 255) + noise, dtype=np.float32)

    clicks = {name: {c.name: c.project(truth[0, n]) + (1.0, -0.8) for c in rig.cameras} for n, name in enumerate(("wrist", "elbow"))}
    markers = KeyPointSettings(markers=True)
    tracking = TrackingSettings()
    view = TrackingView(
        cameras=rig.cameras, reference=1, field_layout=FieldLayout(), matching=MatchingSettings(), tracking=tracking, limit_px=0.7
    )
    read = lambda i: [picture(c, i) for c in rig.cameras]  # noqa: E731
    points = track_key_points(read, range(10), clicks, view, Monitor(), markers)
    assert (points.status == TrackStatus.MEASURED).all()
    error = np.abs(points.xyz_m - truth)
    assert error[..., :2].max() < 1e-4 and error[..., 2].max() < 5e-4
    z = np.linalg.norm(points.xyz_m - truth, axis=2) / points.sigma_m
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.8  # twenty points
    with pytest.raises(InputError, match="no bright round marker.*“knee” in view C"):
        knee = {c.name: c.project(np.array([0.1, 0.1, 2.1])) for c in rig.cameras}
        track_key_points(read, range(10), {"knee": knee}, view, Monitor(), markers)


def test_one_click_is_not_enough(scenes: Any) -> None:
    with pytest.raises(InputError, match="two views"):
        follow(scenes, 0.0, ("C",))


@pytest.mark.parametrize(
    ("clicks", "said"), [("n,X,9,9", "“X”, which the take does not have"), ("n,L,9,9\nn,C,9,90", "their rays miss by 41 px")]
)
def test_clicks_without_a_place_are_named(clicks: str, said: str, tmp_path: Path, scenes: Any, capsys: pytest.CaptureFixture[str]) -> None:
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[scenes.Body()]], noise=1.0)
    (tmp_path / "points.csv").write_text(f"point,view,x,y\n{clicks}\n")
    assert main(["track", str(take), "--out", str(tmp_path / "out"), "--points", str(tmp_path / "points.csv"), "--quiet"]) == 2
    assert said in capsys.readouterr().err


def test_the_command(tmp_path: Path, scenes: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """`tricap track --points` from a frame in the middle: both ways, in space within 1 mm across the line of sight."""
    bodies = [scenes.Body().moved(np.eye(3), [0.01 * i, 0.0, 0.0]) for i in range(4)]
    rig = scenes.three_cameras()
    take = scenes.write_take(tmp_path / "take", rig, [[b] for b in bodies], noise=1.0)
    true = np.array([[0.03, 0.02, 0.0]]) @ bodies[2].R.T + bodies[2].t
    lines = ["point,view,x,y", *(f"nose,{c.name},{c.project(true)[0][0]:.2f},{c.project(true)[0][1]:.2f}" for c in rig.cameras[:2])]
    (tmp_path / "points.csv").write_text("\n".join(lines))
    command = ["track", str(take), "--out", str(tmp_path / "out"), "--points", str(tmp_path / "points.csv"), "--quiet"]
    assert main([*command, "--points-frame", "2", "--pictures", str(tmp_path / "drawn")]) == 0
    rows = list(csv.DictReader((tmp_path / "out" / "points3d.csv").open(encoding="utf-8")))
    found = np.array([[float(r[a]) for a in "xyz"] for r in rows])
    assert [r["frame"] for r in rows] == list("0123") and {r["status"] for r in rows} == {"measured"}
    assert np.abs(found - true - [[0.01 * (i - 2), 0, 0] for i in range(4)])[:, :2].max() < 1e-3
    pixels = list(csv.DictReader((tmp_path / "out" / "points2d.csv").open(encoding="utf-8")))
    assert len(pixels) == 12 and {p["view"] for p in pixels} == {"L", "C", "R"}
    drawn = sorted(str(path.relative_to(tmp_path / "drawn")) for path in (tmp_path / "drawn").rglob("*.png"))
    assert drawn == sorted([*(f"{view}/{i:04d}.png" for view in "CLR" for i in range(4)), "paths.png"])
    picture = cv2.imread(str(tmp_path / "drawn" / "C" / "0003.png")).astype(int)
    (y, x) = (picture[..., 2] - picture[..., 0] > 100).nonzero()  # red: the path from before frame 1 on, the cross and the name
    at = {p["frame"]: float(p["x"]) for p in pixels if p["view"] == "C"}
    assert x.min() < at["1"] and len(y) > 10
    assert main([*command, "--pictures", str(take)]) == 2 and "is also an input" in capsys.readouterr().err
    (take / "L").rename(tmp_path / "L")
    (take / "L").symlink_to(tmp_path / "L")
    assert main([*command, "--pictures", str(tmp_path)]) == 2 and "contains the footage" in capsys.readouterr().err
    (tmp_path / "led").mkdir()
    (tmp_path / "led" / "C").symlink_to(tmp_path / "out")
    assert main([*command, "--pictures", str(tmp_path / "led")]) == 2 and "is a link to a place outside" in capsys.readouterr().err
    assert main(["track", str(take), "--out", str(tmp_path / "out"), "--pictures", str(tmp_path / "p")]) == 2
    assert main([*command, "--points-frame", "9"]) == 2 and "--points-frame 9" in capsys.readouterr().err
    (tmp_path / "points.csv").write_text("point,view,x,y\nnose,L,20,2000\n")
    assert main(command) == 2 and "outside the image" in capsys.readouterr().err
