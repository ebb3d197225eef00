"""Corrections by hand: polygons, regions and clicked trajectories; the verdict on every raw trajectory."""

import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.checking.take_check import check_take
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.rig import Rig
from tricap.core.run.take_run import open_run
from tricap.core.surface.cloud import PointCloud
from tricap.core.take.footage import open_take
from tricap.core.take.take import Correction, read_take
from tricap.core.tracking.corrections import corrected_cloud, corrected_tracks, inside_polygon, missed_clicks, odd_regions
from tricap.core.tracking.settings import TrackingSettings, TrackStatus
from tricap.core.tracking.trajectories import Trajectories, filter_trajectories, with_kinematics

CAMERA = Camera(name="C", size_px=(400, 300), matrix=np.array([[500.0, 0, 200], [0, 500, 150], [0, 0, 1]]))
RIG = Rig(cameras=(CAMERA,), metadata={})
SETTINGS = TrackingSettings(uniformity="off")
FRAMES = 12
L_SHAPE = np.array([[0, 0], [10, 0], [10, 10], [5, 10], [5, 5], [0, 5]], dtype=float)


def test_inside_polygon() -> None:
    xy = np.array([[1, 1], [9, 9], [2, 8], [11, 1], [np.nan, 1]])
    assert inside_polygon(xy, L_SHAPE).tolist() == [True, True, False, False, False]
    assert inside_polygon(xy, L_SHAPE[::-1]).tolist() == [True, True, False, False, False]


def test_inside_polygon_is_the_even_odd_rule() -> None:
    rng = np.random.default_rng(3)
    xy = np.concatenate([rng.uniform(-20, 120, (3000, 2)), rng.integers(0, 100, (500, 2)), [[np.nan, 5], [np.inf, 5]]])
    for corners in (3, 4, 60):
        polygon = rng.integers(0, 100, (corners, 2)).astype(float)
        a, b = polygon, np.roll(polygon, -1, axis=0)
        x, y = xy[:, None, 0], xy[:, None, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
            rule = ((((a[:, 1] > y) != (b[:, 1] > y)) & (x < at)).sum(axis=1) % 2 == 1) & np.isfinite(xy).all(axis=1)
        assert np.array_equal(inside_polygon(xy, polygon), rule) and 100 < rule.sum() < 2900


def rectangle(x0: float, y0: float, x1: float, y1: float, frames: range = range(4)) -> Correction:
    return Correction(kind="region", view="C", frames=frames, xy_px=np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))


WHOLE = rectangle(0, 0, 399, 299)
LEFT, RIGHT = rectangle(-5, -5, 210, 305), rectangle(200, -5, 405, 305, range(2, 9))


@pytest.mark.parametrize(("regions", "said"), [
    ([WHOLE], "at (0, 0) of view C encloses the whole image, so that no points remain in frames 0 to 3"),
    ([LEFT, RIGHT], "regions of view C together enclose the whole image, so that no points remain in frames 2 to 3"),
    ([LEFT, rectangle(200, -5, 405, 305, range(3, 4))], "together enclose the whole image, so that no points remain in frame 3"),
    ([LEFT, rectangle(200, -5, 405, 305, range(4, 9))], ""),
    ([LEFT, LEFT, rectangle(240, -5, 405, 305)], ""),
    ([LEFT], ""),
])  # fmt: skip
def test_regions_that_leave_nothing_of_the_image_are_named(regions: list[Correction], said: str) -> None:
    """The last row and the last column of the image lie on the polygon of `WHOLE`, and outside of it."""
    found = odd_regions(regions, RIG)
    assert len(found) == bool(said) and all(said in sentence for sentence in found), found


def test_regions_away_from_the_points_cost_next_to_nothing() -> None:
    """50 regions of 1,000 corners took 40 s in the fit of two frames."""
    xy = np.random.default_rng(0).uniform(0, 600, (7000, 2))
    turn = np.linspace(0, 2 * np.pi, 1000, endpoint=False)[:, None]
    polygon = np.array([650.0, 500.0]) + 40 * np.hstack([np.cos(turn), np.sin(turn)])
    began = time.process_time()
    assert sum(int(inside_polygon(xy, polygon).sum()) for _ in range(50)) == 0
    assert time.process_time() - began < 2.0  # 16 s before


def row(frames: int = FRAMES, columns: int = 9) -> Trajectories:
    """Points 20 px apart in a row that moves 2 px a frame to the right, 2 m away."""
    u = 100 + 20.0 * np.arange(columns) + 2.0 * np.arange(frames)[:, None]
    xyz = CAMERA.points_at_depth(np.stack([u, np.full_like(u, 150)], axis=-1).reshape(-1, 2), 2.0).reshape(frames, columns, 3)
    status = np.full((frames, columns), TrackStatus.MEASURED, dtype=np.int8)
    return with_kinematics(np.arange(frames), np.arange(frames) / 25, xyz, np.full((frames, columns), 1e-4), status, 0)


def click(x: float, y: float, frame: int) -> Correction:
    return Correction(kind="trajectory", view="C", frames=range(frame, frame + 1), xy_px=np.array([[x, y]]))


def region(frames: range, x0: float, x1: float) -> Correction:
    return Correction(kind="region", view="C", frames=frames, xy_px=np.array([[x0, 140], [x1, 140], [x1, 160], [x0, 160]], dtype=float))


def test_a_clicked_trajectory_is_removed_entirely() -> None:
    clicks = [click(147, 152, 3), click(10, 10, 3)]  # column 2 is at 146
    filtered, hit = corrected_tracks(row(), clicks, RIG, SETTINGS, Monitor())
    assert filtered.source.tolist() == [0, 1, 3, 4, 5, 6, 7, 8] and filtered.kept.visible.all()
    assert (filtered.raw.status[:, 2] == TrackStatus.REMOVED_BY_USER).all() and filtered.raw.visible.all()
    assert filtered.reason[2] == TrackStatus.REMOVED_BY_USER and filtered.reason[3] == TrackStatus.MEASURED
    missed = missed_clicks(clicks, hit)
    assert hit == {0: 2} and len(missed) == 1 and "(10, 10)" in missed[0]
    assert not corrected_tracks(row(), clicks, RIG, SETTINGS, Monitor(), range(4, FRAMES))[1]  # rows that do not hold the clicks' frame


def test_a_region_leaves_gaps_and_removes_the_points_of_the_clouds() -> None:
    take_out = [region(range(4, 7), 135, 165)]
    raw = row()
    filtered, hit = corrected_tracks(raw, take_out, RIG, SETTINGS, Monitor())
    u = CAMERA.project(raw.xyz_m.reshape(-1, 3))[:, 0].reshape(raw.visible.shape)
    gone = (u > 135) & (u < 165) & ((np.arange(FRAMES) >= 4) & (np.arange(FRAMES) < 7))[:, None]
    assert gone.any() and not hit
    assert np.array_equal(filtered.raw.status == TrackStatus.REMOVED_BY_USER, gone)
    assert np.array_equal(filtered.kept.visible, ~gone) and np.array_equal(filtered.kept.status == TrackStatus.REMOVED_BY_USER, gone)
    n = raw.visible.shape[1]
    cloud = PointCloud(frame=4, xyz_m=raw.xyz_m[4], covariance_m2=np.tile(np.eye(3), (n, 1, 1)), normals=np.zeros((n, 3)),
                       intensity=np.arange(n), xy_px=np.zeros((n, 1, 2)), residual_px=np.zeros(n), extended=np.zeros(n))  # fmt: skip
    assert np.array_equal(corrected_cloud(cloud, take_out, RIG).intensity, np.flatnonzero(~gone[4]))
    assert corrected_cloud(replace(cloud, frame=7), take_out, RIG).intensity.size == n


@pytest.mark.parametrize("frames", [2, 3, 4])
def test_a_short_recording_keeps_what_lasts(frames: int) -> None:
    raw = row(frames)
    assert filter_trajectories(raw, SETTINGS).kept.visible.all()
    xyz = raw.xyz_m.copy()
    xyz[1:, 0] = np.nan
    short = with_kinematics(raw.frames, raw.time_s, xyz, raw.sigma_m, np.where(np.isnan(xyz[..., 0]), 0, 1), 0)
    filtered = filter_trajectories(short, SETTINGS)
    assert 0 not in filtered.source and filtered.reason[0] == TrackStatus.TOO_SHORT


@pytest.mark.slow
def test_a_region_that_encloses_nothing_of_the_image_is_named(plane_take: Path, tmp_path: Path) -> None:
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    text = (take / "take.toml").read_text(encoding="utf-8")
    for polygon, odd in (
        ("[[10000, 10000], [10100, 10000], [10100, 10100]]", True),
        ("[[0, 0], [70, 0], [0, 0]]", True),
        ("[[10, 10], [60, 10], [60, 60]]", False),
    ):
        entry = f'\n[[corrections]]\nkind = "region"\nview = "C"\nframes = [0, 2]\npolygon = {polygon}\n'
        (take / "take.toml").write_text(text + entry, encoding="utf-8")
        with open_run(take, tmp_path / "out", frames=(0, 2)) as job:
            assert any("encloses nothing of the image" in warning for warning in job.record["warnings"]) == odd
        assert any("encloses nothing of the image" in finding.sentence for finding in check_take(take, Monitor()).findings) == odd
    whole = entry.replace(polygon, "[[-1000, -1000], [9000, -1000], [9000, 9000], [-1000, 9000]]")
    (take / "take.toml").write_text(text + whole, encoding="utf-8")
    assert any(
        "encloses the whole image, so that no points remain in frames 0 to 1" in f.sentence for f in check_take(take, Monitor()).findings
    )
    for frames in ("frames = [20, 30]", "frames = [4, 5]"):
        (take / "take.toml").write_text(text + entry.replace("frames = [0, 2]", frames), encoding="utf-8")
        with pytest.raises(InputError, match="A correction of take in view C is for frame.* and the take has the frames 0 to 3"):
            open_take(read_take(take))
