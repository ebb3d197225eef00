"""What is read is never written over: results go into no take and no footage, and no command writes the file that it reads."""

import json
import os
import shutil
from pathlib import Path

import pytest

from tricap.core.calibration.rig_files import write_as
from tricap.core.cli import main
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rig import read_rig
from tricap.core.results.folder import check_separate_folder
from tricap.core.results.outputs import check_output

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


@pytest.mark.parametrize("command", [*WRITERS, "compare", "new", "board", "rig"])
def test_the_root_of_a_drive_is_no_folder_for_results(take: Path, tmp_path: Path, capfd: Capture, command: str) -> None:
    """Also by a link."""
    (tmp_path / "points.csv").write_text("point,view,x,y\na,L,60,60\na,C,60,60\n")
    root = Path(tmp_path.anchor)
    more = {
        "compare": ["compare", "{t}", "--out", "{o}"], "new": ["new", "{o}", "--views", "L={t}/L", "C={t}/C"],
        "rig": ["calibrate", "--import", "{t}/rig.toml", "--export", "colmap", "--out", "{o}"],
        "board": ["calibrate", "{t}", "--bar-length", "0.6", "--out", "{t}/new.toml", "--report", "{o}"],
    }  # fmt: skip
    places = [root]
    if os.name != "nt":
        (tmp_path / "link").symlink_to(root)
        places.append(tmp_path / "link")
    for out in places:
        argv = [a.format(t=take, o=out, p=tmp_path / "points.csv") for a in (WRITERS | more)[command]]
        assert " is the root of a drive; choose a folder on it, such as " in refused(argv, capfd)


@LINKS
def test_results_go_into_no_footage_whatever_way_leads_there(take: Path, tmp_path: Path, capfd: Capture) -> None:
    (take / "R").rename(tmp_path / "films of R")
    (take / "R").symlink_to(tmp_path / "films of R")
    for link, to in (("to take", take), ("to L", take / "L")):
        (tmp_path / link).symlink_to(to)
    before = names(tmp_path)
    for out, said in ((take / "L", "contains the footage 0000.png"), (take / "R", "the footage"), (tmp_path / "films of R", "the footage"),
                      (take / "L" / "new" / "deep", "the footage"),
                      (tmp_path / "to take", "is itself a take"), (tmp_path / "to L", "contains the footage"),
                      (take / "L" / ".." / "C", "contains the footage")):  # fmt: skip
        assert said in refused(["run", str(take), "--out", str(out)], capfd)
    assert names(tmp_path) == before


def test_results_go_into_no_folder_of_footage_that_is_spread_over_several(take: Path, tmp_path: Path, capfd: Capture) -> None:
    """Only the folder of the first image was looked at."""
    for view in "LCR":
        for n, path in enumerate(sorted((take / view).iterdir())):
            part = take / ("p2" if n else "p1") / view
            part.mkdir(parents=True, exist_ok=True)
            path.rename(part / path.name)
    text = (take / "take.toml").read_text(encoding="utf-8")
    for view in "LCR":
        text = text.replace(f'"{view}/*.png"', f'"p*/{view}/*.png"')
    (take / "take.toml").write_text(text, encoding="utf-8")
    before = names(tmp_path)
    for command in ("run", "measure"):
        assert "contains the footage" in refused([command, str(take), "--out", str(take / "p2" / "C")], capfd)
    assert names(tmp_path) == before


@LINKS
@pytest.mark.parametrize("name", ["fields", "cache", "report"])
def test_footage_where_results_are_replaced(take: Path, tmp_path: Path, capfd: Capture, name: str) -> None:
    (tmp_path / "films" / name).mkdir(parents=True)
    (take / "L").rename(tmp_path / "films" / name / "L")
    (take / "L").symlink_to(tmp_path / "films" / name / "L")
    before = names(tmp_path)
    said = refused(["run", str(take), "--out", str(tmp_path / "films")], capfd)
    assert "is inside" in said and "where a run replaces files; choose another folder" in said and names(tmp_path) == before


def test_a_batch_goes_into_none_of_its_takes(take: Path, tmp_path: Path, capfd: Capture) -> None:
    other = shutil.copytree(take, tmp_path / "throw")
    before = names(tmp_path)
    assert "throw is itself a take" in refused(["batch", str(other), str(take), "--out", str(tmp_path)], capfd)
    assert names(tmp_path) == before


def test_a_take_where_results_are_replaced(take: Path, tmp_path: Path, capfd: Capture) -> None:
    """OUT may hold the take, as that of the demo does, but not where a run clears away."""
    (tmp_path / "out" / "report").mkdir(parents=True)
    (tmp_path / "out" / "run.json").write_text('{"format": "tricap-run"}')
    inside = tmp_path / "out" / "report" / "take"
    take.rename(inside)
    assert "where a run replaces files" in refused(["run", str(inside), "--out", str(tmp_path / "out")], capfd)


def test_a_folder_of_results_in_the_take_is_fine(take: Path, tmp_path: Path) -> None:
    """As the extension's project beside a .blend has it."""
    assert main.main([*MEASURE, str(take), "--out", str(take / "results")]) == 0
    assert (take / "results" / "clouds" / "0000.ply").exists()
    check_separate_folder(tmp_path, take)
    check_separate_folder(take.parent / "kick é_tricap", take, [take / "L" / "0000.png"])
    check_separate_folder(take / "results", take, [take / "L.mp4", take / "0000.png"])


def test_a_rig_is_not_written_over_in_another_format(take: Path, capfd: Capture) -> None:
    rig, before = take / "rig.toml", (take / "rig.toml").read_bytes()
    assert "is also an input" in refused(["calibrate", "--import", str(rig), "--export", "opencv", "--out", str(rig)], capfd)
    assert rig.read_bytes() == before
    write_as(take / "other.toml", read_rig(rig), "caliscope")
    assert main.main(["calibrate", "--import", str(take / "other.toml"), "--out", str(take / "new.toml"), "--quiet"]) == 0


@pytest.mark.parametrize("kind, read", [("colmap", "cameras.txt"), ("easymocap", "intri.yml"), ("openptv", "L.ori")])
def test_no_calibration_is_written_over_that_lies_beside_the_one_that_is_read(take: Path, capfd: Capture, kind: str, read: str) -> None:
    folder = take / "theirs"
    write_as(folder, read_rig(take / "rig.toml"), kind)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    said = refused(["calibrate", "--import", str(folder / read), "--export", kind, "--out", str(folder)], capfd)
    assert "is also an input" in said and {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_word_of_an_option_is_no_file(take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a folder has the same name: the second time, it is the one that the first time made."""
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert main.main(["calibrate", "--import", str(take / "rig.toml"), "--export", "colmap", "--out", "colmap", "--quiet"]) == 0


@pytest.mark.parametrize(
    "command, name", [(["track", "--points"], "points2d.csv"), (["contour", "--view", "C", "--polygon"], "contours/C.csv")]
)
def test_results_that_are_read_are_not_replaced(take: Path, tmp_path: Path, capfd: Capture, command: list[str], name: str) -> None:
    path = tmp_path / "out" / name
    path.parent.mkdir(parents=True)
    path.write_text("point,view,x,y\na,L,60,60\na,C,60,60\n")
    before = path.read_bytes()
    said = refused([command[0], str(take), *command[1:], str(path), "--out", str(tmp_path / "out")], capfd)
    assert "is a result, which this command replaces" in said and path.read_bytes() == before


def test_the_bar_next_to_a_rig_replaces_no_other_file(tmp_path: Path, capfd: Capture) -> None:
    """Its name follows from that of the rig: nobody gave it."""
    (tmp_path / "bar").mkdir()
    argv = ["calibrate", str(tmp_path / "bar"), "--bar-length", "0.5", "--out", str(tmp_path / "b.toml")]
    (tmp_path / "b_bar.csv").write_text("point,view,x,y\na,L,60,60\n")
    assert "b_bar.csv would be overwritten, and is not of an earlier call" in refused(argv, capfd)
    assert "b_bar.csv is also an input" in refused([*argv, "--points", str(tmp_path / "b_bar.csv")], capfd)
    (tmp_path / "b_bar.csv").write_text("frame,1 from L x\n")
    assert "it needs a folder of images" in refused(argv, capfd)


@pytest.mark.parametrize("name", ["points3d.csv", "points2d.csv", "contours/C.csv"])
def test_tables_of_somebody_else_are_not_replaced(take: Path, tmp_path: Path, capfd: Capture, name: str) -> None:
    (tmp_path / "points.csv").write_text("point,view,x,y\na,L,60,60\na,C,60,60\n")
    (tmp_path / "polygon.csv").write_text("x,y\n20,20\n60,20\n60,60\n")
    out = tmp_path / "out"
    if "contours" in name:
        argv = ["contour", str(take), "--view", "C", "--polygon", str(tmp_path / "polygon.csv"), "--set", "fitting.use_surface=false"]
    else:
        argv = ["track", str(take), "--points", str(tmp_path / "points.csv")]
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("mine")
    assert f"{Path(name).name} would be overwritten, and is not of an earlier call" in refused([*argv, "--out", str(out)], capfd)
    assert (out / name).read_text() == "mine"
    (out / name).unlink()
    for _ in range(2):
        assert main.main([*argv, "--out", str(out), "--frames", "0:1", "--quiet"]) == 0


def test_pictures_replace_no_result(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    for name in ("skin/texture.png", "report/cloud_0000.png"):
        with pytest.raises(InputError, match="is also an input"):
            check_output(tmp_path / name, [tmp_path])
    check_output(tmp_path / "preview.png", [tmp_path])
    check_output(tmp_path / "body.blend", [tmp_path])


def test_no_result_of_a_run_is_replaced_by_another_command(take: Path, tmp_path: Path, capfd: Capture) -> None:
    out, rig = tmp_path / "out", str(take / "rig.toml")
    assert main.main([*MEASURE, str(take), "--out", str(out)]) == 0
    before = names(out)
    for argv in (["calibrate", "--import", rig], ["fields"]):
        for name in ("body.toml", "body.blend", "report/figures.csv"):
            assert "is a result of the run in" in refused([*argv, "--out", str(out / name)], capfd)
    assert names(out) == before
    check_output(out / "mine.csv")


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


OUTPUTS = {
    "take.toml": ["calibrate", "--import", "{rig}", "--out", "{take}/take.toml"],
    "an image": ["calibrate", "--board", "charuco", "--squares", "7x5", "--square", "0.04", "--print", "{take}/L/0002.png"],
    "through a link": ["calibrate", "--board", "charuco", "--squares", "7x5", "--square", "0.04", "--print", "{link}/0002.png"],
    "the footage": ["calibrate", "--import", "{rig}", "--export", "openptv", "--out", "{take}/L"],
    "the images that are tracked": ["track2d", "{frames}", "--points", "{points}", "--out", "{frames}/0001.png"],
    "the pictures": ["track2d", "{frames}", "--points", "{points}", "--out", "{new}", "--pictures", "{take}/C"],
    "a take's rig, for another tool": ["calibrate", "--import", "{rig}", "--export", "opencv", "--out", "{take}/rig.toml"],
    "its own input": ["calibrate", "--import", "{rig}", "--out", "{rig}"],
    "another input": ["calibrate", "--import", "{take}/rig.toml", "--like", "{rig}", "--out", "{rig}"],
    "a plot": ["fields", "--out", "{take}/take.toml"],
    "the time stamps": ["fields", "--out", "{take}/stamps.csv"],
    "the sound": ["fields", "--out", "{take}/L.wav"],
}  # fmt: skip


@LINKS
@pytest.mark.parametrize("what", OUTPUTS)
def test_no_file_that_is_written_is_an_input_or_part_of_a_take(take: Path, tmp_path: Path, capfd: Capture, what: str) -> None:
    shutil.copytree(take / "L", tmp_path / "frames")
    shutil.copy(take / "rig.toml", tmp_path / "rig.toml")
    (tmp_path / "points.csv").write_text("point,x,y\na,60,60\n")
    (tmp_path / "link").symlink_to(take / "L")
    text = (take / "take.toml").read_text(encoding="utf-8")
    (take / "take.toml").write_text(text.replace("[[views]]", '[[views]]\ntimestamps = "stamps.csv"', 1), encoding="utf-8")
    files = {name: tmp_path / name for name in ("frames", "link", "new")}
    files |= {"take": take, "rig": tmp_path / "rig.toml", "points": tmp_path / "points.csv"}
    before = names(tmp_path)
    said = refused([word.format(**files) for word in OUTPUTS[what]], capfd)
    assert ("is also an input" in said or "belongs to the take" in said) and names(tmp_path) == before, said


def test_the_take_of_a_run_is_kept_apart_and_its_rig_may_be_replaced(take: Path, tmp_path: Path) -> None:
    """The footage may lie elsewhere: then only the run, or the take, names it."""
    (take / "L").rename(tmp_path / "films")
    (take / "L").symlink_to(tmp_path / "films")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.json").write_text(json.dumps({"take": str(take)}))
    for file in (tmp_path / "films" / "0000.png", take / "rig.toml"):
        with pytest.raises(InputError, match="belongs to the take"):
            check_output(file, [tmp_path / "out"])
    check_output(take / "rig.toml", may_be_rig=True)
    for file in (tmp_path / "out" / "new.png", take / "results" / "a.csv", take / "new.csv"):
        check_output(file, [tmp_path / "out"])
    (take / "take.toml").write_text("damaged")
    with pytest.raises(InputError, match="belongs to the take"):
        check_output(take / "take.toml")
