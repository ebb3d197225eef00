"""Tracking against exact motion: drift, sigma, false points, fields, new points; trajectories, their kinematics and their filters."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.tracking.step import TrackStatus
from tricap.core.tracking.trajectories import Trajectories, assemble

FRAMES = 8
COARSE = {"growing": {"spacing_px": 6}}


def moving_plane(scenes: Any, frames: int, half_m: tuple[float, float] = (0.24, 0.18)) -> list[Any]:
    """A plane that travels 0.25 m/s (2.8 px a frame at 25 frames/s) and turns by 40°/s about an axis across all three."""
    plane = scenes.Body(half_m=half_m, R=rotation_from_vector(np.array([0.1, 0.25, 0.0])), t=np.array([-0.06, 0.01, 2.16]))
    return [plane.moved(rotation_from_vector(i * np.radians(1.6) * np.array([0.3, 0.4, 0.87])), [0.009 * i, -0.003 * i, 0.004 * i])
            for i in range(frames)]  # fmt: skip


def errors(bodies: list[Any], tracks: Trajectories, margin_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Position (T, N, 3) minus the material point of each trajectory's first position, and which started on the plane."""
    T, N = tracks.visible.shape
    first = tracks.visible.argmax(axis=0)
    own = np.stack([(tracks.xyz_m[first[n], n] - bodies[first[n]].t) @ bodies[first[n]].R for n in range(N)])
    on_it = (np.abs(own[:, :2]) < np.array(bodies[0].half_m) - margin_m).all(axis=1)
    own[:, 2] = 0.0  # the material point is on the plane
    return np.stack([tracks.xyz_m[t] - (own @ bodies[t].R.T + bodies[t].t) for t in range(T)]), on_it


@pytest.mark.slow
@pytest.mark.parametrize(("interlaced", "noise"), [("none", 1.0), ("odd", 1.0)])
def test_a_turning_and_travelling_plane(tmp_path: Path, scenes: Any, interlaced: str, noise: float) -> None:
    """No point is lost in the middle, none is false, and the drift is less than 0.3 px across the line of sight."""
    bodies, rig = moving_plane(scenes, FRAMES), scenes.three_cameras()
    take = scenes.write_take(tmp_path / "take", rig, [[b] for b in bodies], noise=noise, interlaced=interlaced)
    measured = scenes.measure(take, tmp_path / "out", COARSE)
    tracks = assemble(scenes.track(take, tmp_path / "out", measured, {"tracking": {"spacing_px": 12}}), 25.0)
    error, on_it = errors(bodies, tracks, 0.035)
    assert on_it.sum() > 50 and np.array_equal(tracks.frames, np.arange(FRAMES))
    seen = tracks.visible[:, on_it]
    old = on_it & tracks.visible[0]
    assert tracks.visible[-1, old].mean() > 0.95  # the rest came too near to the edge
    drift_px = np.linalg.norm(error[..., :2], axis=2)[:, on_it] / scenes.pixel_m
    assert np.nanmax(drift_px) < 1.0  # no false one at all
    assert np.nanpercentile(drift_px[-1], 99) < 0.3 and np.nanmedian(drift_px[-1]) < 0.15
    assert np.abs(np.nanmean(error[-1][on_it][:, :2], axis=0)).max() < 0.1 * scenes.pixel_m  # no common drift
    assert np.nanmax(np.abs(error[:, on_it, 2])) < 0.012 and np.nanstd(error[:, on_it, 2]) < 0.002
    lateral = np.abs(error[0][tracks.visible[0] & on_it])
    assert lateral[:, :2].max() < 0.1 * scenes.pixel_m
    assert seen.sum(axis=0).max() == FRAMES


@pytest.mark.slow
def test_shading_that_stays_in_place_does_not_hold_a_point_back(tmp_path: Path, scenes: Any) -> None:
    """Weak texture that moves under light and shade: the points go with the texture."""
    bodies, rig = moving_plane(scenes, FRAMES), scenes.three_cameras()
    take = scenes.write_take(tmp_path / "take", rig, [[b] for b in bodies], noise=0.0)
    measured = scenes.measure(take, tmp_path / "out", COARSE)
    for file in sorted((tmp_path / "take").rglob("*.png")):
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE).astype(float)
        y, x = np.indices(grey.shape)
        shaded = 128 + 0.15 * (grey - 128) + 40 * np.sin(x / 14) * np.cos(y / 17)
        cv2.imwrite(str(file), np.rint(shaded))
    tracks = assemble(scenes.track(take, tmp_path / "out", measured, {"tracking": {"spacing_px": 12}}), 25.0)
    error, on_it = errors(bodies, tracks, 0.035)
    drift_px = np.linalg.norm(error[..., :2], axis=2)[:, on_it & tracks.visible[0]] / scenes.pixel_m
    assert np.isfinite(drift_px[-1]).sum() > 30 and np.nanmedian(drift_px[-1]) < 0.2


@pytest.mark.slow
def test_points_are_followed_in_the_images_in_which_they_were_measured(tmp_path: Path, scenes: Any) -> None:
    """Where noise hides the texture, surface and tracks are both measured in smoothed images."""
    bodies, rig = moving_plane(scenes, 3), scenes.three_cameras()
    take = scenes.write_take(tmp_path / "take", rig, [[b] for b in bodies], noise=20.0)
    measured = scenes.measure(take, tmp_path / "out", COARSE)
    assert {m.smoothed_px for m in measured} == {1.0}
    raw = [replace(m, smoothed_px=0.0) for m in measured]
    followed = []
    for name, frames in (("smooth", measured), ("raw", raw)):
        tracks = assemble(scenes.track(take, tmp_path / name, frames, {"tracking": {"spacing_px": 12}}), 25.0)
        error, on_it = errors(bodies, tracks, 0.035)
        drift_px = np.linalg.norm(error[..., :2], axis=2)[:, on_it & tracks.visible[0]] / scenes.pixel_m
        followed.append(np.flatnonzero(drift_px[-1] < 0.5))
    assert len(followed[0]) > max(30, 2 * len(followed[1]))


@pytest.mark.slow
def test_both_fields_track_the_plane_at_twice_the_rate(tmp_path: Path, scenes: Any) -> None:
    """Points of one field are found in the other, half a line away: no jitter from field to field."""
    bodies = moving_plane(scenes, 4)
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in bodies], noise=1.0, interlaced="both")
    measured = scenes.measure(take, tmp_path / "out", COARSE)
    assert [m.frame for m in measured] == list(range(4)) and [m.field.grid.rows.offset for m in measured] == [0, 1, 0, 1]
    tracks = assemble(scenes.track(take, tmp_path / "out", measured, {"tracking": {"spacing_px": 12}}), 50.0)
    error, on_it = errors(bodies, tracks, 0.035)
    whole = on_it & tracks.visible.all(axis=0)
    assert whole.sum() > 50
    across = error[:, whole, :2]
    assert np.abs(across).max() < 1.0 * scenes.pixel_m
    jitter = np.median(across[1::2], axis=(0, 1)) - np.median(across[::2], axis=(0, 1))
    assert np.abs(jitter).max() < 0.05 * scenes.pixel_m  # half a line would be 0.5
    assert np.array_equal(tracks.time_s, np.arange(4) / 50.0)


@pytest.mark.slow
def test_velocity_and_acceleration(tmp_path: Path, scenes: Any) -> None:
    """The mean over all points of velocity against the true one; its scatter is that of the positions."""
    bodies = moving_plane(scenes, 5)
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in bodies], noise=1.0)
    tracks = assemble(scenes.track(take, tmp_path / "out", scenes.measure(take, tmp_path / "out", COARSE)), 25.0)
    whole = tracks.visible.all(axis=0)
    assert whole.sum() > 60
    X = tracks.xyz_m[2, whole]
    own = (X - bodies[2].t) @ bodies[2].R
    true = (own @ bodies[3].R.T + bodies[3].t - own @ bodies[1].R.T - bodies[1].t) * 25 / 2
    e = tracks.velocity_m_s[2, whole] - true
    assert np.abs(np.median(e, axis=0)).max() < 0.01  # of 0.25 m/s
    assert np.median(np.abs(e[:, :2])) < 0.01 and np.median(np.abs(e[:, 2])) < 0.03  # depth is four times less sure
    assert np.isnan(tracks.acceleration_m_s2[[0, -1]]).all() and np.isfinite(tracks.velocity_m_s[[0, -1]][:, whole]).all()


@pytest.mark.slow
def test_new_points_start_where_the_surface_has_none(tmp_path: Path, scenes: Any) -> None:
    """A plane comes into the picture: later frames have as many points per area as the first, no closer, and new ones in every second
    frame only."""
    plane = scenes.Body(half_m=(0.5, 0.18), R=rotation_from_vector(np.array([0.1, 0.15, 0.0])), t=np.array([-0.75, 0.0, 2.16]))
    bodies = [plane.moved(np.eye(3), [0.05 * i, 0.0, 0.0]) for i in range(6)]
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in bodies], noise=1.0)
    measured = scenes.measure(take, tmp_path / "out", COARSE)
    steps = scenes.track(take, tmp_path / "out", measured, {"tracking": {"regenerate_every": 2}})
    growth = [len(m.cloud.xyz_m) / len(measured[0].cloud.xyz_m) for m in measured]
    assert growth[4] > 1.4
    assert len(steps[4].identity) > 0.75 * growth[4] * len(steps[0].identity)
    identities = np.concatenate([s.identity for s in steps])
    assert all((np.diff(s.identity) > 0).all() for s in steps) and identities.max() + 1 == len(np.unique(identities))
    known = np.unique(steps[0].identity)
    for i, s in enumerate(steps[1:], start=1):
        assert np.isin(s.identity, known).all() == bool(i % 2), "new points start at the interval that was asked for"
        known = np.union1d(known, s.identity)
    closest = [np.sort(cKDTree(xy).query(xy, 2)[0][:, 1])[5] for xy in (steps[i].xy[:, 1] for i in (0, 4))]
    assert closest[1] > 0.7 * closest[0], "and only where there are none"
    none = scenes.track(take, tmp_path / "none", measured, {"tracking": {"regenerate_every": 0}})
    assert all(set(s.identity) <= set(none[0].identity) for s in none)
    assert all(len(s.ended) == len(np.unique(s.ended)) for s in steps)
    for before, after in zip(steps, steps[1:]):
        assert set(before.identity) - set(after.identity) == set(after.ended)


def test_an_occluded_point_ends_with_a_reason(tmp_path: Path, scenes: Any) -> None:
    """A second body occludes half of the plane from one frame to the next: its points end, and none jumps onto the other texture."""
    plane = scenes.Body(half_m=(0.24, 0.18))
    hider = scenes.Body(half_m=(0.12, 0.3), t=np.array([0.15, 0.0, 1.8]), seed=5)
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[plane], [plane], [plane, hider]], noise=1.0)
    steps = scenes.track(take, tmp_path / "out", scenes.measure(take, tmp_path / "out", COARSE), {"tracking": {"regenerate_every": 0}})
    x = dict(zip(steps[1].identity, steps[1].xyz_m[:, 0]))
    hidden = [i for i in steps[1].identity if x[i] > 0.10]
    assert len(hidden) > 20 and set(hidden) <= set(steps[2].ended)
    assert set(steps[2].reason) <= {int(s) for s in TrackStatus} - {TrackStatus.ABSENT, TrackStatus.MEASURED}
    before = steps[1].xyz_m[np.searchsorted(steps[1].identity, steps[2].identity)]
    moved = np.linalg.norm(steps[2].xyz_m[:, :2] - before[:, :2], axis=1)
    assert moved.max() < 0.3 * scenes.pixel_m


@pytest.mark.slow
def test_lost_points_resume_under_their_identity(tmp_path: Path, scenes: Any) -> None:
    """A bar occludes part of a travelling plane in one frame: its points resume in their places, but not without waiting."""
    bodies = [scenes.Body(half_m=(0.24, 0.18)).moved(np.eye(3), [0.004 * i, 0.002 * i, 0.0]) for i in range(4)]
    bar = scenes.Body(half_m=(0.01, 0.3), t=np.array([0.0, 0.0, 1.95]), seed=5)
    shown = [[b, bar] if i == 2 else [b] for i, b in enumerate(bodies)]
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), shown, noise=1.0)
    measured = scenes.measure(take, tmp_path / "out", COARSE)
    regained = {}
    for wait in (5, 0):
        steps = scenes.track(take, tmp_path / "out", measured, {"tracking": {"regenerate_every": 0, "wait_frames": wait}})
        hidden = np.setdiff1d(steps[1].identity, steps[2].identity)
        regained[wait] = np.isin(hidden, steps[3].identity)
        back = np.isin(steps[3].identity, hidden)
        was = steps[1].xyz_m[np.searchsorted(steps[1].identity, steps[3].identity[back])]
        away = np.linalg.norm((steps[3].xyz_m[back] - was)[:, :2] - [0.008, 0.004], axis=1)
        assert len(hidden) > 20 and (away < 0.3 * scenes.pixel_m).all()
    assert regained[5].mean() > 0.8 and not regained[0].any()


class Traveller:
    """A guide with the exact motion of a plane: one bone with all points on it."""

    longest_frames = 50

    def __init__(self, bodies: list[Any], in_sight: bool) -> None:
        self.bodies, self.in_sight, self.asked = bodies, in_sight, 0
        self.key = f"a plane in sight: {in_sight}"

    def bind(self, frame: int, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(len(xyz_m), dtype=np.int64), xyz_m - self.bodies[frame].t

    def places(self, frame: int, bone: np.ndarray, own_m: np.ndarray) -> np.ndarray:
        self.asked += len(bone)
        return own_m + self.bodies[frame].t

    def visible(self, frame: int, xyz_m: np.ndarray) -> np.ndarray:
        return np.full(len(xyz_m), self.in_sight)


@pytest.mark.slow
def test_a_guide_carries_lost_points_longer_than_neighbours(tmp_path: Path, scenes: Any) -> None:
    """Occluded for two frames with a wait of one: only a guide brings the points back, to their places, and not where it occludes them."""
    bodies = [scenes.Body(half_m=(0.24, 0.18)).moved(np.eye(3), [0.004 * i, 0.002 * i, 0.0]) for i in range(5)]
    bar = scenes.Body(half_m=(0.01, 0.3), t=np.array([0.0, 0.0, 1.95]), seed=5)
    shown = [[b, bar] if i in (2, 3) else [b] for i, b in enumerate(bodies)]
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), shown, noise=1.0)
    measured = scenes.measure(take, tmp_path / "out", COARSE)
    knobs, regained = {"tracking": {"regenerate_every": 0, "wait_frames": 1}}, {}
    for guide in (None, Traveller(bodies, True), Traveller(bodies, False)):
        steps = scenes.track(take, tmp_path / "out", measured, knobs, guide=guide)
        hidden = np.setdiff1d(steps[1].identity, steps[2].identity)
        regained[guide.in_sight if guide else None] = np.isin(hidden, steps[4].identity).mean()
        back = np.isin(steps[4].identity, hidden)
        was = steps[1].xyz_m[np.searchsorted(steps[1].identity, steps[4].identity[back])]
        away_px = np.linalg.norm((steps[4].xyz_m[back] - was)[:, :2] - [0.012, 0.006], axis=1) / scenes.pixel_m
        assert len(hidden) > 10 and (away_px < 0.6).all() and np.count_nonzero(away_px >= 0.35) <= 0.05 * len(away_px)
        assert guide is None or guide.asked >= len(hidden)
    assert regained[True] > 0.8 and regained[None] == regained[False] == 0


def step(frame: int, identity: list[int], xyz: object, ended: list[int] | None = None) -> Any:
    """The part of a tracked frame that `assemble` reads."""
    n, gone = len(identity), ended or []
    return SimpleNamespace(frame=frame, identity=np.array(identity, dtype=np.int64), xyz_m=np.array(xyz, dtype=float).reshape(n, 3),
                           covariance_m2=np.tile(np.eye(3) * 1e-6, (n, 1, 1)), ended=np.array(gone, dtype=np.int64),
                           reason=np.full(len(gone), TrackStatus.NOT_FOUND, np.int8))  # fmt: skip


def test_assembled_trajectories() -> None:
    steps = [step(5, [0, 1], [[0, 0, 0], [1, 0, 0]]), step(6, [1, 2], [[1.1, 0, 0], [2, 0, 0]], [0]), step(7, [2], [[2, 0.5, 0]], [1])]
    tracks = assemble(steps, 10.0)
    assert tracks.frames.tolist() == [5, 6, 7] and np.allclose(tracks.time_s, [0.5, 0.6, 0.7])
    M, N, A = TrackStatus.MEASURED, TrackStatus.NOT_FOUND, TrackStatus.ABSENT
    assert tracks.status.tolist() == [[M, M, A], [N, M, M], [A, N, M]]
    assert np.allclose(tracks.velocity_m_s[:2, 1, 0], 1.0) and np.isnan(tracks.velocity_m_s[2, 1]).all()
    assert np.allclose(tracks.velocity_m_s[1:, 2, 1], 5.0) and np.isnan(tracks.velocity_m_s[:, 0]).all()
    assert np.isnan(tracks.acceleration_m_s2).all()
    assert np.allclose(tracks.sigma_m[tracks.visible], np.sqrt(3e-6))
    for few in ([], [0]):
        assert assemble([step(0, few, [[0, 0, 0]] * len(few))], 25.0).xyz_m.shape == (1, len(few), 3)


def test_kinematics_are_exact_for_a_parabola() -> None:
    t = np.arange(8) / 25
    path = np.stack([0.1 + 0.5 * t - 2 * t**2, 3 * t**2, 0 * t], axis=1)
    tracks = assemble([step(i, [0], path[i]) for i in range(8)], 25.0)
    assert np.allclose(tracks.velocity_m_s[1:-1, 0], np.stack([0.5 - 4 * t, 6 * t, 0 * t], axis=1)[1:-1])
    assert np.allclose(tracks.acceleration_m_s2[1:-1, 0], [-4, 6, 0])


@pytest.mark.slow
def test_a_black_frame_is_bridged(tmp_path: Path, scenes: Any) -> None:
    """One view is black in frame 2: the points resume in frame 3 under the same identity, in the right places."""
    bodies = moving_plane(scenes, 5)
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in bodies], noise=1.0)
    black = cv2.imencode(".png", np.zeros((150, 200), np.uint8))[1].tobytes()
    (take / "C" / "0002.png").write_bytes(black)
    tracks = assemble(scenes.track(take, tmp_path / "out", scenes.measure(take, tmp_path / "out", COARSE)), 25.0)
    seen = tracks.visible
    assert not seen[2].any() and (seen[1] & seen[3]).sum() > 0.8 * seen[1].sum()
    error, on_it = errors(bodies, tracks, 0.035)
    assert np.nanmax(np.linalg.norm(error[:, on_it, :2], axis=2)) < 1.0 * scenes.pixel_m
