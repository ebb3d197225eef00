"""What lies where a command writes, and where its output goes: links, other names of files, pipes, folders; closed and full streams.

The quick suite takes each name of a result once, with another thing in its place each; the slow test takes them all.
"""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from tricap.core.cli import main
from tricap.core.results.folder import PARENTS, WRITTEN

from ...mutations import SPECIAL, Waits

pytestmark = pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
Capture = pytest.CaptureFixture[str]
WAITS_S = 20
FOLDERS = {"clouds", "tracked", "skin", "outlines", "report", "contours", "planar", *PARENTS}


def _links_inside(path: Path, outside: Path) -> None:
    """A folder whose files are links out of it."""
    path.mkdir()
    for name in ("0000.ply", "0000.npz", "L.csv", "report.html", "rest.npz", "a"):
        (path / name).symlink_to(outside / "letter.txt")


def _second_names_inside(path: Path, outside: Path) -> None:
    path.mkdir()
    for name in ("0000.ply", "0000.npz", "L.csv", "report.html", "rest.npz"):
        (path / name).hardlink_to(outside / "letter.txt")


def _other_kind(path: Path, outside: Path) -> None:
    """A file where a folder is wanted, and a folder with something in it where a file is wanted."""
    if path.name in FOLDERS:
        path.write_bytes(b"mine")
    else:
        (path / "a").mkdir(parents=True)


PUT: dict[str, Callable[[Path, Path], Any]] = {
    "a link to a file": lambda path, outside: path.symlink_to(outside / "letter.txt"),
    "a link to a folder": lambda path, outside: path.symlink_to(outside),
    "a link to nothing": lambda path, outside: path.symlink_to(outside / "nothing"),
    "a link by way of another": lambda path, outside: path.symlink_to(os.path.relpath(outside / "chain", path.parent)),
    "a second name": lambda path, outside: path.hardlink_to(outside / "letter.txt"),
    "another kind": _other_kind,
    "links inside": _links_inside,
    "second names inside": _second_names_inside,
    **{what: lambda path, outside, put=put: put(path) for what, put in SPECIAL.items() if what != "a socket"},  # type: ignore[misc]
}  # fmt: skip


def contents(folder: Path) -> dict[str, str]:
    """Everything below a folder: what links lead to, and digests of files."""
    found = {}
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        found[name] = os.readlink(path) if path.is_symlink() else hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
    return found


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A folder that no command was given."""
    folder = tmp_path / "outside"
    (folder / "letters").mkdir(parents=True)
    (folder / "letter.txt").write_text("mine")
    (folder / "letters" / "a.npz").write_text("mine")
    (folder / "chain").symlink_to(folder / "letters")
    return folder


@pytest.fixture
def alarm() -> Iterator[Callable[[], Any]]:
    """Whoever waits longer than WAITS_S after its call is stopped."""

    def late(signum: int, frame: Any) -> None:
        raise Waits(f"it has waited for {WAITS_S} s")

    before = signal.signal(signal.SIGALRM, late)
    yield lambda: signal.alarm(WAITS_S)
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def small(tmp_path: Path, scenes: Any) -> Path:
    """A take of two flat frames in which nothing can be measured."""
    return scenes.write_take(tmp_path / "take", scenes.three_cameras(width=96, height=72), [[]] * 2, noise=0.0)


def surrounded(case: tuple[str, str], take: Path, outside: Path, capfd: Capture, alarm: Callable[[], Any]) -> None:
    """With this at the name of a result, commands end with a code of theirs and at most a sentence, and write nothing outside."""
    (name, what), before, footage = case, contents(outside), contents(take)
    out = outside.parent / "out"
    out.mkdir()
    (out / ".tricap-lock").write_text('{"pid": 1}')  # a killed run was here: the names may be those of its results
    (out / name).unlink(missing_ok=True)
    PUT[what](out / name, outside)
    for argv in (["check", str(out)], ["measure", str(take), "--out", str(out)], ["contour", str(take), "--view", "L", "--out", str(out)]):
        alarm()
        try:
            code = main.main([*argv, "--quiet"])
        except SystemExit as end:
            code = end.code
        printed = capfd.readouterr()
        assert code in (0, 1, 2), (case, argv, code)
        assert "Traceback" not in printed.err and "made a mistake" not in printed.err, (case, argv, printed.err)
        assert code != 2 or printed.err.count("\n") == 1, (case, argv, printed.err)
        assert contents(outside) == before and contents(take) == footage, (case, argv)
    shutil.rmtree(out)


@pytest.mark.slow
def test_each_name_of_a_result_with_something_else_there(small: Path, outside: Path, capfd: Capture, alarm: Callable[[], Any]) -> None:
    for i, name in enumerate(WRITTEN):
        surrounded((name, list(PUT)[i % len(PUT)]), small, outside, capfd, alarm)


@pytest.mark.slow
def test_everything_at_each_name_of_a_result(small: Path, outside: Path, capfd: Capture, alarm: Callable[[], Any]) -> None:
    for case in product(WRITTEN, PUT):
        surrounded(case, small, outside, capfd, alarm)


@pytest.mark.parametrize("shift", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_a_whole_run_over_links_at_all_its_files_writes_nothing_outside(
    plane_take: Path, tmp_path: Path, capfd: Capture, shift: int
) -> None:
    """Deeper than the names of results: at every file that a run makes, a link to or another name of a file outside, or a dangling link."""
    command = ["measure", str(plane_take), "--out", str(tmp_path / "out"), "--quiet"]
    assert main.main([*command, "--frames", "0:2"]) == 0
    (tmp_path / "outside").mkdir()
    files = [p for p in (tmp_path / "out").rglob("*") if p.is_file() and len(p.relative_to(tmp_path / "out").parts) > 1]
    for i, path in enumerate(files):
        there, kind = tmp_path / "outside" / str(i), (i + shift) % 3
        there.write_bytes(path.read_bytes())
        path.unlink()
        path.hardlink_to(there) if kind == 0 else path.symlink_to(there if kind == 1 else there.with_suffix(".nothing"))
    before = contents(tmp_path / "outside")
    assert len(before) > 4
    assert main.main([*command, "--frames", "0:2", "--set", "matching.patch_px=15"]) == 0, capfd.readouterr().err
    assert contents(tmp_path / "outside") == before


STREAMS = (
    ">&-",
    "2>&-",
    "<&- >&- 2>&-",
    "2>/dev/full",
    ">/dev/full",
    ">/dev/full 2>/dev/full",
    "| head -c 0",
    "2>&1 >/dev/null | head -c 0",
)


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-16"])
def test_a_name_that_is_no_utf_8_with_every_stream(small: Path, encoding: str) -> None:
    """The exit code is that of what was found, or 2 where what was asked for cannot be written."""
    odd = small.rename(small.with_name(os.fsdecode(b"take \xff \xe2\x80\x9c")))
    out = odd.with_name("out")
    for arguments, code in ((["check", odd], 1), (["check", odd, "--json"], 1), (["measure", odd, "--out", out], 2), (["--help"], 0)):
        for stream in STREAMS:
            line = f'"$@" {stream}; exit ${{PIPESTATUS[0]}}'
            command = ["bash", "-c", line, "bash", sys.executable, "-P", "-m", "tricap", *map(str, arguments)]
            done = subprocess.run(command, capture_output=True, env={**os.environ, "PYTHONIOENCODING": encoding}, timeout=120)
            case = (arguments, stream, done)
            assert done.returncode == (2 if stream.startswith(">/dev/full") else code), case
            assert b"Traceback" not in done.stderr and b"Exception ignored" not in done.stderr, case
