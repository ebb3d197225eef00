"""`tricap contour` on a plane before a calm background."""

import csv
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.images.interlace import RowGrid
from tricap.core.motion.formats.ply import write_mesh
from tricap.core.results.folder import Results
from tricap.core.run.outlines import ContourCheckpoints, Start, _before_background, track_contour
from tricap.core.tracking.contour import Contour, ContourSettings

HALF_M = (0.2, 0.15)


def outline_of(scenes: Any, body: Any) -> np.ndarray:
    """What camera C sees of the outline of a rectangle (1600, 2)."""
    corners = np.array([[-0.2, -0.15, 0], [0.2, -0.15, 0], [0.2, 0.15, 0], [-0.2, 0.15, 0]])
    own = np.concatenate([np.linspace(a, b, 400) for a, b in zip(corners, np.roll(corners, -1, axis=0))])
    return np.asarray(scenes.three_cameras().cameras[1].project(own @ body.R.T + body.t))


def apart(scenes: Any, contour: np.ndarray, body: Any) -> np.ndarray:
    """Distances (V,) of vertices from the outline of a rectangle."""
    return np.linalg.norm(contour[:, None] - outline_of(scenes, body), axis=2).min(axis=1)


class Recorded:
    """Six frames of a rectangle that goes 4 px a frame to the right; camera C was black in some, and no point was tracked in them."""

    def __init__(self, scenes: Any, folder: Path, black: tuple[int, ...] = ()) -> None:
        self.bodies = [scenes.Body(half_m=HALF_M).moved(np.eye(3), [4 * scenes.pixel_m * (i - 3), 0.0, 0.0]) for i in range(6)]
        rig = scenes.three_cameras()
        x, y = np.meshgrid(np.linspace(-0.18, 0.18, 12), np.linspace(-0.13, 0.13, 9))
        on_it = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        xyz = np.stack([on_it @ b.R.T + b.t for b in self.bodies])
        xyz[list(black)] = np.nan
        images = {i: scenes.render(rig.cameras[1], [b] if i not in black else [], noise=1.0, background=90.0 * (i not in black), seed=i)
                  for i, b in enumerate(self.bodies)}  # fmt: skip
        for i, b in enumerate(self.bodies):
            corners = np.array([[-0.2, -0.15, 0], [0.2, -0.15, 0], [0.2, 0.15, 0], [-0.2, 0.15, 0]]) @ b.R.T + b.t
            write_mesh(folder / "skin" / f"{i:04d}.ply", corners, np.array([[0, 1, 2, 3]]))
        take = SimpleNamespace(rows_at=lambda frame: RowGrid())
        self.job: Any = SimpleNamespace(
            footage=SimpleNamespace(rig=rig, take=take, read=lambda i: [None, images[i], None]),
            trajectories=SimpleNamespace(xyz_m=xyz, visible=np.isfinite(xyz[..., 0])),
            clouds=[SimpleNamespace(frame=i, xyz_m=x) for i, x in enumerate(xyz)],
            results=SimpleNamespace(folder=folder),
            settings={"contour": ContourSettings()},
        )

    def contours(self, start: Start) -> list[Contour]:
        return [c for _, c in track_contour(self.job, 1, Monitor(), start)]


def test_four_corners_are_a_polygon(tmp_path: Path, scenes: Any) -> None:
    recorded = Recorded(scenes, tmp_path)
    found = recorded.contours(Start(polygon=outline_of(scenes, recorded.bodies[0])[::400] + (2.0, -1.0)))
    assert len(found[0].xy_px) == pytest.approx(2 * (0.4 + 0.3) / scenes.pixel_m / 4.0, abs=3)
    assert all(np.median(apart(scenes, c.xy_px, b)) < 0.7 and c.on_edge.mean() > 0.6 for c, b in zip(found, recorded.bodies))


@pytest.mark.parametrize("black", [(3,), (2, 3)])
def test_a_black_frame_carries_the_contour_through(tmp_path: Path, scenes: Any, black: tuple[int, ...]) -> None:
    """It stays as it was without edges, and resumes where the points moved meanwhile, 12 px for two black frames."""
    recorded = Recorded(scenes, tmp_path, black)
    found = recorded.contours(Start(polygon=outline_of(scenes, recorded.bodies[0])[::400]))
    for i in black:
        assert not found[i].on_edge.any() and (found[i].sigma_px == 3.0).all()
        assert np.median(apart(scenes, found[i].xy_px, recorded.bodies[black[0] - 1])) < 0.7
    assert np.median(apart(scenes, found[-1].xy_px, recorded.bodies[-1])) < 0.7 and found[-1].on_edge.mean() > 0.6


def test_from_the_fitted_body(tmp_path: Path, scenes: Any) -> None:
    """The skin's outline is there where nothing was measured and no point tracked; without a skin it is said so."""
    recorded = Recorded(scenes, tmp_path)
    for cloud in recorded.job.clouds:
        cloud.xyz_m = np.zeros((0, 3))
    recorded.job.trajectories.xyz_m[:] = np.nan
    found = recorded.contours(Start(body=True))
    assert all(np.median(apart(scenes, c.xy_px, b)) < 0.7 for c, b in zip(found, recorded.bodies))
    with pytest.raises(InputError, match="no outline"):
        recorded.contours(Start())


@pytest.mark.parametrize("with_background", [False, True])
def test_an_outline_is_followed_where_nothing_is_measured(tmp_path: Path, scenes: Any, with_background: bool) -> None:
    """From a polygon by points followed in the images, or before the background in every frame."""
    recorded = Recorded(scenes, tmp_path, black=(3,) if not with_background else ())
    recorded.job.trajectories = None
    for cloud in recorded.job.clouds:
        cloud.xyz_m = np.zeros((0, 3))
    background = scenes.render(scenes.three_cameras().cameras[1], [], noise=1.0, seed=99)
    start = Start(background=background) if with_background else Start(polygon=outline_of(scenes, recorded.bodies[0])[::400])
    found = recorded.contours(start)
    assert all(np.median(apart(scenes, c.xy_px, b)) < 0.7 and c.on_edge.mean() > 0.6 for i, (c, b) in enumerate(zip(found, recorded.bodies))
               if with_background or i != 3)  # fmt: skip
    with pytest.raises(InputError, match="differ in size"):
        recorded.contours(Start(background=background[1:]))


def test_a_camera_that_shakes_joins_no_edge_of_the_room_to_the_person(scenes: Any) -> None:
    """A dark carpet ends behind the person and runs to a bright thing that was not there before; the camera moved by 0.6 px."""
    camera, body = scenes.three_cameras().cameras[1], scenes.Body(half_m=HALF_M)
    y = np.arange(150.0)[:, None] * np.ones(200)
    background, moved = (90 + 60 * np.tanh(y - at) for at in (75.0, 75.6))
    moved[40:, 180:] = 250.0
    person, noise = scenes.render(camera, [body], noise=0.0, background=-1.0), scenes.render(camera, [], noise=1.0, background=0.0)
    contour = _before_background(np.where(person >= 0, person + 100, moved) + noise, background, ContourSettings())
    assert np.quantile(apart(scenes, contour, body), 0.95) < 4.0


def test_a_shadow_is_no_part_of_the_person(scenes: Any) -> None:
    camera, body = scenes.three_cameras().cameras[1], scenes.Body(half_m=HALF_M)
    background = scenes.render(camera, [], noise=1.0, seed=1)
    light = np.ones(background.shape, np.float32)
    light[90:140, 60:180] = 0.75
    shaded = scenes.render(camera, [], noise=1.0, seed=2) * cv2.GaussianBlur(light, (0, 0), 4.0)
    person = scenes.render(camera, [body], noise=0.0, background=-1.0) >= 0
    contour = _before_background(np.where(person, scenes.render(camera, [body], noise=1.0, seed=3), shaded), background, ContourSettings())
    assert np.median(apart(scenes, contour, body)) < 2.5 and np.quantile(apart(scenes, contour, body), 0.95) < 5.0  # blurred by 1.5 px


@pytest.mark.slow
def test_the_command(tmp_path: Path, scenes: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """The outline of a rectangle that travels: the median vertex within 1.5 px, and nothing is written for an unknown view."""
    bodies = [scenes.Body(half_m=(0.2, 0.15)).moved(np.eye(3), [0.01 * i, 0.0, 0.0]) for i in range(3)]
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in bodies], noise=1.0)
    assert main(["contour", str(take), "--view", "C", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    rows = list(csv.DictReader((tmp_path / "out" / "contours" / "C.csv").open(encoding="utf-8")))
    for i, body in enumerate(bodies):
        found = np.array([[float(r["x"]), float(r["y"])] for r in rows if int(r["frame"]) == i])
        assert np.median(apart(scenes, found, body)) < 1.5
    out = ["--out", str(tmp_path / "out"), "--quiet"]
    assert main(["contour", str(take), "--view", "L", "R", *out, "--set", "contour.spacing_px=8"]) == 0
    coarse = [len((tmp_path / "out" / "contours" / f"{view}.csv").read_text().splitlines()) for view in "LR"]
    assert max(coarse) < 0.7 * len(rows)
    capsys.readouterr()
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert main(["contour", str(take), "--view", "C", "--frames", "0:2", *out]) == 2
    assert "has results of the frames 0:3, and an outline is tracked in the same ones" in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert main(["contour", str(take), "--view", "X", "--out", str(tmp_path / "none"), "--quiet"]) == 2
    assert "“X”" in capsys.readouterr().err
    assert main(["contour", str(take), "--view", "C", "--from-body", *out]) == 2
    assert "tricap fit" in capsys.readouterr().err
    (tmp_path / "p.csv").write_text("x,y\n1,2\n3,4\n5,1\n")
    assert main(["contour", str(take), "--view", "C", "L", "--polygon", str(tmp_path / "p.csv"), *out]) == 2
    assert "single --view" in capsys.readouterr().err


def test_a_stopped_contour_goes_on_with_the_same_vertices(tmp_path: Path, scenes: Any) -> None:
    """From the fourth frame on, also where the images are followed, from one that is read again; what has other settings is not used."""
    for tracked in (True, False):
        recorded = Recorded(scenes, tmp_path / str(tracked), black=(3,))
        if not tracked:
            recorded.job.trajectories = None
        recorded.job.results, recorded.job.keys = Results(tmp_path / f"out {tracked}"), {"track": "1"}
        start = Start(polygon=outline_of(scenes, recorded.bodies[0])[::400])
        whole = recorded.contours(start)
        begun = track_contour(recorded.job, 1, Monitor(), start, ContourCheckpoints(recorded.job, 1, start))
        assert [next(begun)[0] for _ in range(4)] == [0, 1, 2, 3]
        kept = ContourCheckpoints(recorded.job, 1, start)
        assert kept.load(3) is not None and kept.load(4) is None
        again = [c for _, c in track_contour(recorded.job, 1, Monitor(), start, kept)]
        assert all(np.array_equal(a.xy_px, b.xy_px) and np.array_equal(a.sigma_px, b.sigma_px) for a, b in zip(whole, again, strict=True))
        recorded.job.settings = {"contour": ContourSettings(spacing_px=8.0)}
        assert ContourCheckpoints(recorded.job, 1, start).load(3) is None


@pytest.mark.parametrize("corners, said", [
    ("0,0\n1e9,0\n1e9,1e9\n", "has corners beyond 1e+06 pixels"),
    ("0,0\n20000,0\n20000,20000\n", "reaches further beyond the image of view C than that is large"),
    ("10,10\n-300,10\n20,20\n", "reaches further beyond the image of view C than that is large"),
    ("40,28\n40,28\n40,28\n", "encloses less than a pixel"),
    ("10,10\n20,20\n30,30\n40,40\n", "encloses less than a pixel"),
    ("10,10\n80,60\n80,10\n10,60\n", "after corners 1 and 3 cross; write the corners in order"),
    ("10,10\n80,60\n" * 600, "has 1200 corners; 1000 is the most"),
    ("1,1\n1,71\n95,71\n" + "1,1\n95,71\n" * 450, "px long, and 16000 px is the most at contour.spacing_px = 4"),
])  # fmt: skip
def test_a_polygon_that_is_none_of_a_person_is_refused_at_once(
    tmp_path: Path, scenes: Any, capfd: pytest.CaptureFixture[str], corners: str, said: str
) -> None:
    """22 bytes took 23 GB."""
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(width=96, height=72), [[]] * 2, noise=0.0)
    (tmp_path / "p.csv").write_text("x,y\n" + corners)
    argv = ["contour", str(take), "--view", "C", "--polygon", str(tmp_path / "p.csv"), "--out", str(tmp_path / "out"), "--quiet"]
    assert main(argv) == 2 and said in capfd.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize(("put", "said"), [
    (lambda path: None, "p.csv: No such file or directory."),
    (lambda path: path.mkdir(), "p.csv: it is a folder."),
    (lambda path: path.write_bytes(b"x,y\n\xff,1\n"), "p.csv is not a CSV table (it is not text in UTF-8); save it as CSV in UTF-8."),
    *([(os.mkfifo, "p.csv: it is a device, a pipe or a socket, not a file.")] if os.name != "nt" else []),
])  # fmt: skip
def test_a_polygon_that_cannot_be_read_is_told_in_plain_words(
    tmp_path: Path, scenes: Any, capfd: pytest.CaptureFixture[str], put: Callable[[Path], Any], said: str
) -> None:
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(width=96, height=72), [[]] * 2, noise=0.0)
    put(tmp_path / "p.csv")
    argv = ["contour", str(take), "--view", "C", "--polygon", str(tmp_path / "p.csv"), "--out", str(tmp_path / "out"), "--quiet"]
    assert main(argv) == 2
    printed = capfd.readouterr().err
    assert said in printed and "Errno" not in printed and printed.count("\n") == 1
