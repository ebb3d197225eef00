"""One run at a time in a folder: who holds the lock is said, and no crash leaves it shut, whatever machine or process it was."""

import json
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tricap.core.foundation import lock
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.lock import NAME, locked

from ...waiting import wait_until

HOLD = "import sys; from tricap.core.foundation.lock import locked\nwith locked(sys.argv[1]): print('held', flush=True); sys.stdin.read()"


@pytest.fixture
def other(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the lock of tmp_path."""
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
        process.kill()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "BEAT_S", 0.02)
    monkeypatch.setattr(lock, "WATCH_S", 0.2)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The waits in which the count of another owner is watched."""
    waits = list[float]()
    monkeypatch.setattr(lock, "time", SimpleNamespace(sleep=waits.append, monotonic=time.monotonic))
    return waits


def test_it_is_free_again_and_leaves_nothing(tmp_path: Path) -> None:
    for _ in range(2):
        with locked(tmp_path):
            assert json.loads((tmp_path / NAME).read_text())["pid"] == os.getpid()
        assert not any(tmp_path.iterdir())


def test_two_processes_and_two_threads(tmp_path: Path, other: subprocess.Popen[str], watched: list[float]) -> None:
    with pytest.raises(InputError, match=rf"Another run \(process {other.pid} on .*\) is writing into .*; wait until"), locked(tmp_path):
        pass
    os.kill(other.pid, signal.SIGKILL) if os.name == "posix" else other.kill()
    other.wait()
    watched.clear()
    with locked(tmp_path):  # a killed run keeps nobody out, and nobody has to wait
        assert not watched
        with pytest.raises(InputError, match=f"process {os.getpid()} on"), locked(tmp_path):
            pass
        assert (tmp_path / NAME).exists()  # the refused one took nothing away
    assert not (tmp_path / NAME).exists()


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"pid": 1}', "[" * 2000, json.dumps({"pid": 1, "host": platform.node(), "count": "7"})])
def test_what_a_crash_may_leave(tmp_path: Path, watched: list[float], text: str) -> None:
    """An empty file, half of one, or one of a process (number 1 runs always, and is not it)."""
    (tmp_path / NAME).write_text(text)
    with locked(tmp_path):
        assert not watched


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_a_link_in_its_place_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "letter.txt").write_text("mine")
    for target in (tmp_path / "letter.txt", tmp_path / "not there yet"):
        (tmp_path / "out" / NAME).symlink_to(target)
        with pytest.raises(InputError, match="is a link, or no file; remove it"), locked(tmp_path / "out"):
            pass
        (tmp_path / "out" / NAME).unlink()
    for make in (os.mkfifo, os.mkdir):
        make(tmp_path / "out" / NAME)
        with pytest.raises(InputError, match="is a link, or no file; remove it"), locked(tmp_path / "out"):
            pass
        os.unlink(tmp_path / "out" / NAME) if make is os.mkfifo else os.rmdir(tmp_path / "out" / NAME)
    os.link(tmp_path / "letter.txt", tmp_path / "out" / NAME)
    with pytest.raises(InputError, match="is a link, or no file; remove it"), locked(tmp_path / "out"):
        pass
    assert (tmp_path / "letter.txt").read_text() == "mine" and not (tmp_path / "not there yet").exists()


def test_another_machine(tmp_path: Path, quick: None) -> None:
    """Its count is watched: one that stands still belongs to a run that is no more."""
    count, text = threading.Event(), {"pid": 5, "host": "elsewhere"}
    (tmp_path / NAME).write_text(json.dumps(text | {"count": "0001"}))
    with locked(tmp_path):
        assert json.loads((tmp_path / NAME).read_text())["host"] == platform.node()
    (tmp_path / NAME).write_text(json.dumps(text | {"count": "0001"}))

    def go_on() -> None:
        number = 1
        while not count.wait(0.02):
            number += 1
            (tmp_path / "new").write_text(json.dumps(text | {"count": f"{number:04d}"}))
            os.replace(tmp_path / "new", tmp_path / NAME)

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        with pytest.raises(InputError, match="process 5 on elsewhere"), locked(tmp_path):
            pass
    finally:
        count.set()
        thread.join()


def test_the_holder_counts(tmp_path: Path, quick: None) -> None:
    with locked(tmp_path):
        first = json.loads((tmp_path / NAME).read_text())
        wait_until(lambda: int(json.loads((tmp_path / NAME).read_text())["count"]) > int(first["count"]))


@pytest.mark.skipif(os.name == "nt", reason="flock")
def test_a_file_system_without_locks(tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """There the count decides, on one machine too."""
    import fcntl

    def none(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", none)
    with locked(tmp_path):
        with pytest.raises(InputError, match="Another run"), locked(tmp_path):
            pass
    (tmp_path / NAME).write_text(json.dumps({"pid": 5, "host": platform.node(), "count": "0001"}))
    with locked(tmp_path):
        pass


def test_folders_that_cannot_hold_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Cannot write into"), locked(tmp_path / "missing"):
        pass
