"""The published step: it tracks a plane, finds accelerating points within its second box only, and does not control drift."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.images.interlace import FieldLayout
from tricap.core.matching.least_squares import Matches, MatchingSettings
from tricap.core.tracking import published_step, step
from tricap.core.tracking.published_step import predict_in_images, search_radius
from tricap.core.tracking.settings import TrackingSettings, TrackStatus
from tricap.core.tracking.step import TrackingView, match_spatially
from tricap.core.tracking.tracked import TrackedFrame, born

PUBLISHED = {"scheme": "published", "spacing_px": 12, "regenerate_every": 0}


def test_a_turning_plane_is_tracked(plane_take: Path, tmp_path: Path, scenes: Any) -> None:
    """Four frames: four points in five last to the end, none is false, the median drifts by hundredths of a pixel per frame."""
    plane = scenes.Body(half_m=(0.26, 0.2), R=rotation_from_vector(np.array([0.1, 0.25, 0.0])))
    bodies = [plane.moved(rotation_from_vector(np.array([0.0, 0.0, 0.026 * i])), [0.007 * i, -0.003 * i, 0.0]) for i in range(4)]
    steps = scenes.track(plane_take, tmp_path / "out", scenes.measure(plane_take, tmp_path / "out"), {"tracking": PUBLISHED})
    first, last = steps[0], steps[-1]
    own = (first.xyz_m - bodies[0].t) @ bodies[0].R
    inner = (np.abs(own[:, :2]) < (0.2, 0.14)).all(axis=1)
    there = np.isin(first.identity, last.identity)
    assert inner.sum() > 30 and there[inner].mean() > 0.8
    truth = own[inner & there] * (1, 1, 0) @ bodies[-1].R.T + bodies[-1].t
    found = last.xyz_m[np.isin(last.identity, first.identity[inner & there])]
    away = np.linalg.norm((found - truth)[:, :2], axis=1) / scenes.pixel_m
    assert np.median(away) < 0.15 and away.max() < 0.6


@pytest.mark.slow
@pytest.mark.parametrize(("acceleration", "found"), [(30.0, True), (5.0, False)])
def test_the_second_box_is_the_last(tmp_path: Path, scenes: Any, acceleration: float, found: bool) -> None:
    """A jump of 22 px: 30 m/s² make boxes of 15 px and twice that, 5 m/s² of 4 and 8 px."""
    bodies = [scenes.Body(half_m=(0.24, 0.18)).moved(np.eye(3), [0.0, 22 * scenes.pixel_m * (i > 1), 0.0]) for i in range(3)]
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in bodies], noise=1.0)
    settings = PUBLISHED | {"prediction_acceleration": acceleration, "bridge_frames": 0}
    steps = scenes.track(take, tmp_path / "out", scenes.measure(take, tmp_path / "out"), {"tracking": settings})
    assert len(steps[1].identity) > 50
    kept = len(steps[2].identity) / len(steps[1].identity)
    assert kept > 0.7 if found else kept < 0.2, kept


def frame(number: int, xyz: list[list[float]], cameras: Any) -> TrackedFrame:
    X = np.array(xyz)
    xy = np.stack([c.project(X) for c in cameras], axis=1)
    return born(number, np.arange(len(X)), xy, np.tile(np.eye(2), (len(X), 3, 1, 1)), X, np.zeros((len(X), 3, 3)))


def test_prediction_and_box(scenes: Any) -> None:
    """Each view predicts on its own, also over missing frames; a new point moves with its neighbours; boxes grow with dt² and nearness."""
    cameras = scenes.three_cameras().cameras
    view = TrackingView(
        cameras=cameras, reference=1, field_layout=FieldLayout(), matching=MatchingSettings(), tracking=TrackingSettings(), limit_px=0.7,
        dt_s=0.04,
    ).at(4)  # fmt: skip
    before = frame(1, [[0.0, 0.0, 2.0], [0.02, 0.0, 2.0]], cameras)
    now = frame(2, [[0.01, 0.0, 2.0], [0.03, 0.0, 2.0], [0.02, 0.01, 2.0]], cameras)
    moved = predict_in_images(view, before, now) - now.xy
    own = 2 * (now.xy[:2] - before.xy)
    assert np.allclose(moved[:2], own) and np.allclose(moved[2], own.mean(axis=0))
    assert np.allclose(predict_in_images(view, None, now), now.xy)
    near = frame(2, [[0.0, 0.0, 1.0]], cameras)
    assert np.allclose(search_radius(view, now)[:, 1], 30 * 0.08**2 * 600 / 2.0 + 2)
    assert search_radius(view.at(3), near)[0, 1] == pytest.approx(30 * 0.04**2 * 600 + 2) and search_radius(view, near).max() == 64


@pytest.mark.parametrize("scheme", ["published", "space"])
def test_points_whose_matches_contradict_each_other_are_given_up(
    plane_take: Path, tmp_path: Path, scenes: Any, monkeypatch: pytest.MonkeyPatch, scheme: str
) -> None:
    """The spatial match of every twentieth point is made to lie 1 px away from the temporal one: these points end, and no others."""
    wrong = list[int]()

    def astray(view: TrackingView, points: TrackedFrame, *rest: Any) -> list[Matches]:
        found, shift = match_spatially(view, points, *rest), 1.0 * (points.identity % 20 == 0)
        wrong.extend(points.identity[points.identity % 20 == 0])
        return [replace(m, xy=m.xy + shift[:, None]) for m in found]

    measured = scenes.measure(plane_take, tmp_path / "out", frames=(0, 2))
    for module in (step, published_step):
        monkeypatch.setattr(module, "match_spatially", astray)
    knobs = {"scheme": scheme, "bridge_frames": 0, "wait_frames": 0, "regenerate_every": 0}
    _, after = scenes.track(plane_take, tmp_path / "out", measured, {"tracking": knobs})
    given_up = dict(zip(after.ended.tolist(), after.reason.tolist()))
    assert len(set(wrong)) >= 3 and all(given_up[point] == TrackStatus.NOT_VERIFIED for point in set(wrong))
    assert len(given_up) < len(set(wrong)) + 0.1 * len(after.identity)
