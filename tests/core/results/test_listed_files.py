"""Files in a folder of the user's choice: those of an earlier call are replaced and removed, others never."""

import shutil
from pathlib import Path

import pytest

from tricap.core.calibration.calibrate import check_report
from tricap.core.calibration.rig_files import write_as
from tricap.core.cli import main
from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rig import read_rig
from tricap.core.results.listed_files import LIST, PICTURES, PLY, check_files, list_files
from tricap.core.run.batch import out_folders

Capture = pytest.CaptureFixture[str]


def test_own_files_are_replaced_and_others_refused(tmp_path: Path) -> None:
    folder = tmp_path / "skins"
    check_files(folder, PLY)
    for names in (("0000.ply", "0009.ply"), ("0000.ply",)):
        list_files(folder, PLY, names)
        for name in names:
            (folder / name).write_text("ours")
    (folder / "notes.txt").write_text("mine")
    assert sorted(path.name for path in folder.iterdir()) == [LIST, "0000.ply", "notes.txt"], "a file of a longer recording is removed"
    (folder / "0001.PLY").write_text("mine")
    with pytest.raises(InputError, match="contains “0001.PLY”, which was not written there by Tricap; choose an empty or a new folder"):
        check_files(folder, PLY)
    check_files(folder, PICTURES)


@pytest.mark.parametrize("text", ["", "{", '{"a": 1}', '["../letter.ply", "sub", "letter.txt", 3, "/a.ply"]'])
def test_a_list_that_nobody_wrote_removes_nothing(tmp_path: Path, text: str) -> None:
    (tmp_path / "letter.ply").write_text("mine")
    folder = tmp_path / "skins"
    (folder / "sub").mkdir(parents=True)
    (folder / "letter.txt").write_text("mine")
    (folder / LIST).write_text(text)
    list_files(folder, PLY, ["0000.ply"])
    assert (tmp_path / "letter.ply").exists() and sorted(path.name for path in folder.iterdir()) == [LIST, "letter.txt", "sub"]


def refused(argv: list[str], capfd: Capture) -> str:
    assert main.main(argv) == 2
    return capfd.readouterr().err


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_pictures_replace_no_images_of_another_camera(plane_take: Path, tmp_path: Path, capfd: Capture) -> None:
    for view in "LR":
        shutil.copytree(plane_take / view, tmp_path / view)
    shutil.copytree(plane_take / "R", tmp_path / "space" / "R")
    (tmp_path / "points.csv").write_text("point,x,y\na,60,60\n")
    (tmp_path / "both.csv").write_text("point,view,x,y\na,L,60,60\na,C,60,60\n")
    before = contents(tmp_path)
    planar = ["track2d", str(tmp_path / "L"), "--points", str(tmp_path / "points.csv"), "--out", str(tmp_path / "a.csv"), "--pictures"]
    in_space = ["track", str(plane_take), "--points", str(tmp_path / "both.csv"), "--out", str(tmp_path / "out"), "--pictures"]
    for argv in ([*planar, str(tmp_path / "R")], [*in_space, str(tmp_path / "space")]):
        assert "R contains “0000.png”, which was not written there" in refused(argv, capfd)
    assert contents(tmp_path) == before
    for frames in ("0:2", "0:1"):
        assert main.main([*planar, str(tmp_path / "pictures"), "--frames", frames, "--quiet"]) == 0
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == [LIST, "0000.png"]


def test_a_calibration_of_several_files_replaces_no_other(plane_take: Path, tmp_path: Path) -> None:
    rig = read_rig(plane_take / "rig.toml")
    for _ in range(2):
        write_as(tmp_path / "colmap", rig, "colmap")
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "images.txt").write_text("mine")
    with pytest.raises(InputError, match="contains “images.txt”"):
        write_as(tmp_path / "theirs", rig, "colmap")
    assert [path.name for path in (tmp_path / "theirs").iterdir()] == ["images.txt"]


def test_no_report_and_no_batch_among_images(plane_take: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contains “0000.png”"):
        check_report(plane_take / "L")
    (tmp_path / "coverage.png").write_bytes(b"")
    store.write_json(tmp_path / "calibration.json", {"format": "tricap-calibration", "version": 1})
    check_report(tmp_path)
    for name, text in (("calibration.json", '{"published": 1}'), ("calibration.txt", "notes of the calibration")):
        folder = tmp_path / name.replace(".", " ")
        folder.mkdir()
        (folder / name).write_text(text)
        with pytest.raises(InputError, match=f"{name} would be overwritten, and is not of an earlier call"):
            check_report(folder)
    with pytest.raises(InputError, match="belongs to the take"):
        out_folders([plane_take], plane_take / "C")


def test_a_summary_of_somebody_else_is_not_replaced(plane_take: Path, tmp_path: Path, capfd: Capture) -> None:
    """Names that nobody gave: batch.json, compare.json and compare.html."""
    for command, name in (("batch", "batch.json"), ("compare", "compare.json"), ("compare", "compare.html")):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_text('{"mine": 1}')
        assert f"{name} would be overwritten" in refused([command, str(plane_take), "--out", str(folder)], capfd)
        assert (folder / name).read_text() == '{"mine": 1}' and len([*folder.iterdir()]) == 1


@pytest.mark.parametrize("name", ["C/0001.png", "rig.toml", "hero.blend", "x.fbx", "notes.csv"])
def test_2d_tracks_replace_tables_of_their_kind_alone(plane_take: Path, tmp_path: Path, capfd: Capture, name: str) -> None:
    shutil.copytree(plane_take / "L", tmp_path / "L")
    (tmp_path / "points.csv").write_text("point,x,y\na,60,60\n")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    argv = ["track2d", str(tmp_path / "L"), "--points", str(tmp_path / "points.csv"), "--frames", "0:2", "--out"]
    said = refused([*argv, str(tmp_path / name)], capfd)
    assert (
        "is not the name of a table; let it end in .csv" in said or "notes.csv would be overwritten, and is not of an earlier call" in said
    )
    assert (tmp_path / name).read_text() == "mine"
    for _ in range(2):
        assert main.main([*argv, str(tmp_path / "tracks.csv"), "--quiet"]) == 0
