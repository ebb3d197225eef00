"""What the report shows of the closed loop: words, and the predicted and tracked outline over each view."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.report.loop_pictures import PREDICTED, TRACKED, loop_words, outline_pictures
from tricap.core.report.pages import LOOP, _picture_sections
from tricap.core.results.folder import Results
from tricap.core.tracking.contour import HEAD, Contour, contour_rows, resampled
from tricap.core.tracking.trajectories import Trajectories

STEP_PX = 3.0  # that points move to the right in a frame
AHEAD_PX = 4.0  # of the tracked outline, before the predicted one


def square(left: float) -> Contour:
    """A square outline of 40 px, with its left edge in this column."""
    xy = resampled(np.array([[left, 50], [left + 40, 50], [left + 40, 90], [left, 90]]), 4.0)
    return Contour(xy_px=xy, normal=np.tile([1.0, 0.0], (len(xy), 1)), sigma_px=np.ones(len(xy)), on_edge=np.arange(len(xy)) % 2 == 0)


@pytest.fixture
def moving(scenes: Any, tmp_path: Path) -> tuple[Results, Any, Trajectories, Any]:
    """Points inside a square that move by `STEP_PX` in the middle view, whose outline moves by `AHEAD_PX` more."""
    rig = scenes.three_cameras()
    camera = rig["C"]
    grid = np.stack(np.meshgrid(np.arange(82.0, 120, 6), np.arange(52.0, 90, 6)), axis=-1).reshape(-1, 2)
    scale = scenes.depth_m / camera.focal_px
    start = camera.centre_m + ((grid - camera.matrix[:2, 2]) * scale) @ camera.R_cam_world[:2] + scenes.depth_m * camera.R_cam_world[2]
    xyz = start + np.arange(3)[:, None, None] * STEP_PX * scale * camera.R_cam_world[0]
    tracks = Trajectories(frames=np.arange(4, 7), time_s=np.arange(3) / 25, xyz_m=xyz, velocity_m_s=xyz, acceleration_m_s2=xyz,
                          sigma_m=xyz[..., 0], status=np.ones(xyz.shape[:2], bool))  # fmt: skip
    results = Results(tmp_path)
    rows = [contour_rows(4 + t, square(80.0 + t * STEP_PX + (AHEAD_PX if t else 0.0))) for t in (0, 1)]
    results.path("outlines").mkdir()
    results.path("outlines", "C.csv").write_text(HEAD + "".join(rows))
    images = [np.full(c.size_px[::-1], 90.0, np.float32) for c in rig.cameras]
    return results, SimpleNamespace(rig=rig, read_whole=lambda frame: images), tracks, camera


def test_the_predicted_outline_is_that_of_the_frame_before_moved_by_the_points(moving: Any) -> None:
    results, footage, tracks, camera = moving
    ((name, (caption, picture)),) = outline_pictures(results, footage, tracks, near=False).items()
    assert name == "outlines_0005_C.png" and "from that of frame 4" in caption and "50 % of it on an edge" in caption
    scale = picture.shape[1] / camera.size_px[0]
    shown = picture[: round(camera.size_px[1] * scale)].astype(int)
    row = shown[round(70 * scale)]
    for tint, left in ((PREDICTED, 80 + STEP_PX), (TRACKED, 80 + STEP_PX + AHEAD_PX)):
        columns = np.flatnonzero(np.abs(row - tint).max(axis=1) < 60) / scale
        assert abs(columns.min() - left) < 1.0 and abs(columns.max() - left - 40) < 1.0
    legend = picture[len(shown) :].reshape(-1, 3)
    assert all((legend == tint).all(axis=1).sum() > 50 for tint in (PREDICTED, TRACKED))


def test_views_without_outlines_have_no_picture(moving: Any) -> None:
    results, footage, tracks, _ = moving
    assert outline_pictures(results, footage, None, near=True) == {}
    results.path("outlines", "C.csv").write_text(HEAD + contour_rows(4, square(80.0)) + contour_rows(6, square(80.0)))
    assert outline_pictures(results, footage, tracks, near=True) == {}, "no outline has one in the frame before"


def test_the_page_says_that_the_loop_was_closed() -> None:
    figures = {"trajectories": 1234, "mean_length_frames": 16.4}
    stages = {"track": figures, "fit": {"closed_loop": "tracks", "tracked_again": figures | {"mean_length_frames": 17.6}}}
    words = loop_words(stages)
    assert "closed_loop = tracks" in words and "1,234 trajectories of 16.4 frames" in words and "17.6 frames" in words
    assert "outlines" not in words and "outlines" in loop_words({**stages, "fit": stages["fit"] | {"closed_loop": "outlines"}})
    assert loop_words({"track": figures, "fit": {"tracked_again": figures}}) == "" == loop_words({})
    assert _picture_sections({}, "") == [] and _picture_sections({}, "a < b") == [(LOOP, "<p>a &lt; b</p>")]
    sections = dict(_picture_sections({"outlines_0005_C.png": ("why", b"")}, words))
    assert sections[LOOP].startswith("<p>The loop") and "<img" in sections[LOOP]
