"""Many takes, each a run of its own, on a Dask cluster: processes on this machine, or any scheduler by its address.

A take is one task. Within a take nothing is handed to other workers: every frame is measured from the depths of the frame before it and
tracked from its points, and the fit looks at all of them, so the frames of one take cannot be done side by side with the same result.

A worker that is lost in mid-take is replaced and the take goes on from its checkpoints, in the same bytes. A take whose input needs mending
does not stop the others; neither does a bug of ours, whose traceback is kept in a file.
"""

import importlib.util
import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from . import pipeline, store
from .errors import InputError
from .progress import Monitor
from .results import check_separate_folder

FORMAT, VERSION = "tricap-batch", 1
TOPIC = "tricap"  # under which workers report
DONE, MEND, BUG, LOST = "done", "needs mending", "bug", "lost"  # what can become of a take
WAIT_S, REPORT_S, CONNECT_S = 0.3, 0.5, 10.0
MISSING = '`tricap batch` needs Dask, which this Python does not have; install it with: pip install "tricap[batch]".'


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """What became of one take. `said`: the run in a line, or the sentence of its error."""

    take: str
    out: str
    status: str
    said: str
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Engine:
    """Where the takes run: at `scheduler`, or in so many processes here; a take that loses its worker is tried `retries` times more."""

    scheduler: str | None = None
    workers: int = 1
    retries: int = 3


def run_batch(
    takes: Sequence[Path], folder: Path, engine: Engine, overrides: pipeline.Overrides, monitor: Monitor, *, restart: bool = False
) -> list[Outcome]:
    """Run all takes; FOLDER/NAME holds the results of the take NAME, FOLDER/batch.json what became of each.

    Raises:
        InputError: Dask is not installed, the scheduler cannot be reached, two takes have one name, or the folder cannot be written to.
        Cancelled: what is done is kept; the same command goes on from there.
    """
    outs = out_folders(takes, folder)
    outcomes: dict[int, Outcome] = {}
    _write(folder, engine, takes, outs, outcomes)
    shown: dict[str, tuple[str, float, float]] = {}
    with _client(engine) as client:
        client.subscribe_topic(TOPIC, lambda event: _note(event, shown))
        plain = {group: dict(table) for group, table in overrides.items()}
        futures = [
            client.submit(run_take, str(take.resolve()), str(out), plain, restart, pure=False, retries=engine.retries)
            for take, out in zip(takes, outs)
        ]
        for i, outcome in _as_they_end(client, futures, takes, outs, shown, monitor):
            outcomes[i] = outcome
            _write(folder, engine, takes, outs, outcomes)
    return [outcomes[i] for i in range(len(takes))]


def out_folders(takes: Sequence[Path], folder: Path) -> list[Path]:
    """The folder of each take's results: named after the take, or after the folder that holds it too where two have the same name.

    Raises:
        InputError: that does not tell them apart, or results would go into a take.
    """
    folder, takes = Path(folder).resolve(), [Path(take).resolve() for take in takes]
    names = [take.name for take in takes]
    names = [f"{take.parent.name}_{take.name}" if names.count(take.name) > 1 else take.name for take in takes]
    twice = next((take for take, name in zip(takes, names) if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"The take {twice} is named twice, or like another one; rename its folder, or leave it out.")
    for out in (folder, *(folder / name for name in names)):
        check_separate_folder(out)
    return [folder / name for name in names]


def run_take(take: str, out: str, overrides: pipeline.Overrides, restart: bool) -> dict[str, Any]:
    """The task of a worker: one take, as `tricap run` does it. Gives an Outcome as a table; only a lost worker is a failed task."""
    began = time.perf_counter()
    try:
        with pipeline.open_run(Path(take), Path(out), overrides, restart=restart) as job:
            pipeline.all_stages(job, Monitor(_reporter(take)))
            _scene(job)
        status, said = DONE, _told(job)
    except InputError as error:
        status, said = MEND, str(error)
    except Exception as error:  # the edge of the worker: whatever happens is told in the summary
        path = Path(out).with_name(f"{Path(out).name}_error.txt")
        store.write_text(path, traceback.format_exc())
        status, said = BUG, f"Tricap made a mistake ({type(error).__name__}); please report it with {path}."
    return asdict(Outcome(take=take, out=out, status=status, said=said, seconds=round(time.perf_counter() - began, 1)))


def _told(job: pipeline.Run) -> str:
    """The run in a line, with what is doubtful about it: the first doubt, and how many more the report has."""
    doubts = job.record["warnings"]
    more = f" ({len(doubts) - 1} more in the report)" if len(doubts) > 1 else ""
    return f"{job}. Doubtful: {doubts[0]}{more}" if doubts else str(job)


def _scene(job: pipeline.Run) -> None:
    """body.blend, by a process of its own, for Blender wants to be in the main thread; without Blender there is none."""
    if importlib.util.find_spec("bpy") is None:
        return
    package = __name__.rpartition(".core.")[0]
    blend = job.results.path("body.blend")
    line = [sys.executable, "-m", package, "scene", str(job.results.folder), "--blend", str(blend), "--quiet"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        job.warn(f"No body.blend was written: {done.stderr.strip().splitlines()[-1].removeprefix('tricap: ')}")
        job.results.write_run(job.record)


def _reporter(take: str) -> Callable[[str, float, float], None] | None:
    """Tell the client how far a take is, about twice a second; None outside of a Dask worker."""
    from distributed import get_worker

    try:
        worker, last = get_worker(), [0.0]
    except ValueError:
        return None

    def report(stage: str, done: float, total: float) -> None:
        if time.monotonic() - last[0] >= REPORT_S:
            last[0] = time.monotonic()
            worker.log_event(TOPIC, {"take": take, "stage": stage, "done": float(done), "total": float(total)})

    return report


def _note(event: tuple[float, Any], shown: dict[str, tuple[str, float, float]]) -> None:
    said = event[1]
    shown[said["take"]] = (said["stage"], said["done"], said["total"])


@contextmanager
def _client(engine: Engine) -> Iterator[Any]:
    """A Dask client; a cluster of our own ends with it."""
    if importlib.util.find_spec("distributed") is None:
        raise InputError(MISSING)
    import dask
    from distributed import Client, LocalCluster

    if engine.scheduler is not None:
        try:
            client = Client(engine.scheduler, timeout=CONNECT_S)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"No Dask scheduler answers at {engine.scheduler}; check the address, or leave --scheduler out.") from error
        with client:
            yield client
        return
    quiet = {"distributed.logging.distributed": "critical", "distributed.scheduler.allowed-failures": engine.retries}
    with (
        dask.config.set(quiet),
        LocalCluster(
            n_workers=engine.workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            memory_limit=0,
            silence_logs=50,
            env=shares(engine.workers, os.cpu_count() or 1),
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def shares(workers: int, cores: int) -> dict[str, str]:
    """The environment of each worker: as many threads, ours and OpenCV's, as there are cores for it."""
    share = str(max(1, min(2, cores // workers)))
    return {"TRICAP_THREADS": share, "OPENCV_FOR_THREADS_NUM": share}


def _as_they_end(
    client: Any,
    futures: Sequence[Any],
    takes: Sequence[Path],
    outs: Sequence[Path],
    shown: Mapping[str, tuple[str, float, float]],
    monitor: Monitor,
) -> Iterator[tuple[int, Outcome]]:
    """Number and outcome of each take as soon as it has ended."""
    waiting, told = dict(enumerate(futures)), dict[str, tuple[str, float, float]]()
    while waiting:
        ended = [i for i, future in waiting.items() if future.done()]
        for i in ended:
            yield i, _outcome(waiting.pop(i), takes[i], outs[i])
        for take, state in list(shown.items()):
            if told.get(take) != state:
                told[take] = state
                monitor.step(f"{Path(take).name}: {state[0]}", *state[1:])
        monitor.step("takes", len(futures) - len(waiting), len(futures))
        if waiting and not ended:
            time.sleep(WAIT_S)


def _outcome(future: Any, take: Path, out: Path) -> Outcome:
    if future.status == "finished":
        return Outcome(**future.result())
    error = future.exception()
    said = f"Its worker was lost, time and again ({type(error).__name__}): is there memory enough, and is Tricap on every worker?"
    return Outcome(take=str(take), out=str(out), status=LOST, said=said)


def _write(folder: Path, engine: Engine, takes: Sequence[Path], outs: Sequence[Path], outcomes: Mapping[int, Outcome]) -> None:
    waiting = [asdict(outcomes[i]) if i in outcomes else {"take": str(takes[i]), "out": str(outs[i]), "status": "waiting"}
               for i in range(len(takes))]  # fmt: skip
    where = {"scheduler": engine.scheduler} if engine.scheduler else {"workers": engine.workers}
    store.write_json(Path(folder) / "batch.json", {"format": FORMAT, "version": VERSION, **where, "takes": waiting})


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """A table: a line for each take, and how many of each kind."""
    width = max(len(Path(o.out).name) for o in outcomes)
    lines = [f"{Path(o.out).name:<{width}}  {o.status:<13}  {o.seconds:8.1f} s  {o.said}" for o in outcomes]
    counts = {status: sum(o.status == status for o in outcomes) for status in (DONE, MEND, BUG, LOST)}
    return [*lines, f"{len(outcomes)} takes: " + ", ".join(f"{n} {status}" for status, n in counts.items() if n)]


def as_json(outcomes: Sequence[Outcome]) -> str:
    """The outcomes for machines."""
    return json.dumps([asdict(o) for o in outcomes], indent=1, ensure_ascii=False)
