"""The 2-D mode: exact motion of a warped texture, drift, occlusion, tables and the command."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.images.interlace import row_grid
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.report.point_pictures import COLOURS
from tricap.core.tracking.planar import PlanarTracks, track_planar
from tricap.core.tracking.point_tables import read_planar, read_points, read_polygon
from tricap.core.tracking.settings import TrackingSettings, TrackStatus

SIZE = (200, 160)


def texture(xy: np.ndarray) -> np.ndarray:
    """Sixty waves of 6 to 24 px."""
    random = np.random.default_rng(0)
    k = random.standard_normal((60, 2))
    k *= (2 * np.pi / np.exp(random.uniform(np.log(6), np.log(24), 60)) / np.linalg.norm(k, axis=1))[:, None]
    return 127 + 25 * np.sqrt(2 / 60) * np.cos(xy @ k.T + random.uniform(0, 2 * np.pi, 60)).sum(axis=-1)


def place(i: int) -> tuple[np.ndarray, np.ndarray]:
    """Frame i is the texture turned and shifted: x_i = A x + b."""
    a = np.radians(0.25 * i)
    A = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) * (1 + 0.0005 * i)
    c = np.array([100.0, 80.0])
    return A, c - A @ c + (9 * np.sin(i / 9), 5 * np.cos(i / 7) - 5)


def film(count: int, noise: float = 2.0) -> list[np.ndarray]:
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(float)
    frames = []
    for i in range(count):
        A, b = place(i)
        own = (np.stack([x, y], axis=-1) - b) @ np.linalg.inv(A).T
        frames.append((texture(own) + noise * np.random.default_rng(i).standard_normal(x.shape)).astype(np.float32))
    return frames


POINTS = np.stack(np.meshgrid(np.arange(60, 150, 22), np.arange(50, 120, 22)), axis=-1).reshape(-1, 2).astype(float)


def follow(frames: list[np.ndarray], **settings: Any) -> PlanarTracks:
    return track_planar(lambda i: frames[i], range(len(frames)), POINTS, MatchingSettings(), TrackingSettings(**settings), Monitor())


@pytest.mark.slow
def test_drift_over_a_hundred_frames() -> None:
    """Less than 0.3 px with the key templates, with calibrated sigmas; without them several times as much."""
    frames = film(100)
    truth = np.stack([POINTS @ place(i)[0].T + place(i)[1] for i in range(100)])
    controlled, free = (follow(frames, drift_correlation=c) for c in (0.8, 1.0))
    off = [np.linalg.norm(t.xy_px - truth, axis=2) for t in (controlled, free)]
    assert (controlled.status == TrackStatus.MEASURED).all()
    assert np.percentile(off[0][-1], 95) < 0.3 and np.median(off[0][-1]) < 0.1 < np.median(off[1][-1])
    z = off[0][5:] / controlled.sigma_px[5:]
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.25


def test_an_occluded_point_is_reacquired() -> None:
    """A patch covers four points for three frames: they end with a reason, and return where they are."""
    frames = film(9)
    for i in (3, 4, 5):
        frames[i][30:80, 40:110] = 128 + 30 * np.random.default_rng(i).standard_normal((50, 70))
    tracks = follow(frames)
    truth = np.stack([POINTS @ place(i)[0].T + place(i)[1] for i in range(9)])
    hidden = (POINTS[:, 0] < 100) & (POINTS[:, 1] < 70)
    assert (tracks.status[3:6, hidden] > TrackStatus.MEASURED).all() and np.isnan(tracks.xy_px[3:6, hidden]).all()
    assert (tracks.status[7:, hidden] == TrackStatus.MEASURED).mean() > 0.7
    ended = follow(frames, wait_frames=2)
    assert (ended.status[4:, hidden & (tracks.status[3] > TrackStatus.MEASURED)] > TrackStatus.MEASURED).all()
    far = (POINTS[:, 0] > 120) | (POINTS[:, 1] > 95)
    assert (tracks.status[:, far] == TrackStatus.MEASURED).all()
    assert np.nanmax(np.linalg.norm(tracks.xy_px - truth, axis=2)) < 0.5


def test_black_frames_are_no_crash() -> None:
    frames = film(6)
    frames[2][:] = 0
    tracks = follow(frames)
    assert (tracks.status[2] != TrackStatus.MEASURED).all() and (tracks.status[4] == TrackStatus.MEASURED).all()


def test_a_field_of_interlaced_video() -> None:
    """The other lines show other moments, now earlier, now later: one field alone gives its own places, and both together do not."""
    others, shown = film(30), film(6)
    for i in range(6):
        shown[i][1::2] = others[5 * i][1::2]
    truth = np.stack([POINTS @ place(i)[0].T + place(i)[1] for i in range(6)])
    how = (range(6), POINTS, MatchingSettings(), TrackingSettings(), Monitor())
    field, both = (track_planar(lambda i: shown[i], *how, grid=row_grid(lines)) for lines in ("odd", "none"))
    assert (field.status == TrackStatus.MEASURED).all()
    off = np.linalg.norm(field.xy_px - truth, axis=2)
    assert off.max() < 0.5 and 0.4 < np.sqrt(np.mean((off[1:] / field.sigma_px[1:]) ** 2)) < 1.6
    assert (both.status[3] == TrackStatus.MEASURED).mean() < 0.5


def write(folder: Path, frames: list[np.ndarray]) -> Path:
    folder.mkdir()
    for i, f in enumerate(frames):
        (folder / f"{i:03d}.png").write_bytes(cv2.imencode(".png", np.clip(np.rint(f), 0, 255).astype(np.uint8))[1].tobytes())
    return folder


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence, table, out = write(tmp_path / "face", film(4)), tmp_path / "points.csv", tmp_path / "out.csv"
    table.write_text("point,x,y,joined_to\nnose,80,70,\nchin,82,100,nose\n", encoding="utf-8")
    assert main(["track2d", str(sequence), "--points", str(table), "--out", str(out), "--pictures", str(tmp_path / "p"), "--quiet"]) == 0
    lines = out.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "frame,point,x,y,sigma,correlation,status" and len(lines) == 9 and lines[-1].startswith("3,chin,")
    assert all(line.endswith("measured") for line in lines[1:])
    last = np.array(lines[-1].split(",")[2:4], dtype=float)
    assert np.allclose(last, place(3)[0] @ (82, 100) + place(3)[1], atol=0.3)
    assert len(list((tmp_path / "p").glob("*.png"))) == 4
    picture = cv2.imread(str(tmp_path / "p" / "0003.png")).astype(int)
    for tint, (x, y) in zip(COLOURS, (place(3)[0] @ xy + place(3)[1] for xy in np.array([[80, 70], [82, 100]]))):
        near = np.abs(picture - tint).max(axis=2) < 60
        x, y = round(float(x)), round(float(y))
        assert near[y - 3 : y + 4, x - 3 : x + 4].sum() > 5, "a cross"
        assert near[y - 16 : y - 3, x + 8 : x + 40].sum() > 15, "a name above it, to the right"
    table_read = read_planar(out)
    assert table_read.names == ("nose", "chin") and table_read.frames.tolist() == [0, 1, 2, 3] and np.allclose(table_read.xy_px[3, 1], last)
    for text, said in (("point,x,y\na,1,nan\n", "line 2"), ("point,x\na,1\n", "“y”"), ("point,x,y\na,500,5\n", "outside"),
                       ("", "no points"), ("point,x,y,joined_to\na,5,5,b\n", "joins"), ("point,x,y\na,5,5\na,6,6\n", "twice"),
                       ("point;x;y\na;5;5\n", "by commas, not semicolons"),
                       ('point,x,y\na,"5,5",5\n', "with a point for decimals")):  # fmt: skip
        table.write_text(text, encoding="utf-8")
        capsys.readouterr()
        assert main(["track2d", str(sequence), "--points", str(table), "--out", str(tmp_path / "bad.csv"), "--quiet"]) == 2
        assert said in capsys.readouterr().err.lower() and not (tmp_path / "bad.csv").exists()
    assert main(["track2d", str(tmp_path / "none.mp4"), "--points", str(table), "--out", str(out), "--quiet"]) == 2


def test_files_that_are_no_tables(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    for data in (b"\xff\xfe\x00", b"x,y\n1,2\n", b"a,b\n1,2\n3,4\n5,6\n"):
        path.write_bytes(data)
        with pytest.raises(InputError):
            read_polygon(path)
        with pytest.raises(InputError):
            read_points(path)
    path.write_text("point,x,y\n" + "".join(f"p{i},1,2\n" for i in range(10_001)), encoding="utf-8")
    with pytest.raises(InputError, match="has 10001 points; 10000 is the most"):
        read_points(path)
    path.write_text("x,y,point\n1,2\n", encoding="utf-8")
    with pytest.raises(InputError, match="not at all"):
        read_points(path)
    path.write_text("x,y\n1,2\n3,4\n5,9\n", encoding="utf-8")
    assert read_polygon(path).tolist() == [[1, 2], [3, 4], [5, 9]]
