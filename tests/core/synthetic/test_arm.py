"""The synthetic recording: a valid take whose pictures agree with its truth."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.geometry.rig import read_rig
from tricap.core.synthetic.arm import ArmTakeSettings, arm_motion, arm_shape, make_arm_take
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

SMALL = ArmTakeSettings(frames=2, width_px=384, interlaced="none")
TINY = ArmTakeSettings(frames=2, width_px=96)


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic") / "arm"
    make_arm_take(folder, SMALL)
    return folder


def picture(folder: Path, view: str, frame: int) -> np.ndarray:
    image = cv2.imread(str(folder / view / f"{frame:04d}.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.dtype == np.uint8
    return image


def visible(truth: "np.lib.npyio.NpzFile") -> np.ndarray:
    return np.unpackbits(truth["visible"], axis=1)[:, : truth["vertices_m"].shape[1]].astype(bool)


def test_it_is_a_take(take: Path) -> None:
    footage = open_take(read_take(take))
    assert list(footage.frames) == [0, 1] and [c.name for c in footage.rig.cameras] == ["L", "C", "R"]
    assert footage.take.body_model == "arm.R" and [im.shape for im in footage.read(1)] == [(288, 384)] * 3


def test_truth_has_the_promised_layout(take: Path) -> None:
    truth = np.load(take / "truth.npz", allow_pickle=False)
    t, v, _ = truth["vertices_m"].shape
    assert truth["vertices_m"].dtype == np.float32 and truth["triangles"].dtype == np.int32 and truth["triangles"].max() == v - 1
    assert truth["textured"].shape == (v,) and truth["textured"].dtype == bool and truth["visible"].shape == (t, -(-v // 8))
    assert truth["joint_names"].tolist() == ["RightArm", "RightForeArm", "RightHand"] and truth["joints_m"].shape == (t, 3, 3)
    assert np.allclose(truth["time_s"], [0, 0.04]) and truth["dof_names"].tolist() == list(arm_shape().skeleton.dof_names)
    assert np.allclose(truth["motion_values"], arm_motion(truth["time_s"]))
    lengths = np.linalg.norm(np.diff(truth["joints_m"], axis=1), axis=2)
    assert np.allclose(lengths, truth["lengths_m"]) and truth["radii_m"].shape == (6, 3)
    assert 0.15 < visible(truth).mean() < 0.5


def test_clicks_are_near_the_joints_and_not_on_them(take: Path) -> None:
    truth, clicks = np.load(take / "truth.npz"), read_take(take).clicks.joints
    rig = read_rig(take / "rig.toml")
    error = np.array(
        [
            clicks[name][c.name] - c.project(truth["joints_m"][0, i])
            for i, name in enumerate(("shoulder.R", "elbow.R", "wrist.R"))
            for c in rig.cameras
        ]
    )
    assert np.abs(error).max() <= 4.06 and np.abs(error).max() > 1.5


def test_a_point_of_the_cloth_looks_alike_in_all_views_and_at_all_times(take: Path) -> None:
    truth, rig = np.load(take / "truth.npz"), read_rig(take / "rig.toml")
    seen = visible(truth)
    points = np.flatnonzero(seen[0] & seen[1] & truth["textured"])
    points = points[np.random.default_rng(0).permutation(len(points))[:2000]]
    grey = []
    for frame in (0, 1):
        for camera in rig.cameras:
            xy = camera.project(truth["vertices_m"][frame, points].astype(float)).astype(np.float32)
            grey.append(cv2.remap(picture(take, camera.name, frame).astype(np.float32), xy[:, :1], xy[:, 1:], cv2.INTER_CUBIC)[:, 0])
    assert np.corrcoef(grey).min() > 0.9  # perspective, pixel size and noise take a little; a shift of 1 px takes much more:
    shifted = cv2.remap(picture(take, "C", 0).astype(np.float32), xy[:, :1] + 2, xy[:, 1:] + 2, cv2.INTER_CUBIC)[:, 0]
    assert np.corrcoef(grey[1], shifted)[0, 1] < 0.8
    slope = np.polyfit(grey[1], grey[0], 1)[0]
    assert 0.95 < slope < 1.15  # L has a gain of 1.06


@pytest.mark.slow
def test_second_field_is_half_a_frame_later(tmp_path: Path) -> None:
    slow, fast = tmp_path / "slow", tmp_path / "fast"
    make_arm_take(slow, ArmTakeSettings(frames=2, width_px=192, interlaced="even", noise=0.0))
    make_arm_take(fast, ArmTakeSettings(frames=3, fps=50.0, width_px=192, interlaced="none", noise=0.0))
    for view in "LCR":
        woven, first, second = picture(slow, view, 1), picture(fast, view, 2), picture(fast, view, 1)
        assert np.array_equal(woven[1::2], first[1::2])  # kept: rows 1, 3, … at the frame's time
        assert np.array_equal(picture(slow, view, 0)[0::2], second[0::2]) and not np.array_equal(woven[0::2], first[0::2])


@pytest.mark.slow
def test_the_same_settings_give_the_same_recording_and_replace_it(tmp_path: Path) -> None:
    folder, small = tmp_path / "x", ArmTakeSettings(frames=2, width_px=96)
    make_arm_take(folder, ArmTakeSettings(frames=3, width_px=96, seed=5))
    other = picture(folder, "C", 1)
    make_arm_take(folder, small)
    first = {p: p.read_bytes() for p in sorted(folder.rglob("*.png")) + [folder / "take.toml", folder / "rig.toml"]}
    assert len(first) == 8 and not np.array_equal(other, picture(folder, "C", 1))
    make_arm_take(folder, small)
    assert all(path.read_bytes() == data for path, data in first.items())


def test_other_people_s_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "L").mkdir()
    (tmp_path / "L" / "0000.png").write_bytes(b"precious")
    with pytest.raises(InputError, match="not empty"):
        make_arm_take(tmp_path, ArmTakeSettings(frames=2, width_px=96))
    assert (tmp_path / "L" / "0000.png").read_bytes() == b"precious"


@pytest.mark.slow
def test_changes_of_the_user_outlive_a_new_recording(tmp_path: Path) -> None:
    make_arm_take(tmp_path, TINY)
    make_arm_take(tmp_path, TINY)
    assert not (tmp_path / "take.toml.bak").exists(), "nothing was changed"
    changed = (tmp_path / "take.toml").read_text().replace("frame = 0", "frame = 1")
    (tmp_path / "take.toml").write_text(changed)
    (tmp_path / "L" / "notes.txt").write_text("mine")
    (tmp_path / "C" / "0009.png").write_bytes(b"mine")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="0009.png is not of the recording in .* move it elsewhere"):
        make_arm_take(tmp_path, TINY)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    (tmp_path / "C" / "0009.png").unlink()
    make_arm_take(tmp_path, TINY)
    assert (tmp_path / "L" / "notes.txt").read_text() == "mine" and (tmp_path / "take.toml.bak").read_text() == changed


def test_cancelled_recording_is_no_take_and_can_be_made_again(tmp_path: Path) -> None:
    def stop(stage: str, done: float, total: float) -> None:
        if done == 1:
            monitor.cancel()

    monitor, small = Monitor(stop), ArmTakeSettings(frames=3, width_px=96)
    with pytest.raises(Cancelled):
        make_arm_take(tmp_path / "x", small, monitor)
    assert not (tmp_path / "x" / "take.toml").exists() and not (tmp_path / "x" / "truth.npz").exists()
    make_arm_take(tmp_path / "x", small)
    assert read_take(tmp_path / "x").fps == 25.0


def test_motion_is_what_the_description_promises() -> None:
    time_s = np.arange(0, 16) / 25
    flexion = arm_motion(time_s)[:, arm_shape().skeleton.layout["elbow.R flexion"]]
    assert np.degrees(np.ptp(flexion)) > 50
    limits = np.array([dof.limits for dof in arm_shape().skeleton.dofs])
    assert (arm_motion(time_s) > limits[:, 0]).all() and (arm_motion(time_s) < limits[:, 1]).all()


@pytest.mark.slow
def test_full_size_recording_in_a_minute(tmp_path: Path) -> None:
    start = time.process_time()  # of both cores of an idle machine
    make_arm_take(tmp_path / "full")
    assert time.process_time() - start < 120 and picture(tmp_path / "full", "R", 15).shape == (576, 768)
