"""joints.csv and motion.csv: round trips, units, and what they refuse."""

import errno
from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.motion import BodyMotion
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import joint_positions
from tricap.core.foundation import bounded
from tricap.core.foundation.errors import InputError
from tricap.core.motion.tables import read_guessed, read_joints, read_motion, write_joints, write_motion


def _motion() -> BodyMotion:
    shape = default_shape(read_model("arm.R"))
    rng = np.random.default_rng(0)
    values = rng.normal(0, 0.5, (4, 8))
    joints = joint_positions(shape.skeleton, shape.lengths_m, values)
    return BodyMotion(
        frames=np.array([3, 4, 6, 7]),
        time_s=np.array([3, 4, 6, 7]) / 25,
        dof_names=shape.skeleton.dof_names,
        values=values,
        covariance=np.repeat(np.diag(np.arange(1, 9) * 1e-4)[None], 4, axis=0),
        joint_names=tuple(joints),
        joints_m=np.stack(list(joints.values()), axis=1),
        joint_sigma_m=np.full((4, 3), 0.002),
        joint_frame_sigma_m=np.full((4, 3), 0.001),
        known=(("seen", "inferred", "guessed"),) * 3 + (("seen",) * 3,),
        status=("fitted", "partial", "bridged", "suspect"),
        sigma0=np.ones(4),
    )


def test_a_table_that_may_not_be_read_is_not_to_be_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(path: Path, largest: int) -> str:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(bounded, "text_of", forbidden)
    with pytest.raises(InputError, match="Permission denied; change its rights"):
        read_joints(tmp_path / "joints.csv")


def test_motion_comes_back_within_the_digits_written(tmp_path: Path) -> None:
    skeleton, motion = read_model("arm.R").skeleton, _motion()
    write_motion(tmp_path / "motion.csv", motion, skeleton)
    table = read_motion(tmp_path / "motion.csv", skeleton)
    assert np.array_equal(table.frames, motion.frames)
    assert np.allclose(table.values, motion.values, atol=1e-6)
    assert np.allclose(table.sigma, motion.sigma, atol=1e-6)


def test_angles_are_degrees_and_the_base_is_metres(tmp_path: Path) -> None:
    skeleton, motion = read_model("arm.R").skeleton, _motion()
    write_motion(tmp_path / "motion.csv", motion, skeleton)
    header, row = (line.split(",") for line in (tmp_path / "motion.csv").read_text().splitlines()[:2])
    assert header[:3] == ["frame", "time_s", "shoulder.R x"]
    assert float(row[header.index("shoulder.R x")]) == pytest.approx(motion.values[0, 0], abs=1e-6)
    assert float(row[header.index("elbow.R flexion")]) == pytest.approx(np.degrees(motion.values[0, 6]), abs=1e-5)


def test_joints_come_back_by_name_and_frame(tmp_path: Path) -> None:
    motion = _motion()
    write_joints(tmp_path / "joints.csv", motion)
    table = read_joints(tmp_path / "joints.csv")
    assert table.frames.tolist() == [3, 4, 6, 7]
    assert np.allclose(table.joints_m["wrist.R"], motion.joints_m[:, 2], atol=1e-6)
    assert np.allclose(table.sigma_m["elbow.R"], 0.002)
    assert np.allclose(table.frame_sigma_m["elbow.R"], 0.001)
    assert table.known["wrist.R"] == ("guessed", "guessed", "guessed", "seen")


def test_the_frames_in_which_a_limb_is_guessed(tmp_path: Path) -> None:
    write_joints(tmp_path / "joints.csv", _motion())
    assert read_guessed(tmp_path / "joints.csv") == {"right arm": (3, 4, 6)}
    text = (tmp_path / "joints.csv").read_text()
    (tmp_path / "joints.csv").write_text("\n".join(line.rsplit(",", 2)[0] for line in text.splitlines()))
    assert read_guessed(tmp_path / "joints.csv") == {}, "of an earlier version"
    (tmp_path / "joints.csv").write_text(text.replace("guessed", "Guessed"))
    with pytest.raises(InputError, match="has “Guessed” for “known”"):
        read_guessed(tmp_path / "joints.csv")


def test_joints_of_an_earlier_version_lack_the_later_columns(tmp_path: Path) -> None:
    path = tmp_path / "joints.csv"
    write_joints(path, _motion())
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line.rsplit(",", 2)[0] for line in lines) + "\n")
    table = read_joints(path)
    assert np.isnan(table.frame_sigma_m["elbow.R"]).all() and set(table.known["wrist.R"]) == {""}
    path.write_text("\n".join([lines[0], lines[1].replace("seen", "maybe")]) + "\n")
    with pytest.raises(InputError, match="“maybe” for “known”"):
        read_joints(path)


@pytest.mark.parametrize(
    ("text", "word"), [("", "empty"), ("frame,time_s\n0,0\n", "no column"), ("frame,time_s,shoulder.R x\n0,0\n", "values")]
)
def test_faulty_tables_are_refused_in_a_sentence(tmp_path: Path, text: str, word: str) -> None:
    (tmp_path / "motion.csv").write_text(text)
    with pytest.raises(InputError, match=word):
        read_motion(tmp_path / "motion.csv", read_model("arm.R").skeleton)


def test_a_word_for_a_number_is_refused(tmp_path: Path) -> None:
    skeleton = read_model("arm.R").skeleton
    write_motion(tmp_path / "motion.csv", _motion(), skeleton)
    text = (tmp_path / "motion.csv").read_text().replace("\n3,", "\nthree,")
    (tmp_path / "motion.csv").write_text(text)
    with pytest.raises(InputError, match="three"):
        read_motion(tmp_path / "motion.csv", skeleton)
    with pytest.raises(InputError, match="missing.csv"):
        read_motion(tmp_path / "missing.csv", skeleton)


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_one_cell_without_a_number_is_refused_and_a_row_of_them_is_not(tmp_path: Path, value: str) -> None:
    """A frame that nothing shows has none at all; to fill the other cells, too, would change what was measured."""
    skeleton, path = read_model("arm.R").skeleton, tmp_path / "motion.csv"
    write_motion(path, _motion(), skeleton)
    lines = path.read_text().splitlines()
    cells = lines[2].split(",")
    path.write_text("\n".join([*lines[:2], ",".join([*cells[:3], value, *cells[4:]]), *lines[3:]]))
    with pytest.raises(InputError, match=rf"^Row 3 of .* has no number in the column “{skeleton.dof_names[1]}”"):
        read_motion(path, skeleton)
    d = len(skeleton.dof_names)
    path.write_text("\n".join([*lines[:2], ",".join([*cells[:2], *d * [value], *cells[2 + d :]]), *lines[3:]]))
    assert not np.isfinite(read_motion(path, skeleton).values[1]).any()


def test_a_negative_sigma_is_refused(tmp_path: Path) -> None:
    skeleton, motion = read_model("arm.R").skeleton, _motion()
    write_motion(tmp_path / "motion.csv", motion, skeleton)
    write_joints(tmp_path / "joints.csv", motion)
    for name, read in (("motion.csv", lambda path: read_motion(path, skeleton)), ("joints.csv", read_joints)):
        path = tmp_path / name
        read(path)
        *lines, last = path.read_text().splitlines()
        words = last.split(",")
        words[-1 if name == "motion.csv" else -2] = "-0.5"
        path.write_text("\n".join([*lines, ",".join(words)]) + "\n")
        with pytest.raises(InputError, match="negative sigma .-0.5"):
            read(path)
