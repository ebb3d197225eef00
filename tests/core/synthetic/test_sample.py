"""The sample of the extension: small, valid with this code, near the truth, and only from its own kind of archive."""

import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.skeleton import joint_positions
from tricap.core.foundation.errors import InputError
from tricap.core.images.picture import decoded
from tricap.core.motion.tables import read_joints
from tricap.core.run.take_run import open_run
from tricap.core.synthetic import sample
from tricap.core.synthetic.arm import is_arm_take
from tricap.core.synthetic.person import JOINTS, person
from tricap.core.synthetic.sample import RECORDING, RESULTS, make_recording, unpack

ARCHIVE = Path(__file__).resolve().parents[3] / "addon" / "sample.zip"


def test_its_results_are_those_of_this_code(tmp_path: Path) -> None:
    """Otherwise: python3 dev.py sample"""
    unpack(ARCHIVE, tmp_path / "é 1")
    with open_run(tmp_path / "é 1", tmp_path / "é 1" / RESULTS) as run:
        assert set(run.record["stages"]) == {"measure", "track", "fit"} and not run.record["warnings"]
        assert run.record["take"] == str(tmp_path / "é 1")
    assert ARCHIVE.stat().st_size < 3e6 and is_arm_take(tmp_path / "é 1")


def test_its_joints_are_near_the_truth(tmp_path: Path) -> None:
    unpack(ARCHIVE, tmp_path)
    joints, subject = read_joints(tmp_path / RESULTS / "joints.csv"), person(RECORDING.swing_s)
    true = joint_positions(subject.shape.skeleton, subject.shape.lengths_m, subject.motion(joints.time_s))
    error = np.array([np.linalg.norm(joints.joints_m[name] - true[name], axis=1) for name in JOINTS])
    assert len(joints.time_s) == RECORDING.frames and error.mean() < 0.03 and error.max() < 0.08


def test_its_recording_is_the_one_that_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample, "RECORDING", replace(RECORDING, frames=2))
    make_recording(tmp_path / "made")
    unpack(ARCHIVE, tmp_path / "there")
    assert (tmp_path / "made" / "take.toml").read_bytes() == (tmp_path / "there" / "take.toml").read_bytes()
    made_rig, rig = (tomllib.loads((tmp_path / place / "rig.toml").read_text(encoding="utf-8")) for place in ("made", "there"))
    assert made_rig.keys() == rig.keys() and made_rig.pop("metadata") == rig.pop("metadata")
    for name, camera in rig.items():
        assert made_rig[name].pop("name") == camera.pop("name") and made_rig[name].keys() == camera.keys()
        for key, numbers in camera.items():
            assert np.abs(np.subtract(made_rig[name][key], numbers)).max() < 1e-12, "other machines round otherwise"
    made, there = (decoded(tmp_path / place / "C" / "0001.jpg").astype(float) for place in ("made", "there"))
    assert np.abs(made - there).mean() < 0.5, "other machines round otherwise"


def test_only_its_own_files_are_unpacked(tmp_path: Path) -> None:
    archive = tmp_path / "sample.zip"
    with zipfile.ZipFile(archive, "w") as packed, zipfile.ZipFile(ARCHIVE) as given:
        for name in ("../evil.txt", "/evil.txt", "L/../../evil.txt", "results/skin/run.py"):
            packed.writestr(name, "x")
        for entry in given.infolist():
            packed.writestr(entry, given.read(entry))
    unpack(archive, tmp_path / "in" / "take")
    assert (tmp_path / "in" / "take" / "take.toml").is_file()
    assert not list(tmp_path.rglob("evil.txt")) and not list(tmp_path.rglob("run.py"))


@pytest.mark.parametrize("content", [b"", b"no archive", ARCHIVE.read_bytes()[:9000]])
def test_a_damaged_archive_is_told(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "sample.zip").write_bytes(content)
    with pytest.raises(InputError, match="is damaged .*; install the extension again"):
        unpack(tmp_path / "sample.zip", tmp_path / "take")
    assert not (tmp_path / "take").exists()


def test_a_folder_of_the_users_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(InputError, match="holds no sample recording"):
        unpack(ARCHIVE, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]
