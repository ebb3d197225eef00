"""In a folder of results, a run removes and replaces its own files alone; those of the user stay where they are, in every folder."""

import shutil
from pathlib import Path

import pytest

from tricap.core.cli import main
from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError
from tricap.core.results import films
from tricap.core.results.folder import RESULTS, Results, lost
from tricap.core.results.own_files import MADE_IN
from tricap.core.run import pipeline, take_run

Capture = pytest.CaptureFixture[str]
GIVEN = {"growing": {"spacing_px": 16}}
OTHER = {"growing": {"spacing_px": 15}}
USERS = (
    "notes.txt", "report/notes.txt", "report/me.png", "report/kick/take.toml", "report/kick/L/0000.png", "report/old/run.json",
    "clouds/my.ply", "clouds/sub/0000.ply", "skin/paint.png", "skin/0000 (painted).ply", "skin/kick/L/0000.png", "tracked/mine.ply",
    "tracked/x/0000.ply", "outlines/notes.csv", "outlines/kick/take.toml", "cache/notes.txt", "cache/surface/notes.txt",
    "cache/surface/kick/0000.npz",
)  # fmt: skip
OURS = (
    "clouds/0000.ply", "clouds/12345.ply", "tracked/0001.ply", "skin/0000.ply", "skin/rest.npz", "skin/texture.png",
    "skin/texture_mask.png", "report/report.html", "report/report.json", "report/figures.csv", "report/surface_0000.png",
    "report/body_0001_L.png", "report/layers.png", "cache/fit/a.npz",
)  # fmt: skip


def put(out: Path, names: tuple[str, ...]) -> None:
    for name in names:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("mine")


def test_every_folder_of_results_has_a_pattern_of_our_files() -> None:
    assert {name for name in RESULTS if "." not in name} | {"cache"} == {*MADE_IN}


@pytest.mark.slow
def test_a_run_leaves_files_and_folders_of_the_user(plane_take: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    pipeline.run(plane_take, out, GIVEN, frames=(0, 2))
    made = {path for path in out.rglob("*") if path.is_file()}
    put(out, USERS)
    pipeline.run(plane_take, out, OTHER, frames=(0, 2))
    pipeline.run(plane_take, out, OTHER, frames=(0, 2), restart=True)
    with take_run.open_run(plane_take, out, GIVEN, (0, 1)) as job:
        job.do_without_surface("of a test")
    assert [name for name in USERS if not (out / name).is_file() or (out / name).read_text() != "mine"] == []
    left = {path for path in out.rglob("*") if path.is_file()} - {out / name for name in USERS}
    assert left < made and not any(path.suffix in (".ply", ".html") for path in left), "ours are gone"


def test_what_is_removed_of_each_folder(tmp_path: Path) -> None:
    put(tmp_path, (*USERS, *OURS))
    store.write_text(tmp_path / "outlines" / "L.csv", "frame,vertex,x,y\n")
    results = Results.__new__(Results)
    results.folder = tmp_path
    results.remove(*MADE_IN)
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()} == {*USERS}


def test_a_file_at_the_name_of_a_folder_and_a_folder_at_that_of_a_file(tmp_path: Path) -> None:
    results = Results(tmp_path)
    put(tmp_path, ("clouds", "joints.csv/mine.txt", "film.mp4/mine.txt"))
    results.remove("clouds", "joints.csv", "film.mp4")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clouds", "film.mp4", "joints.csv"]


def test_files_of_the_user_are_not_counted_as_results(tmp_path: Path) -> None:
    results = Results(tmp_path)
    put(tmp_path, (*USERS, *OURS))
    store.save(tmp_path / "skin" / "rest.npz", {}, {})
    results.write_run({"stages": {}})
    shutil.rmtree(tmp_path / "skin" / "kick")
    for name in ("skin/paint.png", "clouds/my.ply"):
        (tmp_path / name).unlink()
    assert lost(tmp_path, results.read_run()) == {}
    (tmp_path / "skin" / "texture.png").unlink()
    assert lost(tmp_path, results.read_run()) == {"fit": ["skin"]}


@pytest.mark.slow
@pytest.mark.parametrize("name", films.FILMS)
@pytest.mark.parametrize("more", [[], ["--restart"]])
def test_a_film_of_the_user_is_refused_before_anything_is_removed(
    plane_take: Path, tmp_path: Path, capfd: Capture, name: str, more: list[str]
) -> None:
    out = tmp_path / "out"
    pipeline.run(plane_take, out, GIVEN, frames=(0, 2))
    (out / name).write_text("mine")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    argv = ["run", str(plane_take), "--out", str(out), "--frames", "0:2", "--set", "growing.spacing_px=15", *more]
    assert main.main(argv) == 2
    assert f"{name} is not as a run wrote it, and would be replaced; rename it" in capfd.readouterr().err
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert main.main(["run", str(plane_take), "--out", str(out), "--frames", "0:2", "--film", "--set", "growing.spacing_px=16"]) == 2
    assert f"{name} is not as a run wrote it" in capfd.readouterr().err and (out / name).read_text() == "mine"


def test_a_film_of_a_run_is_removed_with_what_it_shows_unless_it_was_changed(plane_take: Path, tmp_path: Path) -> None:
    out, part = tmp_path / "out", tmp_path / "part.mp4"
    pipeline.run(plane_take, out, GIVEN, frames=(0, 2))
    part.write_bytes(b"a film")
    films.place(part, out, films.FILM)
    with take_run.open_run(plane_take, out, GIVEN, (0, 2)) as job:
        job.results.write_run(job.record)  # its digest stays
    films.check_ours(out, Results(out).read_run())
    whole = (out / "film.mp4").read_bytes()
    (out / "film.mp4").write_bytes(whole + b" with a title")
    with pytest.raises(InputError, match="rename it"), take_run.open_run(plane_take, out, OTHER, (0, 2)):
        pass
    (out / "film.mp4").write_bytes(whole)
    with take_run.open_run(plane_take, out, OTHER, (0, 2)):
        assert not (out / "film.mp4").exists()
