"""Workers measure the frames of a take: the same bytes for any number of them, one sentence for what is wrong, and nothing runs on."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.run import take_run, workers
from tricap.core.run.engine import Engine, dask_client, python_command

TWO = Engine(workers=2, retries=1)


@pytest.fixture(autouse=True)
def every_take_is_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "FEWEST", 1)
    monkeypatch.setattr(workers, "PIECE", 1)


def checkpoints(out: Path) -> dict[str, bytes]:
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in sorted((out / "cache").rglob("*.npz"))}


def measured(take: Path, out: Path, engine: Engine, monitor: Monitor | None = None) -> dict[str, bytes]:
    """The checkpoints of a take that an engine measured."""
    with take_run.open_run(take, out) as job:
        workers.measure_at_once(job, engine, monitor or Monitor(), set())
    return checkpoints(out)


def test_workers_that_cannot_start_are_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    import distributed

    def fails(**_: object) -> None:
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr(distributed, "LocalCluster", fails)
    with pytest.raises(InputError, match="worker processes cannot be started"), dask_client(TWO):
        pass


@pytest.mark.slow
def test_workers_give_the_bytes_of_one_process(plane_take: Path, tmp_path: Path, scenes: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    many = measured(plane_take, tmp_path / "many", TWO)
    monkeypatch.setattr(workers, "FEWEST", 1000)
    with take_run.open_run(plane_take, tmp_path / "one") as job:
        list(workers.measure_frames(job.measured_footage, workers.MeasureSettings.of(job.settings), job.results, Monitor()))
    assert len(many) == 8 and many == checkpoints(tmp_path / "one")


@pytest.mark.slow
def test_a_stopped_run_resumes_and_leaves_no_process(plane_take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[str]] = []
    popen = subprocess.Popen
    monkeypatch.setattr(workers.subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[-1])
    monitor = Monitor(lambda stage, done, total: monitor.cancel() if stage == "surface" and total == 3 else None)
    with pytest.raises(Cancelled):
        measured(plane_take, tmp_path / "out", TWO, monitor)
    assert started and all(process.poll() is not None for process in started)
    assert measured(plane_take, tmp_path / "out", TWO) == measured(plane_take, tmp_path / "again", TWO)


PRESSED = """import os, signal, sys
from tricap.__main__ import main
from tricap.core.run import workers
workers.FEWEST = workers.PIECE = 1
finished = workers._finished
def pressed(work):
    for done in finished(work):
        if done:
            os.killpg(0, signal.SIGINT)
        yield done
workers._finished = pressed
sys.exit(main(sys.argv[1:]))"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a terminal there has no process groups")
def test_ctrl_c_in_a_terminal_is_one_sentence_with_the_true_count(plane_take: Path, tmp_path: Path) -> None:
    """It goes to the whole group of processes; what the workers have measured by then counts."""
    line = [sys.executable, "-P", "-c", PRESSED, "measure", plane_take, "--out", tmp_path / "out", "--quiet"]
    done = subprocess.run(line, capture_output=True, text=True, start_new_session=True)
    kept = len(list((tmp_path / "out" / "cache" / "surface").glob("[0-9]*.npz")))  # a killed worker leaves a part
    assert done.returncode == 130 and kept >= 1
    assert done.stderr == f"tricap: Stopped: the surface of {kept} of 4 frames is kept; run it again to go on.\n"


def test_what_a_worker_refuses_is_said_in_one_sentence(plane_take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = Path(shutil.copytree(plane_take, tmp_path / "take"))
    task = workers._task

    def without_image(run: take_run.Run, keys: dict[int, str]) -> workers.Task:
        if 2 in keys:  # its start is known
            (take / "L" / "0002.png").unlink()
        return task(run, keys)

    monkeypatch.setattr(workers, "_task", without_image)
    with pytest.raises(InputError, match="View L lacks the image|0002.png"):
        measured(take, tmp_path / "out", TWO)


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(plane_take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first process of every worker dies at its first task; with no second try, that is an error."""
    marker = tmp_path / "died"
    code = f"""import os, pathlib, runpy, sys
died = pathlib.Path({str(marker)!r} + str(os.getppid()))
if not died.exists():
    sys.stdin.readline()
    died.touch()
    os._exit(9)
runpy.run_module("tricap.core.cli.worker", run_name="__main__")"""
    environment = python_command("core.cli.worker")[1]
    monkeypatch.setattr(workers, "python_command", lambda module: ([sys.executable, "-P", "-c", code], environment))
    assert len(measured(plane_take, tmp_path / "out", Engine(workers=1, retries=1))) == 8
    for path in tmp_path.glob("died*"):
        path.unlink()
    with pytest.raises(InputError, match="died 1 times"):
        measured(plane_take, tmp_path / "other", Engine(workers=1, retries=0))


def test_a_worker_whose_run_is_gone_ends_without_a_word(tmp_path: Path) -> None:
    command, environment = python_command("core.cli.worker")
    pipes = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    worker = subprocess.Popen(command, env=os.environ | environment, **pipes)  # type: ignore[call-overload]
    worker.stdout.close()  # nobody reads its answers
    refused = {
        "take": str(tmp_path),
        "frames": [0, 1],
        "delay_images": [],
        "reduced_for_m": None,
        "settings": dict.fromkeys(workers.SETTINGS, {}),
        "keys": {},
    }
    said = worker.communicate((json.dumps(refused) + "\n").encode())[1]
    assert worker.returncode == 0 and said == b""


def test_a_task_is_plain_text(plane_take: Path, tmp_path: Path) -> None:
    """It travels between machines, and holds every setting, also those of the command line."""
    with take_run.open_run(plane_take, tmp_path / "out", {"matching": {"patch_px": 15}}) as job:
        task = workers._task(job, {3: "key"})
    assert json.loads(json.dumps(task)) == task and task["settings"]["matching"]["patch_px"] == 15 and task["keys"] == {"3": "key"}


def test_footage_stays_open_from_task_to_task(plane_take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A movie is decoded from its beginning: opened anew for every task, a long one would never end."""
    opened, open_take = list[Any](), workers.open_take
    monkeypatch.setattr(workers, "open_take", lambda *a, **k: opened.append(a) or open_take(*a, **k))
    monkeypatch.setattr(workers, "measure_piece", lambda *a: None)
    with take_run.open_run(plane_take, tmp_path / "out") as job:
        tasks = [workers._task(job, {frame: "key"}) for frame in (0, 1)]
    with take_run.open_run(plane_take, tmp_path / "other", {"matching": {"patch_px": 15}}) as job:
        tasks.append(workers._task(job, {2: "key"}))
    pieces = workers.Pieces()
    for task, count in zip(tasks, (1, 1, 2)):
        pieces.run(task)
        assert len(opened) == count
