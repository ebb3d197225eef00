"""A body as the guide of lost points: it carries them with their bones, and knows what hides them; a run that tracks again."""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.body.skin.contour_skin import body_skin
from tricap.core.fitting.inputs.track_guide import BodyGuide
from tricap.core.run import pipeline
from tricap.core.run.stages import valid_stages
from tricap.core.synthetic.arm import ArmTakeSettings, arm_motion, arm_rig, arm_shape, make_arm_take


@pytest.fixture(scope="module")
def guide() -> BodyGuide:
    """The synthetic arm at 0 s and 0.4 s, frames 3 and 4, seen by camera C."""
    motion = SimpleNamespace(frames=np.array([3, 4]), values=arm_motion(np.array([0.0, 0.4])))
    footage: Any = SimpleNamespace(rig=arm_rig(384), take=SimpleNamespace(reference=1, fps=25.0))
    return BodyGuide(SimpleNamespace(shape=arm_shape(), motion=motion), footage)  # type: ignore[arg-type]


def test_points_go_with_their_bones(guide: BodyGuide) -> None:
    before, after = (body_skin(arm_shape(), arm_motion(time)) for time in (0.0, 0.4))
    rigid = before.weights.max(axis=1) > 0.999
    bone, own = guide.bind(3, before.vertices_m[rigid])
    assert np.array_equal(bone, before.weights[rigid].argmax(axis=1)) and set(bone) == {0, 1}
    assert np.allclose(guide.places(3, bone, own), before.vertices_m[rigid], atol=1e-12)
    assert np.linalg.norm(after.vertices_m - before.vertices_m, axis=1).max() > 0.1
    miss = np.linalg.norm(guide.places(4, bone, own) - after.vertices_m[rigid], axis=1)
    assert np.median(miss) < 2e-3 and miss.max() < 0.03  # the skin slides over the bones near the elbow
    far, _ = guide.bind(3, before.vertices_m[:1] + [0.0, 0.0, 0.3])
    assert far.tolist() == [-1] and guide.longest_frames == 50


def test_the_body_hides_its_back(guide: BodyGuide) -> None:
    skin, camera = body_skin(arm_shape(), arm_motion(0.0)), arm_rig(384).cameras[1]
    towards = camera.centre_m - skin.vertices_m
    facing = np.einsum("ni,ni->n", skin.normals, towards) / np.linalg.norm(towards, axis=1)
    inside = camera.sees(camera.project(skin.vertices_m))
    seen = guide.visible(3, skin.vertices_m)
    assert seen[(facing > 0.3) & inside].mean() > 0.99 and seen[(facing < -0.7) & inside].mean() < 0.05
    assert not guide.visible(3, np.array([[50.0, 0.0, 0.0]])).any()


def test_a_frame_without_a_body_says_nothing(guide: BodyGuide) -> None:
    point = np.zeros((1, 3))
    bone, own = guide.bind(9, point)
    assert bone.tolist() == [-1] and np.isnan(guide.places(9, np.array([0]), own)).all() and not guide.visible(9, point).any()


def test_tracks_that_a_body_guided_go_with_it() -> None:
    keys = {"measure": "m", "track": "t", "fit": "new"}
    stages = {"measure": {"key": "m"}, "track": {"key": "t"}, "fit": {"key": "old"}}
    assert set(valid_stages({"stages": stages}, keys)) == {"measure", "track"}
    stages["fit"]["tracked_again"] = {}  # type: ignore[assignment]
    assert set(valid_stages({"stages": stages}, keys)) == {"measure"}
    assert set(valid_stages({"stages": stages}, keys | {"fit": "old"})) == {"measure", "track", "fit"}


@pytest.mark.slow
def test_a_run_that_tracks_again_resumes_with_the_same_bytes(tmp_path: Path) -> None:
    make_arm_take(tmp_path / "take", ArmTakeSettings(frames=6, width_px=320, interlaced="none"))
    settings = {"growing": {"spacing_px": 6}, "fitting": {"track_again": True}}
    first = pipeline.run(tmp_path / "take", tmp_path / "out", settings)
    again = first.record["stages"]["fit"]["tracked_again"]
    assert again["trajectories"] == first.trajectories.xyz_m.shape[1] > 0  # type: ignore[union-attr]
    kept = (tmp_path / "out" / "trajectories.npz").read_bytes()
    (tmp_path / "out" / "cache" / "guided" / "0004.npz").unlink()
    shutil.rmtree(tmp_path / "out" / "cache" / "tracks")
    pipeline.run(tmp_path / "take", tmp_path / "out", settings)
    assert (tmp_path / "out" / "trajectories.npz").read_bytes() == kept
