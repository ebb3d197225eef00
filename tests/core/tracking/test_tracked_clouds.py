"""The surface of each frame cleaned by tracking: its files, and as the cloud of a fit."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from tricap.core.fitting.inputs.cloud_points import Cloud, thinned, tracked_clouds
from tricap.core.fitting.inputs.completed_clouds import clouds_for_fit
from tricap.core.fitting.settings import FitSettings
from tricap.core.foundation.progress import Monitor
from tricap.core.motion.formats.ply import read_ply
from tricap.core.results.folder import Results
from tricap.core.surface.cloud import PointCloud
from tricap.core.take.footage import Footage
from tricap.core.tracking.settings import TrackStatus
from tricap.core.tracking.trajectories import Trajectories, with_kinematics, write_tracked_clouds


@pytest.fixture
def tracks() -> Trajectories:
    """Three points in frames 5, 6, 7 that move by 10 mm a frame; the second is lost after frame 5, nothing is seen in frame 7."""
    xyz = np.arange(3)[:, None, None] * np.array([0.01, 0, 0]) + np.array([[0, 0, 1], [0.1, 0, 1], [0.2, 0, 1]])
    xyz[1:, 1] = xyz[2] = np.nan
    sigma = np.where(np.isfinite(xyz[..., 0]), 0.003, np.nan)
    status = np.where(np.isfinite(sigma), TrackStatus.MEASURED, TrackStatus.ABSENT)
    return with_kinematics(np.array([5, 6, 7]), np.arange(3) / 25, xyz, sigma, status, 0)


def test_the_points_of_each_frame_are_written(tracks: Trajectories, tmp_path: Path) -> None:
    write_tracked_clouds(tmp_path, tracks, Monitor())
    files = {path.name: read_ply(path) for path in (tmp_path / "tracked").iterdir()}
    assert sorted(files) == ["0005.ply", "0006.ply", "0007.ply"] and len(files["0007.ply"].xyz_m) == 0
    later = files["0006.ply"]
    assert np.allclose(later.xyz_m, [[0.01, 0, 1], [0.21, 0, 1]]) and later.vertex["track"].tolist() == [0, 2]
    assert np.allclose(later.vertex["vx"], 0.25) and np.allclose(later.vertex["sigma"], 0.003)


def test_as_clouds_for_the_fit(tracks: Trajectories) -> None:
    """Of every frame asked for; the sigma of a residual is one axis' share, for there are no normals."""
    clouds = tracked_clouds(tracks, range(4, 8))
    assert [(c.frame, len(c.xyz_m)) for c in clouds] == [(4, 0), (5, 3), (6, 2), (7, 0)]
    points = thinned(clouds[1], 0.008)
    assert len(points.xyz_m) == 3 and np.allclose(points.sigma_m, 0.003 / np.sqrt(3)) and not points.normals.any()


def test_the_fit_rests_on_them_where_that_is_asked_for(tracks: Trajectories, tmp_path: Path) -> None:
    """`fitting.cloud=tracked`; by default on the measured ones."""
    footage, measured = cast(Footage, SimpleNamespace(frames=range(5, 8))), cast(Sequence[PointCloud], [object()])

    def clouds(**settings: str) -> Sequence[Cloud]:
        return clouds_for_fit(footage, measured, tracks, (), FitSettings(**settings), Results(tmp_path), Monitor())

    assert clouds() is measured
    assert [(c.frame, len(c.xyz_m)) for c in clouds(cloud="tracked")] == [(5, 3), (6, 2), (7, 0)]
