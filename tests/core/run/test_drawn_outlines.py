"""An outline is used only as long as its view has the images on which it was drawn; a new one leaves the fitted body where it is."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.cli import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.run import pipeline, take_run
from tricap.core.run.check import check_run

Capture = pytest.CaptureFixture[str]
POLYGON = "x,y\n20,20\n60,20\n60,60\n20,60\n"
WITHOUT_SURFACE = ("--frames", "0:2", "--quiet", "--set", "fitting.use_surface=false")
GIVEN = {"fitting": {"use_surface": False}}


@pytest.fixture
def drawn(plane_take: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A copy of a take, and results with an outline in view C."""
    take, out = Path(shutil.copytree(plane_take, tmp_path / "take")), tmp_path / "out"
    (tmp_path / "p.csv").write_text(POLYGON)
    argv = ["contour", str(take), "--view", "C", "--polygon", str(tmp_path / "p.csv"), "--out", str(out), *WITHOUT_SURFACE]
    assert main.main(argv) == 0
    return take, out


def replace_image(path: Path) -> None:
    grey = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    path.write_bytes(bytes(cv2.imencode(path.suffix, 255 - grey)[1]))


def opened(take: Path, out: Path) -> list[str]:
    """The notes of a run that is opened, and goes no further."""
    with take_run.open_run(take, out, GIVEN, (0, 2)) as job:
        return list(job.notes)


def outlines(out: Path) -> list[str]:
    return sorted(path.name for path in (out / "contours").iterdir())


def edit(take: Path, old: str, new: str) -> None:
    text = (take / "take.toml").read_text(encoding="utf-8")
    assert old in text
    (take / "take.toml").write_text(text.replace(old, new), encoding="utf-8")


def said_by_check(out: Path) -> list[str]:
    return [finding.sentence for finding in check_run(out, Monitor()).findings if "was drawn on other images" in finding.sentence]


def test_the_outline_of_replaced_images_is_set_aside(drawn: tuple[Path, Path]) -> None:
    take, out = drawn
    assert opened(take, out) == [] and outlines(out) == ["C.csv"] and said_by_check(out) == []
    before = (out / "contours" / "C.csv").read_bytes()
    replace_image(take / "C" / "0001.png")
    assert len(said_by_check(out)) == 1
    assert opened(take, out) == [
        f"{out / 'contours' / 'C.csv'} was drawn on other images of view C than the take has now: it is not used, and kept as “C.csv.bak”. "
        "`tricap contour` draws a new one."
    ]
    assert outlines(out) == ["C.csv.bak"] and (out / "contours" / "C.csv.bak").read_bytes() == before
    assert opened(take, out) == [] and said_by_check(out) == []


def test_also_where_a_run_begins_anew(drawn: tuple[Path, Path]) -> None:
    take, out = drawn
    replace_image(take / "C" / "0001.png")
    with take_run.open_run(take, out, GIVEN, (0, 2), restart=True):
        assert outlines(out) == ["C.csv.bak"]


def test_an_error_that_follows_says_that_an_outline_was_set_aside(drawn: tuple[Path, Path], capfd: Capture) -> None:
    take, out = drawn
    replace_image(take / "C" / "0001.png")
    (out / "film.mp4").write_text("mine")
    assert main.main(["run", str(take), "--out", str(out), *WITHOUT_SURFACE]) == 2
    said = capfd.readouterr().err
    assert "film.mp4 is not as a run wrote it" in said and "kept as “C.csv.bak”" in said


@pytest.mark.parametrize("change", ["\noffset_frames = 1\n", "\nstart = -0.04\n"])
def test_other_images_of_the_same_files_are_others(drawn: tuple[Path, Path], change: str) -> None:
    take, out = drawn
    edit(take, 'name = "C"\n', f'name = "C"{change}')
    edit(take, "version = 1\n", "version = 1\nframes = [0, 2]\n")
    with take_run.open_run(take, out, GIVEN) as job:
        assert "kept as “C.csv.bak”" in job.notes[0]


def test_images_of_other_views_and_a_copy_of_the_project_change_nothing(drawn: tuple[Path, Path], tmp_path: Path) -> None:
    take, out = drawn
    replace_image(take / "L" / "0001.png")
    assert opened(take, out) == []
    copy = Path(shutil.copytree(take, tmp_path / "copy"))
    for path in copy.rglob("*.png"):
        os.utime(path, (1000, 1000))
    assert opened(copy, out) == [] and opened(copy, out) == [] and outlines(out) == ["C.csv"]


def test_a_table_that_somebody_else_wrote_belongs_to_the_images_of_its_first_run(drawn: tuple[Path, Path]) -> None:
    take, out = drawn
    path = out / "contours" / "C.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:9]))
    replace_image(take / "C" / "0001.png")
    assert opened(take, out) == [] and outlines(out) == ["C.csv"]
    replace_image(take / "C" / "0001.png")
    assert len(opened(take, out)) == 1


def test_a_damaged_outline_is_refused_before_anything_is_removed(drawn: tuple[Path, Path], tmp_path: Path, capfd: Capture) -> None:
    take, out = drawn
    (out / "joints.csv").write_text("of an earlier fit")
    (out / "contours" / "C.csv").write_text("what?")
    assert main.main(["run", str(take), "--out", str(out), *WITHOUT_SURFACE]) == 2
    assert "C.csv is damaged; run `tricap contour` again" in capfd.readouterr().err and (out / "joints.csv").exists()
    (out / "contours" / "C.csv").unlink()
    opened(take, out)
    assert not (out / "joints.csv").exists()


BODY = ("body.toml", "joints.csv", "motion.csv", "skin/0000.ply", "skin/rest.npz", "report/report.html", "body.blend")


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--set", "matching.patch_px=15"]])
def test_a_new_outline_leaves_the_fitted_body_where_it_is(plane_take: Path, tmp_path: Path, more: list[str]) -> None:
    out, given = tmp_path / "out", ["--frames", "0:2", "--quiet", "--set", "growing.spacing_px=16"]
    pipeline.run(plane_take, out, {"growing": {"spacing_px": 16}}, frames=(0, 2))
    for name in BODY:
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("of the fit")
    assert main.main(["contour", str(plane_take), "--view", "C", "--out", str(out), *given, *more]) == 0
    assert [name for name in BODY if (out / name).read_text() != "of the fit"] == []
    with take_run.open_run(plane_take, out, {"growing": {"spacing_px": 16}}, (0, 2)):
        assert [name for name in BODY if (out / name).exists()] == [], "until the next fit"


def test_no_body_to_begin_with_is_refused_before_anything_is_removed(plane_take: Path, tmp_path: Path, capfd: Capture) -> None:
    out = tmp_path / "out"
    pipeline.run(plane_take, out, {"growing": {"spacing_px": 16}}, frames=(0, 2))
    (out / "skin").mkdir()
    (out / "skin" / "0000.ply").write_text("of the fit")
    before = sorted(path for path in out.rglob("*") if path.is_file())
    argv = ["contour", str(plane_take), "--view", "C", "--from-body", "--out", str(out), "--frames", "0:2"]
    assert main.main(argv) == 2 and "has no fitted body with a skin for these frames and settings" in capfd.readouterr().err
    assert sorted(path for path in out.rglob("*") if path.is_file()) == before


def test_damaged_entries_of_outlines_are_one_sentence(drawn: tuple[Path, Path]) -> None:
    take, out = drawn
    run = out / "run.json"
    run.write_text(run.read_text(encoding="utf-8").replace('"outlines": {', '"outlines": {"L": [1], ', 1), encoding="utf-8")
    with pytest.raises(InputError, match="“outlines” is invalid"):
        opened(take, out)
