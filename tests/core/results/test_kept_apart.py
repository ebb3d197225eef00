"""What is read is never written over: results go into no take and no footage, and no command writes the file that it reads."""

import os
import shutil
from pathlib import Path

import pytest

from tricap.core.calibration.rig_files import write_as
from tricap.core.cli import main
from tricap.core.geometry.rig import read_rig
from tricap.core.results.folder import check_separate_folder

Capture = pytest.CaptureFixture[str]
LINKS = pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
MEASURE = ("measure", "--frames", "0:1", "--quiet", "--set", "growing.spacing_px=10")
WRITERS = {
    "run": ["run", "{t}", "--out", "{o}"], "again": ["run", "{t}", "--out", "{o}", "--restart"],
    "measure": ["measure", "{t}", "--out", "{o}"], "contour": ["contour", "{t}", "--view", "C", "--out", "{o}"],
    "demo": ["demo", "--out", "{o}"],
    "points": ["track", "{t}", "--points", "{p}", "--out", "{o}"], "batch": ["batch", "{t}", "--out", "{o}"],
}  # fmt: skip


@pytest.fixture
def take(plane_take: Path, tmp_path: Path) -> Path:
    """A copy of the take of a plane, with what a run would replace under the same names."""
    folder = Path(shutil.copytree(plane_take, tmp_path / "kick é"))
    (folder / "report").mkdir()
    (folder / "report" / "thesis.txt").write_text("mine")
    return folder


def names(folder: Path) -> dict[str, float]:
    return {str(p.relative_to(folder)): p.lstat().st_mtime for p in folder.rglob("*")}


def refused(argv: list[str], capfd: Capture) -> str:
    assert main.main(argv) == 2
    said = capfd.readouterr()
    assert said.err.count("\n") == 1 and said.out == ""
    return said.err


@pytest.mark.parametrize("command", WRITERS)
def test_results_go_into_no_take(take: Path, tmp_path: Path, capfd: Capture, command: str) -> None:
    (tmp_path / "points.csv").write_text("point,view,x,y\na,L,60,60\na,C,60,60\n")
    argv = [a.format(t=take, o=take, p=tmp_path / "points.csv") for a in WRITERS[command]]
    before = names(tmp_path)
    assert "is itself a take; choose a separate folder for the results, such as " in refused(argv, capfd) and names(tmp_path) == before


@LINKS
def test_results_go_into_no_footage_whatever_way_leads_there(take: Path, tmp_path: Path, capfd: Capture) -> None:
    (take / "R").rename(tmp_path / "films of R")
    (take / "R").symlink_to(tmp_path / "films of R")
    for link, to in (("to take", take), ("to L", take / "L")):
        (tmp_path / link).symlink_to(to)
    before = names(tmp_path)
    for out, said in ((take / "L", "contains the footage 0000.png"), (take / "R", "the footage"), (tmp_path / "films of R", "the footage"),
                      (tmp_path / "to take", "is itself a take"), (tmp_path / "to L", "contains the footage"),
                      (take / "L" / ".." / "C", "contains the footage")):  # fmt: skip
        assert said in refused(["run", str(take), "--out", str(out)], capfd)
    assert names(tmp_path) == before


def test_a_batch_goes_into_none_of_its_takes(take: Path, tmp_path: Path, capfd: Capture) -> None:
    other = shutil.copytree(take, tmp_path / "throw")
    before = names(tmp_path)
    assert "throw is itself a take" in refused(["batch", str(other), str(take), "--out", str(tmp_path)], capfd)
    assert names(tmp_path) == before


def test_a_take_where_results_are_replaced(take: Path, tmp_path: Path, capfd: Capture) -> None:
    """OUT may hold the take, as that of the demo does, but not where a run clears away."""
    (tmp_path / "out" / "report").mkdir(parents=True)
    (tmp_path / "out" / "run.json").write_text("{}")
    inside = tmp_path / "out" / "report" / "take"
    take.rename(inside)
    assert "where a run replaces files" in refused(["run", str(inside), "--out", str(tmp_path / "out")], capfd)


def test_a_folder_of_results_in_the_take_is_fine(take: Path, tmp_path: Path) -> None:
    """As the extension's project beside a .blend has it."""
    assert main.main([*MEASURE, str(take), "--out", str(take / "results")]) == 0
    assert (take / "results" / "clouds" / "0000.ply").exists()
    check_separate_folder(tmp_path, take)
    check_separate_folder(take.parent / "kick é_tricap", take, [take / "L" / "0000.png"])


def test_a_rig_is_not_written_over_in_another_format(take: Path, capfd: Capture) -> None:
    rig, before = take / "rig.toml", (take / "rig.toml").read_bytes()
    assert "is also an input" in refused(["calibrate", "--import", str(rig), "--export", "opencv", "--out", str(rig)], capfd)
    assert rig.read_bytes() == before
    write_as(take / "other.toml", read_rig(rig), "caliscope")
    assert main.main(["calibrate", "--import", str(take / "other.toml"), "--out", str(take / "new.toml"), "--quiet"]) == 0


def test_2d_tracks_replace_neither_their_points_nor_the_images(take: Path, capfd: Capture) -> None:
    (take / "points.csv").write_text("point,x,y\na,60,60\n")
    before = names(take)
    argv = ["track2d", str(take / "L"), "--points", str(take / "points.csv"), "--out"]
    assert "points.csv is also an input" in refused([*argv, str(take / "points.csv")], capfd)
    assert "L is also an input" in refused([*argv, str(take / "a.csv"), "--pictures", str(take / "C" / ".." / "L")], capfd)
    assert names(take) == before


def test_a_wrong_argument_takes_nothing_away(take: Path, tmp_path: Path, capfd: Capture) -> None:
    """What an earlier run of other frames left is replaced by the new, not by an error."""
    out = tmp_path / "out"
    assert main.main([*MEASURE, str(take), "--out", str(out)]) == 0
    before = names(out)
    (tmp_path / "away.csv").write_text("x,y\n900,900\n990,900\n990,990\n")
    for argv, said in ((["run", "--pictures", "99"], "--pictures 99 is not among the frames"),
                       (["contour", "--view", "C", "--polygon", str(tmp_path / "none.csv")], "none.csv"),
                       (["contour", "--view", "C", "--background", str(tmp_path / "none.png")], "none.png"),
                       (["contour", "--view", "C", "--polygon", str(tmp_path / "away.csv")], "lies outside the image of view C"),
                       (["contour", "--view", "X"], "has no view “X”")):  # fmt: skip
        assert said in refused([argv[0], str(take), *argv[1:], "--out", str(out), "--quiet"], capfd)
        assert names(out) == before
