"""body.blend, which people edit and save: it is replaced and removed only while it is what Tricap wrote."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tricap.core.cli import main
from tricap.core.foundation import lock, store
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.results import blend_file
from tricap.core.results.folder import Results
from tricap.core.run import batch, pipeline
from tricap.core.run.take_run import open_run

Capture = pytest.CaptureFixture[str]
COARSE = {"growing": {"spacing_px": 16}}


def written(folder: Path, content: bytes = b"ours") -> Path:
    """A body.blend, written as the scene's builder does it."""
    if not (folder / "run.json").exists():
        Results(folder).write_run({})
    part = folder / "part"
    part.write_bytes(content)
    blend_file.note_written(folder, part)
    os.replace(part, folder / "body.blend")
    return folder / "body.blend"


def blends(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.blend")}


def test_what_tricap_wrote_stays_and_what_was_edited_gets_a_free_name(tmp_path: Path) -> None:
    blend = written(tmp_path)
    assert blend_file.keep_edited(tmp_path) == "" and blends(tmp_path) == {"body.blend": b"ours"}
    for n, name in enumerate(("body (edited).blend", "body (edited 2).blend", "body (edited 3).blend")):
        blend.write_bytes(b"edit %d" % n)  # also of the same size as before
        assert blend_file.keep_edited(tmp_path) == f"{blend} may have edits of yours and is kept as “{name}”."
        assert not blend.exists() and (tmp_path / name).read_bytes() == b"edit %d" % n
    assert len(blends(tmp_path)) == 3 and blend_file.keep_edited(tmp_path) == ""


PLAIN = b"BLENDER17-01" + 400 * b"x" + b"ENDB" + bytes(28)
PACKED = b"\x28\xb5\x2f\xfd" + 400 * b"x" + b"\x03\x00\x00\x00\x00\xb1\xea\x92\x8f"


@pytest.mark.parametrize("content", [PLAIN, PACKED])
def test_a_file_without_its_end_is_noticed(tmp_path: Path, content: bytes) -> None:
    blend = written(tmp_path, content)
    run = store.read_json(tmp_path / "run.json")
    assert blend_file.is_whole(blend) and blend_file.lacking(tmp_path, run) == "" and blend_file.lacking(tmp_path, {}) == ""
    for part in (content[:200], content[:-40], b"", b"nothing like it"):
        blend.write_bytes(part)
        assert not blend_file.is_whole(blend) and blend_file.lacking(tmp_path, run) == "is cut, or no Blender file"
    blend.unlink()
    assert not blend_file.is_whole(blend) and blend_file.lacking(tmp_path, run) == "is missing" and blend_file.lacking(tmp_path, {}) == ""


@pytest.mark.parametrize("record", ["earlier version", "damaged", "missing"])
def test_without_a_record_it_may_have_edits(tmp_path: Path, record: str) -> None:
    blend = written(tmp_path)
    if record == "earlier version":
        run = store.read_json(tmp_path / "run.json")
        store.write_json(tmp_path / "run.json", {name: value for name, value in run.items() if name != blend_file.DIGESTS})
    elif record == "damaged":
        (tmp_path / "run.json").write_text("{")
    else:
        (tmp_path / "run.json").unlink()
    assert "is kept as “body (edited).blend”" in blend_file.keep_edited(tmp_path) and not blend.exists()


def test_a_builder_that_is_killed_leaves_a_file_that_is_ours(tmp_path: Path) -> None:
    """Before the new file has its name, the earlier one is there; both are in the record."""
    blend = written(tmp_path)
    (tmp_path / "part").write_bytes(b"newer")
    blend_file.note_written(tmp_path, tmp_path / "part")
    assert blend_file.keep_edited(tmp_path) == ""
    os.replace(tmp_path / "part", blend)
    assert blend_file.keep_edited(tmp_path) == ""
    blend.write_bytes(b"edit")
    os.link(blend, tmp_path / "body (edited).blend")  # killed while it was renamed
    assert "“body (edited).blend”" in blend_file.keep_edited(tmp_path) and blends(tmp_path) == {"body (edited).blend": b"edit"}


def test_a_file_system_without_second_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(store.os, "link", refuse)
    written(tmp_path).write_bytes(b"edit")
    (tmp_path / "body (edited).blend").write_bytes(b"of last week")
    assert "“body (edited 2).blend”" in blend_file.keep_edited(tmp_path)
    assert blends(tmp_path) == {"body (edited).blend": b"of last week", "body (edited 2).blend": b"edit"}
    written(tmp_path).write_bytes(b"edit")
    monkeypatch.setattr(store.os, "replace", refuse)
    with pytest.raises(InputError, match="Cannot rename .*body.blend: no links here. Close the program"):
        blend_file.keep_edited(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_a_link_is_no_file_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "mine.blend").write_bytes(b"mine")
    (tmp_path / "body.blend").symlink_to(tmp_path / "mine.blend")
    assert blend_file.keep_edited(tmp_path) == "" and (tmp_path / "body.blend").is_symlink()


def test_only_the_run_that_has_the_folder_notes_what_is_written_there(tmp_path: Path) -> None:
    """Another process must not write run.json in between."""
    blend = written(tmp_path)
    with lock.locked(tmp_path):
        child = "from pathlib import Path; from tricap.core.results import blend_file; "
        child += f"blend_file.note_written(Path({str(tmp_path)!r}), Path('x'))"
        (tmp_path / "x").write_bytes(b"of a child")
        subprocess.run([sys.executable, "-c", child], cwd=tmp_path, check=True)  # as `tricap batch` builds the scene
        assert len(store.read_json(tmp_path / "run.json")[blend_file.DIGESTS]) == 2
        grandchild = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}], check=True)"
        (tmp_path / "x").write_bytes(b"of a stranger")
        before = (tmp_path / "run.json").read_bytes()
        subprocess.run([sys.executable, "-c", grandchild], cwd=tmp_path, check=True)
        assert (tmp_path / "run.json").read_bytes() == before
    assert blend_file.keep_edited(tmp_path) == "" and blend.exists()


@pytest.fixture
def out(plane_take: Path, tmp_path: Path) -> Path:
    """Results with a body.blend that somebody edited."""
    pipeline.run(plane_take, tmp_path / "out", COARSE, frames=(0, 2))
    written(tmp_path / "out").write_bytes(b"a finger is keyed")
    return tmp_path / "out"


OTHER = ["--set", "fitting.search_limbs=false"]


@pytest.mark.slow
@pytest.mark.parametrize("more", [OTHER, ["--restart"], [*OTHER, "--json"]])
def test_a_run_of_other_settings_keeps_the_edited_file(out: Path, plane_take: Path, capfd: Capture, more: list[str]) -> None:
    argv = ["run", str(plane_take), "--out", str(out), "--frames", "0:2", "--set", "growing.spacing_px=16", "--workers", "1"]
    assert main.main([*argv, *more]) == 0
    assert blends(out) == {"body (edited).blend": b"a finger is keyed"}
    assert capfd.readouterr().out.count("may have edits of yours and is kept as “body (edited).blend”.") == 1
    assert "edits of yours" not in (out / "run.json").read_text() + (out / "report" / "report.html").read_text(), "no part of the result"
    assert main.main([*argv, *more]) == 0 and "edits of yours" not in capfd.readouterr().out


def test_a_run_of_other_settings_removes_a_file_without_edits(out: Path, plane_take: Path, capfd: Capture) -> None:
    written(out, b"built again")
    argv = ["track", str(plane_take), "--out", str(out), "--frames", "0:2", "--set", "growing.spacing_px=16"]
    assert main.main(argv) == 0 and blends(out) == {"body.blend": b"built again"}, "nothing has changed"
    assert main.main([*argv, *OTHER]) == 0 and blends(out) == {}
    assert "edits of yours" not in capfd.readouterr().out


def test_a_run_that_fails_says_so_too(out: Path, plane_take: Path, capfd: Capture) -> None:
    argv = ["track", str(plane_take), "--out", str(out), "--frames", "0:2", "--set", "growing.spacing_px=16"]
    with pytest.raises(InputError), open_run(plane_take, out, {"matching": {"patch_px": 15}}, (0, 2)):
        raise InputError("Nothing was found.")
    assert blends(out) == {"body (edited).blend": b"a finger is keyed"}
    (out / "body.blend").write_bytes(b"another")

    def fail(*_: Any) -> None:
        raise InputError("Nothing was found.")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "track", fail)
        assert main.main([*argv, "--set", "matching.patch_px=17", "--quiet"]) == 2
    said = capfd.readouterr().err
    assert said.startswith("tricap: Nothing was found. ") and said.endswith("is kept as “body (edited 2).blend”.\n"), said


@pytest.mark.slow
def test_a_take_of_a_batch_keeps_the_edited_file(out: Path, plane_take: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its scene is built in a process whose sentences nobody reads."""
    pytest.importorskip("bpy")

    def build(line: list[str], **_: Any) -> Any:
        written(out, b"built again")
        return subprocess.CompletedProcess(line, 0, "", "")

    monkeypatch.setattr(batch.subprocess, "run", build)
    told = batch.run_take(str(plane_take), str(out), COARSE, False)
    assert told["status"] == batch.Status.DONE and "Warning: " in told["said"] and "is kept as “body (edited).blend”" in told["said"], told
    assert blends(out) == {"body (edited).blend": b"a finger is keyed", "body.blend": b"built again"}


def test_a_command_that_stops_says_so_too() -> None:
    from tricap.core.foundation.errors import sentence_of, with_notes
    from tricap.core.foundation.progress import Cancelled

    monitor = Monitor()
    monitor.cancel()
    for error in (InputError("It failed."), Cancelled("It failed."), OSError(errno.ENOSPC, "full")):
        error.add_note("A file was renamed.")
        assert with_notes(error).endswith(" A file was renamed.")
        assert isinstance(error, Cancelled) or str(sentence_of(error)).endswith(" A file was renamed.")
