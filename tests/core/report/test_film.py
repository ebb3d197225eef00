"""The movie of the body over every frame of every view, from the files of a run."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape, write_body
from tricap.core.body.skeleton import joint_positions
from tricap.core.body.skin.contour_skin import SkinSettings, body_skin
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.motion.formats.ply import write_mesh
from tricap.core.report.film import BAR_PX, HEIGHT_PX, LEGEND_PX, WIDTH_PX, write_film
from tricap.core.results.folder import Results
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

ARM = default_shape(read_model("arm.R"))


@pytest.fixture
def results(tmp_path: Path) -> Results:
    """The files of a fitted arm in two frames of the plane's take, 4 cm further to the right in the second."""
    results, rows = Results(tmp_path / "out"), ["frame,time_s,joint,x,y,z,sigma"]
    for frame in (1, 2):
        values = np.zeros(len(ARM.skeleton.dofs))
        values[:3] = 0.11 + 0.04 * frame, 0.0, 1.9
        skin = body_skin(ARM, values, SkinSettings())
        write_mesh(results.path("skin", f"{frame:04d}.ply"), skin.vertices_m, skin.faces)
        places = joint_positions(ARM.skeleton, ARM.lengths_m, values).items()
        rows += [f"{frame},{frame / 25},{name}," + ",".join(f"{v:.4f}" for v in xyz) + ",0.004" for name, xyz in places]
    results.path("joints.csv").write_text("\n".join(rows) + "\n")
    write_body(results.path("body.toml"), ARM)
    return results


def test_the_body_is_over_every_frame(plane_take: Path, results: Results) -> None:
    footage = open_take(read_take(plane_take))
    movie = cv2.VideoCapture(str(write_film(footage, results, Monitor())))
    pictures = [picture for ok, picture in (movie.read() for _ in range(3)) if ok]
    height, width = pictures[0].shape[0] - BAR_PX, pictures[0].shape[1] // 3
    assert len(pictures) == 2 and pictures[0].shape[1] <= WIDTH_PX and height <= HEIGHT_PX
    assert height > 1.2 * footage.rig.cameras[0].size_px[1], "small footage is enlarged"
    assert movie.get(cv2.CAP_PROP_FPS) == footage.take.fps
    for k, camera in enumerate(footage.rig.cameras):  # the skin is orange; the footage is grey
        orange = [p[:height, k * width : (k + 1) * width].astype(int) for p in pictures]
        orange = [p[..., 2] - p[..., 0] > 30 for p in orange]
        assert 0.05 < orange[0].mean() < 0.5
        moved = np.subtract(*(np.argwhere(p).mean(axis=0) for p in orange[::-1]))[::-1]  # of its middle
        asked = np.subtract(*camera.project(np.array([[0.19, -0.1, 1.9], [0.15, -0.1, 1.9]])))
        assert moved @ asked > 0.9 * np.linalg.norm(moved) * np.linalg.norm(asked) and np.linalg.norm(moved) > 0.7 * np.linalg.norm(asked)
    assert not results.path("cache", "film.mp4").exists()


def test_views_have_names_and_joints_a_legend(plane_take: Path, results: Results) -> None:
    """A name in the corner of every view; under them the frame at the left, and at the right the colours of the sigmas."""
    movie = cv2.VideoCapture(str(write_film(open_take(read_take(plane_take)), results, Monitor())))
    picture = movie.read()[1].astype(int)
    height, width = picture.shape[0] - BAR_PX, picture.shape[1] // 3
    for k in range(3):
        corner = picture[:32, k * width : k * width + 100]
        assert (corner.min(axis=2) > 200).sum() > 30, "letters, which are white: the corner of the footage is grey"
    bar = picture[height + 3 :]
    colourful = np.flatnonzero((np.ptp(bar, axis=2) > 90).sum(axis=0) > 2)
    assert np.ptp(colourful) > LEGEND_PX and colourful.min() > 0.5 * picture.shape[1]
    first, last = (np.median(bar[:, c][np.ptp(bar[:, c], axis=1) > 90], axis=0) for c in (colourful.min() + 3, colourful.max() - 3))
    assert first[0] > first[2] + 60 and last[2] > last[0] + 60, "from blue to red"
    assert (bar[:, :60].min(axis=2) > 200).any() and (bar[:, -30:].min(axis=2) > 200).any()


@pytest.mark.parametrize(
    "other_name", [Path.hardlink_to, pytest.param(Path.symlink_to, marks=pytest.mark.skipif(os.name == "nt", reason="a right"))]
)
def test_a_file_with_another_name_is_not_written_over(plane_take: Path, results: Results, tmp_path: Path, other_name: Any) -> None:
    (tmp_path / "letter.txt").write_text("mine")
    results.path("cache").mkdir()
    other_name(results.path("cache", "film.mp4"), tmp_path / "letter.txt")
    assert write_film(open_take(read_take(plane_take)), results, Monitor()).stat().st_size > 1000
    assert (tmp_path / "letter.txt").read_text() == "mine"


def test_a_stopped_film_is_no_film(plane_take: Path, results: Results) -> None:
    monitor = Monitor()
    footage = open_take(read_take(plane_take))
    results.path("film.mp4").write_bytes(b"before")
    monitor.cancel()
    with pytest.raises(Cancelled):
        write_film(footage, results, monitor)
    assert results.path("film.mp4").read_bytes() == b"before" and not results.path("cache", "film.mp4").exists()


def test_a_film_needs_a_body(plane_take: Path, results: Results, scenes: Any) -> None:
    results.remove("skin")
    with pytest.raises(InputError, match="no fitted body with a skin"):
        write_film(open_take(read_take(plane_take)), results, Monitor())


def test_a_film_that_lost_frames_is_no_film(plane_take: Path, results: Results, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a full disk, of which the writer says nothing."""

    class Lossy:
        def __init__(self, *given: Any) -> None:
            self.isOpened, self.release = lambda: True, lambda: None

        def write(self, picture: np.ndarray) -> None:
            pass

    lossy: Any = type("Writer", (Lossy,), {"fourcc": staticmethod(cv2.VideoWriter.fourcc)})
    monkeypatch.setattr(cv2, "VideoWriter", lossy)
    with pytest.raises(InputError, match="could not be written whole"):
        write_film(open_take(read_take(plane_take)), results, Monitor())
    assert not results.path("film.mp4").exists() and not results.path("cache", "film.mp4").exists()
