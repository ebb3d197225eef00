"""What happens to a machine in mid-run: the disk fills, a folder turns read-only, the input goes, the clock jumps, a second run begins.

One sentence and exit code 2 each, nothing that was finished is lost, and the same command goes on from there to the same bytes.
"""

import errno
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tricap.core.cli import main
from tricap.core.foundation.lock import locked
from tricap.core.surface import starts

from ...waiting import wait_until

NOT_COMPARED = ("run.json", "report/report.html", "report/report.json")  # they tell seconds
COARSE = ("--set", "growing.spacing_px=10", "--set", "growing.seed_spacing_px=20")
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def whole(plane_take: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a run to which nothing happened."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert run(plane_take, out) == 0
    return files(out)


@pytest.fixture
def take(plane_take: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(plane_take, tmp_path / "take"))


def run(take: Path, out: Path) -> int:
    return main.main(["run", str(take), "--out", str(out), "--quiet", *COARSE])


def files(out: Path) -> dict[str, bytes]:
    names = {p.relative_to(out).as_posix(): p for p in out.rglob("*") if p.is_file()}
    return {name: path.read_bytes() for name, path in names.items() if name not in NOT_COMPARED}


def at_the_frame(monkeypatch: pytest.MonkeyPatch, frame: int, fault: Callable[[], object]) -> None:
    """Let something happen when a frame is about to be measured."""
    read = starts.frame_views

    def fault_then_read(*args: object, **more: object) -> object:
        if args[1] == frame:
            fault()
        return read(*args, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(starts, "frame_views", fault_then_read)


def said(capfd: Capture) -> str:
    error = capfd.readouterr().err
    assert error.startswith("tricap: ") and error.count("\n") == 1, error
    return error


@pytest.mark.slow
@pytest.mark.parametrize(("call", "after"), [("fsync", 1), ("replace", 4), ("fsync", 9), ("replace", 12)])
def test_the_disk_is_full(
    take: Path, tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, capfd: Capture, call: str, after: int
) -> None:
    """From the `after`-th file on nothing can be written, wherever that is; then there is room again."""
    real, count = getattr(os, call), [0]

    def full(*args: object) -> object:
        count[0] += 1
        if count[0] > after:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*args)

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full)
        assert run(take, tmp_path / "out") == 2
    assert "No space left on device. Choose another folder or free some space." in said(capfd)
    kept = files(tmp_path / "out")
    kept.pop("frames.csv", None)  # it grows with every stage
    assert after - 3 <= len(kept) <= after and all(whole[name] == data for name, data in kept.items())
    assert run(take, tmp_path / "out") == 0 and files(tmp_path / "out") == whole


def test_the_disk_is_full_from_the_beginning(take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture) -> None:
    def full(*args: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    assert run(take, tmp_path / "out") == 2
    assert "Cannot write into" in (text := said(capfd)) and "No space left" in text


@pytest.mark.slow
def test_a_folder_that_turns_read_only(
    take: Path, tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, capfd: Capture
) -> None:
    opened = os.open

    def refused(path: Path, flags: int, *args: int, **more: int) -> int:
        if flags & os.O_CREAT:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        return opened(path, flags, *args, **more)

    with monkeypatch.context() as patch:
        at_the_frame(patch, 2, lambda: patch.setattr(os, "open", refused))
        assert run(take, tmp_path / "out") == 2
    assert "Read-only file system" in said(capfd)
    assert run(take, tmp_path / "out") == 0 and files(tmp_path / "out") == whole


@pytest.mark.slow
@pytest.mark.parametrize("gone", ["L/0003.png", "R", "rig.toml", "."])
def test_the_input_goes_away(
    take: Path, tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, capfd: Capture, gone: str
) -> None:
    """In the middle of the measuring; what was measured stays, and when the input is back the run goes on."""
    with monkeypatch.context() as patch:
        at_the_frame(patch, 1, lambda: (take / gone).rename(tmp_path / "away"))
        code = run(take, tmp_path / "out")
    if gone == "rig.toml":  # it was read at the beginning
        assert code == 0
    else:
        assert code == 2 and "Cannot read" in said(capfd)
    (tmp_path / "away").rename(take / gone)
    assert (tmp_path / "out" / "clouds" / "0000.ply").read_bytes() == whole["clouds/0000.ply"]
    assert run(take, tmp_path / "out") == 0 and files(tmp_path / "out") == whole


@pytest.mark.slow
def test_the_results_go_away(take: Path, tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody clears OUT during the run: what is missing in the end is there after the next run."""
    with monkeypatch.context() as patch:
        at_the_frame(patch, 2, lambda: shutil.rmtree(tmp_path / "out"))
        assert run(take, tmp_path / "out") in (0, 2)
    assert run(take, tmp_path / "out") == 0 and files(tmp_path / "out") == whole


@pytest.mark.slow
def test_the_clock_is_set_back(take: Path, tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """By ten years in mid-run, with checkpoints from the future, and forward again: no time of day decides anything."""
    real = time.time
    with monkeypatch.context() as patch:
        at_the_frame(patch, 2, lambda: patch.setattr(time, "time", lambda: real() - 10 * 365 * 86400))
        assert run(take, tmp_path / "out") == 0
    assert files(tmp_path / "out") == whole
    for path in (tmp_path / "out" / "cache").rglob("*.npz"):
        os.utime(path, (4e9, 4e9))
    computed: list[int] = []
    at_the_frame(monkeypatch, 0, lambda: computed.append(0))
    assert run(take, tmp_path / "out") == 0 and not computed and files(tmp_path / "out") == whole


def test_a_second_run_in_the_same_folder(take: Path, tmp_path: Path, whole: dict[str, bytes], capfd: Capture) -> None:
    (tmp_path / "out").mkdir()
    with locked(tmp_path / "out"):
        for argv in (["run"], ["measure"], ["run", "--restart"]):
            assert main.main([*argv, str(take), "--out", str(tmp_path / "out")]) == 2
            assert f"Another run (process {os.getpid()} on" in said(capfd)
    assert run(take, tmp_path / "out") == 0 and files(tmp_path / "out") == whole


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of Unix")
def test_a_run_that_is_halted_keeps_its_folder_and_goes_on(take: Path, tmp_path: Path, whole: dict[str, bytes], capfd: Capture) -> None:
    """SIGSTOP, as by Ctrl-Z or a laptop's lid: no other run takes the folder over, and after SIGCONT the result is the same."""
    first = tmp_path / "out" / "cache" / "surface" / "0000.npz"
    arguments = ["run", str(take), "--out", str(tmp_path / "out"), "--quiet", "--workers", "1", *COARSE]
    code = f"import sys; from tricap.core.cli import main; sys.exit(main.main({arguments!r}))"
    with subprocess.Popen([sys.executable, "-P", "-c", code], stderr=subprocess.PIPE) as halted:
        try:
            wait_until(lambda: first.is_file() or halted.poll() is not None)
            halted.send_signal(signal.SIGSTOP)
            assert run(take, tmp_path / "out") == 2 and f"Another run (process {halted.pid} on" in said(capfd)
        finally:
            halted.send_signal(signal.SIGCONT)
        assert halted.wait() == 0
    assert files(tmp_path / "out") == whole


def test_what_a_killed_run_left_half_written_is_cleared_away(take: Path, tmp_path: Path, whole: dict[str, bytes]) -> None:
    for name in (".run.json.x.part", "cache/surface/.0001.npz.y.part", "clouds/.0002.ply.z.part", ".body.77.part.blend"):
        (tmp_path / "out" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / name).write_bytes(b"half")
    (tmp_path / "out" / ".tricap-lock").write_text(json.dumps({"pid": 1, "host": platform.node(), "count": "0"}))
    assert run(take, tmp_path / "out") == 0 and files(tmp_path / "out") == whole
