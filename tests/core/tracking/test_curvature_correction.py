"""The bias of patches on a round body that turns: the formula against an exact fit, and points on a limb that turns."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.geometry.rotation import rotation_from_vector
from tricap.core.tracking import track
from tricap.core.tracking.curvature_correction import turning_bias
from tricap.core.tracking.trajectories import assemble

TURN = np.radians(13.0)  # per frame


def test_what_an_affine_fit_to_a_turning_quadric_leaves() -> None:
    """Patches of 13×13 on quadrics that turn and come nearer: the middle of the best affine map is off by exactly b."""
    rng = np.random.default_rng(8)
    u, v = (a.ravel().astype(float) for a in np.meshgrid(np.arange(-6, 7), np.arange(-6, 7)))
    for turn in rng.uniform(-0.5, 0.5, (20, 3)):
        g, Q, scale = rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.06, 0.06, 3), rng.uniform(0.9, 1.1)
        R = rotation_from_vector(turn)
        points = np.column_stack([u, v, g[0] * u + g[1] * v + 0.5 * Q[0] * u * u + Q[1] * u * v + 0.5 * Q[2] * v * v])
        fit = np.linalg.lstsq(np.column_stack([np.ones_like(u), u, v]), scale * points @ R[:2].T, rcond=None)[0]
        n = R @ [-g[0], -g[1], 1.0]
        b = turning_bias(fit[1:].T[None], np.array([[*g, 7 * (Q[0] + Q[2])]]), (-n[:2] / n[2])[None])[
            0
        ]  # ½ of 14 px², the pixels' variance
        np.testing.assert_allclose(b, fit[0], atol=1e-9)
    assert not turning_bias(fit[1:].T[None], np.array([[*g, 0.0]]), g[None]).any()  # a plane


def turned_points(body: list[Any], tracks: Any) -> np.ndarray:
    """By how much [m] each trajectory (T, N) has slid around the limb since its first position."""
    own = np.stack([(tracks.xyz_m[t] - b.t) @ b.R for t, b in enumerate(body)])
    angle = np.arctan2(own[..., 0], -own[..., 2])
    return body[0].radius_m * (angle - angle[tracks.visible.argmax(axis=0), np.arange(tracks.visible.shape[1])])


@pytest.mark.parametrize("interlaced", ["none", pytest.param("odd", marks=pytest.mark.slow)])
def test_points_stay_on_a_limb_that_turns(tmp_path: Path, scenes: Any, monkeypatch: pytest.MonkeyPatch, interlaced: str) -> None:
    """A limb of 14 px radius turns by 39° about itself: its points slide by less than half of what they would uncorrected."""
    leaning = rotation_from_vector(np.array([0.0, 0.0, 0.3]))
    turns = [rotation_from_vector(np.array([0.0, i * TURN, 0.0])) for i in range(4)]
    body = [scenes.Body(radius_m=0.05, half_m=(9.0, 0.14), shortest_m=0.011, R=leaning @ turn) for turn in turns]
    take = scenes.write_take(tmp_path / "take", scenes.three_cameras(), [[b] for b in body], noise=1.0, interlaced=interlaced)
    measured = scenes.measure(take, tmp_path / "out")
    slid = {}
    for corrected in (True, False):
        if not corrected:
            monkeypatch.setattr(track, "_curvature", lambda *_: None)
        tracks = assemble(scenes.track(take, tmp_path / f"{corrected}", measured, {"tracking": {"regenerate_every": 0}}), 25.0)
        last = turned_points(body, tracks)[-1]
        slid[corrected] = last[np.isfinite(last)] / scenes.pixel_m
    assert len(slid[True]) > 12
    assert abs(np.median(slid[True])) < 0.5 * abs(np.median(slid[False]))
