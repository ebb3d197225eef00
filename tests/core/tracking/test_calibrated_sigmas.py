"""Sigmas of points tracked in three views against exact motion, and the drift over a hundred frames."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.images.interlace import FieldLayout
from tricap.core.matching.least_squares import MatchingSettings
from tricap.core.tracking.key_points import track_key_points
from tricap.core.tracking.settings import TrackingSettings, TrackStatus
from tricap.core.tracking.step import TrackingView
from tricap.core.tracking.trajectories import assemble

from .test_tracks import errors, moving_plane

FOCAL_PX = 400.0


def waving(scenes: Any, i: int) -> Any:
    """A plane that turns and travels to and fro, by up to 3.5 px a frame."""
    plane = scenes.Body(half_m=(0.3, 0.25), R=rotation_from_vector(np.array([0.1, 0.25, 0.0])), shortest_m=0.027)
    turn = rotation_from_vector(np.array([0.05 * np.sin(i / 11), 0.06 * np.sin(i / 9), 0.1 * np.sin(i / 17)]))
    return plane.moved(turn, [0.06 * np.sin(i / 8), 0.03 * np.sin(i / 6), 0.04 * np.sin(i / 13)])


@pytest.mark.parametrize("frames", [12, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("noise", [1.5, 4.0])
def test_chosen_points(scenes: Any, frames: int, noise: float) -> None:
    """Twenty-four points stay visible, drift by less than 0.3 px across the line of sight, and have calibrated sigmas in space."""
    rig = scenes.three_cameras(width=128, height=96, focal=FOCAL_PX)
    bodies = [waving(scenes, i) for i in range(frames)]
    x, y = np.meshgrid(np.linspace(-0.15, 0.15, 6), np.linspace(-0.1, 0.1, 4))
    own = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    truth = np.stack([own @ b.R.T + b.t for b in bodies])
    clicks = {str(n): {c.name: c.project(truth[0, n]) for c in rig.cameras} for n in range(len(own))}
    view = TrackingView(
        cameras=rig.cameras, reference=1, field_layout=FieldLayout(), matching=MatchingSettings(), tracking=TrackingSettings(), limit_px=0.7
    )
    read = lambda i: [scenes.render(c, [bodies[i]], noise=noise, seed=i) for c in rig.cameras]  # noqa: E731
    points = track_key_points(read, range(frames), clicks, view, Monitor())
    assert (points.status == TrackStatus.MEASURED).all()
    drift_px = np.linalg.norm((points.xyz_m - truth)[..., :2], axis=2) / (scenes.depth_m / FOCAL_PX)
    assert np.percentile(drift_px[-1], 95) < 0.3 and np.median(drift_px[-1]) < 0.1
    z = np.linalg.norm(points.xyz_m - truth, axis=2) / points.sigma_m
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.25


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_points_of_the_surface(tmp_path: Path, scenes: Any, noise: float) -> None:
    """Three frames of a plane through the whole of measuring and tracking: sigmas of the surface, along its normal, and of the tracks."""
    bodies = moving_plane(scenes, 3)
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in bodies], noise=noise)
    measured = scenes.measure(take, tmp_path / "out")
    z = []
    for body, cloud in zip(bodies, (m.cloud for m in measured)):
        own = (cloud.xyz_m - body.t) @ body.R
        inner = (np.abs(own[:, :2]) < np.array(body.half_m) - 0.04).all(axis=1)
        normal = body.R[:, 2]
        z.append((own[:, 2] / np.sqrt(np.einsum("i,nij,j->n", normal, cloud.covariance_m2, normal)))[inner])
    assert 0.8 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.25
    tracks = assemble(scenes.track(take, tmp_path / "out", measured, {"tracking": {"spacing_px": 12}}), 25.0)
    error, on_it = errors(bodies, tracks, 0.035)
    assert 0.8 < np.sqrt(np.nanmean((np.linalg.norm(error, axis=2) / tracks.sigma_m)[:, on_it] ** 2)) < 1.25


@pytest.mark.slow
@pytest.mark.parametrize(("radius_m", "turn_deg", "shift_m"), [(0.05, 0.0, 0.009), (0.08, 8.0, 0.0)])
def test_points_of_a_small_limb(tmp_path: Path, scenes: Any, radius_m: float, turn_deg: float, shift_m: float) -> None:
    """Cylinders of 14 and 22 px radius travel and turn about themselves: sigmas allow for outlines and for no more. Measured z of tracks
    0.91 and 0.93."""
    turn = rotation_from_vector(np.array([0.0, np.radians(turn_deg), 0.0]))
    upright = scenes.Body(radius_m=radius_m, half_m=(9.0, 0.2), shortest_m=0.011, R=rotation_from_vector(np.array([0.0, 0.0, 0.3])))
    bodies = [upright]
    for _ in range(4):
        bodies.append(replace(bodies[-1], R=bodies[-1].R @ turn, t=bodies[-1].t + [shift_m, 0.0, shift_m / 2]))
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in bodies], noise=1.0)
    measured = scenes.measure(take, tmp_path / "out")
    tracks = assemble(scenes.track(take, tmp_path / "out", measured, {"tracking": {"spacing_px": 8}}), 25.0)
    first = tracks.visible.argmax(axis=0)
    own = np.stack([(x[t] - bodies[t].t) @ bodies[t].R for t, x in zip(first, tracks.xyz_m.transpose(1, 0, 2))])
    own[:, [0, 2]] *= radius_m / np.hypot(own[:, 0], own[:, 2])[:, None]
    error = np.stack([x - (own @ b.R.T + b.t) for x, b in zip(tracks.xyz_m, bodies)])
    later = tracks.visible & (np.arange(len(bodies))[:, None] > first)
    distance = np.linalg.norm(error, axis=2)[later]
    z = (distance / tracks.sigma_m[later])[distance < 0.01]
    assert len(z) > 100 and 0.8 < np.sqrt(np.mean(z**2)) < 1.25
