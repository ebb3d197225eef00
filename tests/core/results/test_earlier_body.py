"""A finished body that a new fit replaces: it is kept beside the new one, whole."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.results import earlier_body, edited_tables
from tricap.core.results.folder import EARLIER, Results
from tricap.core.results.run_json import STAGE_FIGURES

STAGES = ("measure", "track", "fit", "report")
TABLES = ("frames.csv", "joints.csv", "motion.csv")


def fitted(folder: Path, text: str) -> dict[str, Any]:
    """A finished body; its run.json."""
    results = Results(folder)
    for name in (*TABLES, "body.toml", "skin/0000.ply", "report/report.html"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    stages: dict[str, dict[str, Any]] = {name: {"key": "k"} | {f: 1.0 for f in STAGE_FIGURES.get(name, ())} for name in STAGES}
    results.write_run({"take": "T", "frames": [0, 1], "warnings": [], "stages": stages, "asks": "Which?", "blend": ["d"]})
    return results.read_run()


def test_it_is_kept_whole_until_the_next_one_is_replaced(tmp_path: Path) -> None:
    place = tmp_path / EARLIER
    for text in ("first", "second"):
        run = fitted(tmp_path, text)
        (tmp_path / "skin" / "own.txt").write_text("the user's")
        (said,) = earlier_body.keep(tmp_path, run, "new")
        assert said.startswith(
            f"The body that was fitted before is kept in {place}, until the next finished one is replaced; `tricap scene"
        )
        assert not any((tmp_path / name).exists() for name in (*TABLES, "body.toml", "skin/0000.ply", "report/report.html"))
        assert {(place / name).read_text() for name in (*TABLES, "body.toml", "skin/0000.ply", "report/report.html")} == {text}
        assert (tmp_path / "skin" / "own.txt").exists() and not (place / "skin" / "own.txt").exists()
    record = json.loads((place / "run.json").read_text())
    assert {*record["stages"]} == {"fit", "report"} and not {"asks", "blend"} & {*record} and "clouds" not in record["files"]


def test_a_killed_run_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, moved = fitted(tmp_path, "whole"), list[str]()
    move = os.replace

    def dies(path: Path, to: Path) -> None:
        if Path(to).name == "motion.csv":
            raise PermissionError(13, "in use", str(path))
        move(path, to)
        moved.append(Path(to).name)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", dies)
        with pytest.raises(InputError, match=r"Cannot move .*motion.csv: in use. Close the program"):
            earlier_body.keep(tmp_path, run, "new")
    assert "joints.csv" in moved and (tmp_path / "body.toml").exists()
    assert (
        earlier_body.keep(tmp_path, run, "new") and (tmp_path / EARLIER / "joints.csv").exists() and not (tmp_path / "body.toml").exists()
    )


def test_what_somebody_put_or_edited_there_gets_another_name(tmp_path: Path) -> None:
    """It stopped the move half-way, or was replaced without a word."""
    place = tmp_path / EARLIER
    earlier_body.keep(tmp_path, fitted(tmp_path, "first"), "new")

    def edited() -> None:
        (place / "motion.csv").write_text("edited")

    def folder() -> None:
        (place / "motion.csv").unlink()
        (place / "motion.csv").mkdir()

    def file() -> None:
        place.write_text("a file")

    def own() -> None:
        (place / "thesis.txt").write_text("own")

    def inside() -> None:
        (place / "skin" / "thesis.txt").write_text("own")

    def link() -> None:
        place.symlink_to(tmp_path)

    def linked_folder() -> None:
        place.mkdir()
        (place / "skin").symlink_to(tmp_path / "skin")

    for n, change in enumerate((edited, folder, own, inside, file, link, linked_folder), 1):
        if change in (file, link, linked_folder):
            place.rename(tmp_path / f"away {n}")
        change()
        said = earlier_body.keep(tmp_path, fitted(tmp_path, f"body {n}"), "new")
        other = tmp_path / (EARLIER + (" (edited)" if n == 1 else f" (edited {n})"))
        assert said[0] == f"{place} has files that no run moved there, or edits, and is kept as “{other.name}”.", change
        assert os.path.lexists(other) and (place / "motion.csv").read_text() == (place / "skin" / "0000.ply").read_text() == f"body {n}"
    assert (tmp_path / "earlier_body (edited)" / "motion.csv").read_text() == "edited"
    assert len(earlier_body.keep(tmp_path, fitted(tmp_path, "last"), "new")) == 1


def test_going_back_to_the_body_that_was_being_moved_leaves_no_part_of_it(tmp_path: Path) -> None:
    run = fitted(tmp_path, "whole")
    earlier_body.keep(tmp_path, run, "new")
    (tmp_path / EARLIER / "body.toml").rename(tmp_path / "body.toml")  # as a killed run leaves it
    assert earlier_body.keep(tmp_path, run, "k") == [] and not (tmp_path / EARLIER).exists()


def test_an_edited_table_is_copied_once(tmp_path: Path) -> None:
    """Also where a run is killed after the copy."""
    stages = {"fit": {edited_tables.ENTRY: {"motion.csv": "another digest"}}}
    (tmp_path / "motion.csv").write_text("edited")
    for _ in range(2):
        assert "kept as “motion (edited).csv”" in edited_tables.keep(tmp_path, stages)[0]
    (tmp_path / "motion.csv").write_text("edited again")
    assert "kept as “motion (edited 2).csv”" in edited_tables.keep(tmp_path, stages)[0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["motion (edited 2).csv", "motion (edited).csv", "motion.csv"]


def test_what_is_no_whole_body_or_will_be_the_same_is_not_kept(tmp_path: Path) -> None:
    run = fitted(tmp_path, "whole")
    assert earlier_body.keep(tmp_path, run, "k") == []
    assert earlier_body.keep(tmp_path, run | {"stages": {"fit": {"not_done": "no clicks"}}}, "new") == []
    assert earlier_body.keep(tmp_path, {}, "new") == []
    (tmp_path / "motion.csv").write_text("c")
    assert earlier_body.keep(tmp_path, run, "new") == [] and not (tmp_path / EARLIER).exists()


def test_its_folder_is_no_way_out(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    fitted(tmp_path / "out", "whole")
    (tmp_path / "out" / EARLIER).mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out" / EARLIER / "skin").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="is a link to a place outside"):
        Results(tmp_path / "out")
