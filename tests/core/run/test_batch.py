"""Many takes on Dask: the results of one by one, whatever happens to the others or to a worker, and a summary that says so."""

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tricap.core.cli import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.lock import NAME
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.run import batch, pipeline, take_run
from tricap.core.run import engine as engines
from tricap.core.run.batch import Outcome, Status, out_folders, run_batch, run_take, summary
from tricap.core.run.engine import Engine, dask_client

from ...waiting import when

COARSE = {"growing": {"spacing_px": 8}}
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def killing() -> ModuleType:
    """How the files of two runs are compared."""
    spec = importlib.util.spec_from_file_location("killing_for_batch", Path(__file__).parents[2] / "killing.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["killing_for_batch"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def takes(plane_take: Path, tmp_path: Path) -> list[Path]:
    """A take, one without rig, and another take."""
    folders = [Path(shutil.copytree(plane_take, tmp_path / "takes" / name)) for name in ("kick é", "no rig", "throw")]
    (folders[1] / "rig.toml").unlink()
    return folders


def without_blend(files: dict[str, bytes]) -> dict[str, bytes]:
    """One by one, in this test, makes no body.blend."""
    return {name: data for name, data in files.items() if name != "body.blend"}


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="SIGKILL")
def test_a_worker_killed_in_mid_take(takes: list[Path], tmp_path: Path, killing: ModuleType, capfd: Capture) -> None:
    """The first take's worker dies when two of its frames are measured; all takes end as one by one, and the bad one is told."""
    out, killed = tmp_path / "out", list[int]()

    def kill() -> None:
        killed.append(json.loads((out / takes[0].name / NAME).read_text())["pid"])
        os.kill(killed[0], signal.SIGKILL)

    when((out / takes[0].name / "cache" / "surface" / "0001.npz").exists, kill)
    code = main.main(["batch", *map(str, takes), "--out", str(out), "--workers", "2", "--set", "growing.spacing_px=8"])
    assert killed and killed[0] != os.getpid() and code == 2
    printed = capfd.readouterr()
    assert "3 takes: 2 done, 1 needs mending" in printed.out and "kick é: surface" in printed.err
    told = json.loads((out / "batch.json").read_text())["takes"]
    assert [t["status"] for t in told] == [Status.DONE, Status.INVALID_INPUT, Status.DONE] and "rig.toml" in told[1]["said"]
    for take in (takes[0], takes[2]):
        pipeline.run(take, tmp_path / "single" / take.name, COARSE)
        single, many = (without_blend(killing.contents(folder / take.name)) for folder in (tmp_path / "single", out))
        assert killing.differences(single, many) == []
    assert not (out / "no rig").exists()


def test_a_scheduler_by_its_address(takes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers as threads of this process, so that they see what is patched here: a run that is short, and a bug."""
    from distributed import LocalCluster

    def stages(job: take_run.Run, monitor: Monitor) -> None:
        monitor.step("surface", 1, 2)
        if job.footage.take.folder.name == "throw":
            raise ZeroDivisionError("ours")

    monkeypatch.setattr(pipeline, "all_stages", stages)
    monkeypatch.setattr(batch, "_scene", lambda job: None)
    if sys.platform == "linux":  # where names of folders are any bytes
        takes.append(Path(shutil.copytree(takes[0], takes[0].with_name(os.fsdecode(b"k\xff")))))
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        engine = Engine(scheduler=cluster.scheduler_address)
        outcomes = run_batch(takes, tmp_path / "out", engine, COARSE, Monitor())
        assert [o.status for o in outcomes[:3]] == [Status.DONE, Status.INVALID_INPUT, Status.BUG]
        assert all(o.status == Status.INVALID_INPUT and "k\\udcff is not UTF-8" in o.said for o in outcomes[3:])
        told = json.loads((tmp_path / "out" / "batch.json").read_text())["takes"]
        assert [t["take"] for t in told] == [str(take) for take in takes]
        assert "throw_error.txt" in outcomes[2].said and "ZeroDivisionError: ours" in (tmp_path / "out" / "throw_error.txt").read_text()
        monitor = Monitor()
        monitor.cancel()
        with pytest.raises(Cancelled):
            run_batch(takes, tmp_path / "other", engine, {}, monitor)
    assert {t["status"] for t in json.loads((tmp_path / "other" / "batch.json").read_text())["takes"]} <= {
        "waiting",
        Status.INVALID_INPUT,
        Status.DONE,
        Status.BUG,
    }


def test_the_task_of_a_worker(takes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch.importlib.util, "find_spec", lambda name: None)  # no Blender
    told = run_take(str(takes[0]), str(tmp_path / "out"), COARSE, False)
    assert told["status"] == Status.DONE and "4 frames" in told["said"] and (tmp_path / "out" / "report" / "report.html").exists()
    report = (tmp_path / "out" / "report" / "report.html").stat().st_mtime_ns
    again = run_take(str(takes[0]), str(tmp_path / "out"), COARSE, False)
    assert again["status"] == Status.DONE and again["said"] == told["said"]
    assert (tmp_path / "out" / "report" / "report.html").stat().st_mtime_ns == report, "a finished take is not reported again"
    (tmp_path / "file").write_text("")
    assert run_take(str(takes[0]), str(tmp_path / "file"), {}, False)["status"] == Status.INVALID_INPUT


def test_the_scene_is_built_by_this_package_and_its_absence_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module of the working folder, which would run in place of the package, is not loaded; a child that writes nothing is noticed."""
    pytest.importorskip("bpy")
    stranger = "from pathlib import Path\nPath('stranger ran').touch()\n"
    (tmp_path / "tricap.py").write_text(stranger)
    monkeypatch.chdir(tmp_path)
    warnings, results = list[str](), tmp_path / "results"
    folder = SimpleNamespace(folder=results, path=results.joinpath, write_run=lambda record: None)
    job = SimpleNamespace(results=folder, record={}, warn=warnings.append, notes=[])
    batch._scene(job)
    assert not (tmp_path / "stranger ran").exists() and len(warnings) == 1 and str(results) in warnings[0], warnings
    monkeypatch.setattr(batch.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=0, stderr=""))
    batch._scene(job)
    assert warnings[1] == "No body.blend was written: Blender ended without a message."


@pytest.mark.parametrize(("workers", "cores", "threads"), [(1, 2, "2"), (2, 2, "1"), (2, 8, "2"), (16, 8, "1")])
def test_each_worker_has_its_share_of_the_cores(workers: int, cores: int, threads: str) -> None:
    environment = os.environ | engines.thread_limits(workers, cores)
    code = "from tricap.core.foundation import threads; print(threads.THREADS)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [threads]


def test_what_is_doubtful_stands_in_the_summary() -> None:
    job = SimpleNamespace(record={"warnings": []}, notes=[], __str__=lambda: "")
    assert batch._summary_of(job) == str(job)
    job.record["warnings"] = ["View R stood still.", "Another.", "A third."]
    assert batch._summary_of(job).endswith(". Warning: View R stood still. (2 more in the report)")


def test_without_dask(takes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture) -> None:
    monkeypatch.setattr(batch.importlib.util, "find_spec", lambda name: None)
    assert main.main(["batch", str(takes[0]), "--out", str(tmp_path / "out")]) == 2
    assert capfd.readouterr().err == f"tricap: {engines.MISSING}\n"


def test_no_scheduler_there(takes: list[Path], tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "CONNECT_S", 0.5)
    assert main.main(["batch", str(takes[0]), "--out", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:9", "--quiet"]) == 2
    assert "No Dask scheduler answers at tcp://127.0.0.1:9" in capfd.readouterr().err.splitlines()[-1]
    assert main.main(["batch", str(takes[0]), "--out", str(tmp_path / "out"), "--workers", "0"]) == 2
    assert capfd.readouterr().err == "tricap: --workers 0 is out of range; write 1 to 1000.\n"


def test_names_of_results(tmp_path: Path) -> None:
    a, b, c = tmp_path / "monday" / "kick", tmp_path / "tuesday" / "kick", tmp_path / "throw"
    assert [p.name for p in out_folders([a, b, c], tmp_path)[0]] == ["monday_kick", "tuesday_kick", "throw"]
    outs, refused = out_folders([a, tmp_path / "tuesday" / "Kick"], tmp_path)  # one name on macOS and Windows
    assert [p.name for p in outs] == ["monday_kick", "tuesday_Kick"] and not refused
    _, refused = out_folders([a, c, a], tmp_path)
    assert list(refused) == [2] and "is listed twice" in refused[2]
    c.mkdir()
    (c / "take.toml").touch()
    with pytest.raises(InputError, match="is itself a take"):
        out_folders([a], c)


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_a_take_whose_results_have_no_place_stops_no_other(takes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its folder is a link out of the results, a take, or the one of another take; a file in its place is the worker's to report."""
    from distributed import LocalCluster

    monkeypatch.setattr(pipeline, "all_stages", lambda job, monitor: None)
    monkeypatch.setattr(batch, "_scene", lambda job: None)
    takes += [Path(shutil.copytree(takes[0], takes[0].with_name(name))) for name in ("a take", "file")]
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    shutil.copytree(takes[0], out / "a take")
    (out / "file").touch()
    elsewhere.mkdir()
    (out / takes[0].name).symlink_to(elsewhere)
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        engine = Engine(scheduler=cluster.scheduler_address)
        outcomes = run_batch([*takes, takes[2]], out, engine, COARSE, Monitor())
    bad = Status.INVALID_INPUT
    assert [o.status for o in outcomes] == [bad, bad, Status.DONE, bad, bad, bad], outcomes
    for n, said in {0: "is a link to a place outside", 3: "is itself a take", 4: "file", 5: "is listed twice"}.items():
        assert said in outcomes[n].said
    told = json.loads((out / "batch.json").read_text())["takes"]
    assert [t["status"] for t in told] == [o.status for o in outcomes]
    assert not list(elsewhere.iterdir()) and [p.name for p in (out / "a take").iterdir()] == [p.name for p in takes[0].iterdir()]


def test_the_summary() -> None:
    fine = Outcome(take="/t/a", out="/o/a", status=Status.DONE, said="fine", seconds=61.0)
    lost = Outcome(take="/t/bb", out="/o/bb", status=Status.LOST, said="")
    (forged, *_, count) = summary([replace(fine, out="/o/zz\nbA    done")])
    assert forged.startswith("zz\\nbA    done  done") and "\n" not in forged and count == "1 takes: 1 done"
    lines = summary([fine, lost])
    assert lines[0].startswith("a   done") and "61.0 s  fine" in lines[0] and lines[-1] == "2 takes: 1 done, 1 lost"


def test_the_workers_of_this_machine_cannot_be_reached_from_others(monkeypatch: pytest.MonkeyPatch) -> None:
    import distributed

    given: dict[str, Any] = {}

    def cluster(**settings: Any) -> Any:
        given.update(settings)
        raise KeyboardInterrupt

    monkeypatch.setattr(distributed, "LocalCluster", cluster)
    with pytest.raises(KeyboardInterrupt), dask_client(Engine(workers=1)):
        pass
    assert given["host"] == "127.0.0.1" and given["dashboard_address"] is None


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_dask_works_in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its usual one has one name for all users of the machine, is searched for modules, and its locks are truncated."""
    (tmp_path / "letter.txt").write_text("mine")
    usual = tmp_path / "dask-scratch-space"
    usual.mkdir()
    for name in ("global.lock", "purge.lock"):
        (usual / name).symlink_to(tmp_path / "letter.txt")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with dask_client(Engine(workers=1)) as client:
        assert client.submit(abs, -1).result(timeout=60) == 1
        (worker,) = client.scheduler_info()["workers"].values()
        assert not Path(worker["local_directory"]).is_relative_to(usual)
    assert (tmp_path / "letter.txt").read_text() == "mine" and len(list(usual.iterdir())) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dask-scratch-space", "letter.txt"]
