"""Many takes on a Dask cluster: worker processes on this machine, or any scheduler by its address.

A take is one task: with many takes, whole takes use the machines better than the frames of each (`workers`), because tracking and the fit
go from frame to frame.

A worker that dies during a take is replaced, and the take resumes from its checkpoints with the same bytes. A take with invalid input does
not stop the others; neither does a bug, whose traceback is written to a file.
"""

import importlib.util
import json
import os
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from ..foundation import store
from ..foundation.bounded import real_path
from ..foundation.errors import InputError, sentence_of
from ..foundation.progress import Monitor
from ..results import blend_file
from ..results.folder import check_inside, check_separate_folder
from ..results.outputs import check_output, check_replaceable
from . import pipeline, take_run
from .engine import Engine, dask_client
from .settings import Overrides

FORMAT, VERSION = "tricap-batch", 1
SUMMARY = "batch.json"
START = f'{{\n "format": "{FORMAT}"'  # of it
TOPIC = "tricap"  # of the workers' progress reports
WAIT_S = 0.3  # interval at which the tasks are polled
REPORT_S = 0.5  # between two progress reports of a worker

Progress = tuple[str, float, float]  # stage, done, total


class Status(StrEnum):
    """How a take ended. The values are those of batch.json."""

    DONE = "done"
    INVALID_INPUT = "needs mending"
    BUG = "bug"
    LOST = "lost"


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """How one take ended. `said`: the run in one line, or the sentence of its error."""

    take: str
    out: str
    status: Status
    said: str
    seconds: float = 0.0


def run_batch(
    takes: Sequence[Path], folder: Path, engine: Engine, overrides: Overrides, monitor: Monitor, *, restart: bool = False
) -> list[Outcome]:
    """Run all takes. FOLDER/NAME gets the results of the take NAME, FOLDER/batch.json the outcome of each; a take whose results have no
    place there is reported, and the others run.

    Raises:
        InputError: batch.json is not of an earlier batch, Dask is not installed, the scheduler cannot be reached, the folder cannot be
            written to or is a take, or no take has a place in it.
        Cancelled: finished work is saved; the same command resumes.
    """
    check_replaceable(Path(folder) / SUMMARY, START)
    outs, refused = out_folders(takes, folder)
    outcomes = {i: Outcome(take=str(takes[i]), out=str(outs[i]), status=Status.INVALID_INPUT, said=said) for i, said in refused.items()}
    _write(folder, engine, takes, outs, outcomes)
    progress: dict[str, Progress] = {}
    with dask_client(engine) as client:
        client.subscribe_topic(TOPIC, lambda event: _store_progress(event, progress))
        plain = {group: dict(table) for group, table in overrides.items()}
        futures = {
            i: client.submit(run_take, str(real_path(take)), str(out), plain, restart, pure=False, retries=engine.retries)
            for i, (take, out) in enumerate(zip(takes, outs))
            if i not in refused
        }
        for i, outcome in _as_completed(futures, takes, outs, progress, monitor):
            outcomes[i] = outcome
            _write(folder, engine, takes, outs, outcomes)
    return [outcomes[i] for i in range(len(takes))]


def out_folders(takes: Sequence[Path], folder: Path) -> tuple[list[Path], dict[int, str]]:
    """The folder of each take's results: named after the take, with its parent folder's name in front where two takes have the same name.
    Names that differ only in capitals are the same, as on the disks of Windows and macOS. Also why some takes cannot have theirs.

    Raises:
        InputError: FOLDER is a take or its footage, or no take can have its results in it.
    """
    folder, takes = real_path(folder), [real_path(take) for take in takes]
    check_separate_folder(folder)
    check_output(folder / SUMMARY)
    same = Counter(take.name.casefold() for take in takes)
    names = [f"{take.parent.name}_{take.name}" if same[take.name.casefold()] > 1 else take.name for take in takes]
    outs, taken, refused = [folder / name for name in names], set[str](), dict[int, str]()
    for i, out in enumerate(outs):
        try:
            if names[i].casefold() in taken:
                raise InputError(f"{takes[i]} is listed twice, or has the name of another take; rename its folder, or leave it out.")
            taken.add(names[i].casefold())
            check_separate_folder(out)
            check_inside(out, folder)
        except InputError as error:
            refused[i] = str(error)
    if len(refused) == len(takes):
        raise InputError(refused[0])
    return outs, refused


def run_take(take: str, out: str, overrides: Overrides, restart: bool) -> dict[str, Any]:
    """The task of a worker: run one take like `tricap run`. Returns an Outcome as a table; the task fails only if the worker dies."""
    began = time.perf_counter()
    try:
        with take_run.open_run(Path(take), Path(out), overrides, restart=restart, spares=True) as job:
            if pipeline.is_complete(job):
                job.record["warnings"] = job.results.read_run().get("warnings", [])
                if not blend_file.is_whole(job.results.path(blend_file.BLEND)):
                    _scene(job)
            else:
                pipeline.all_stages(job, Monitor(_reporter(take)))
                _scene(job)
        status, said = Status.DONE, _summary_of(job)
    except Exception as error:  # the edge of the worker: every error goes into the summary
        status, said = Status.INVALID_INPUT, sentence_of(error) or ""
        if not said:
            path = Path(out).with_name(f"{Path(out).name}_error.txt")
            store.write_text(path, traceback.format_exc())
            status, said = Status.BUG, f"Tricap made a mistake ({type(error).__name__}); please report it with {path}."
    return asdict(Outcome(take=take, out=out, status=status, said=said, seconds=round(time.perf_counter() - began, 1)))


def _summary_of(job: take_run.Run) -> str:
    """The run in one line, with its first warning and the number of further ones."""
    warnings = [*job.notes, *job.record["warnings"]]
    more = f" ({len(warnings) - 1} more in the report)" if len(warnings) > 1 else ""
    return f"{job}. Warning: {warnings[0]}{more}" if warnings else str(job)


def _scene(job: take_run.Run) -> None:
    """Build body.blend in a process of its own, because Blender needs the main thread; nothing without Blender."""
    if importlib.util.find_spec("bpy") is None:
        return
    package = __name__.rpartition(".core.")[0]
    blend = job.results.path(blend_file.BLEND)
    if kept := blend_file.keep_edited(job.results.folder):  # the child's sentences are not read
        job.notes.append(kept)
    line = [sys.executable, "-P", "-m", package, "scene", str(job.results.folder), "--blend", str(blend), "--quiet"]
    done = subprocess.run(line, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": _search_path(package)})
    if done.returncode or not blend.is_file():
        said = done.stderr.strip().splitlines() or ["Blender ended without a message."]
        job.warn(f"No body.blend was written: {said[-1].removeprefix('tricap: ')}")
        job.results.write_run(job.record)


def _search_path(package: str) -> str:
    """PYTHONPATH of a child that runs this very package: its folder, then the user's own entries."""
    root = Path(__file__).absolute().parents[2 + len(package.split("."))]
    return os.pathsep.join([str(root), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))])


def _reporter(take: str) -> Callable[[str, float, float], None] | None:
    """Report the progress of a take to the client every REPORT_S; None outside of a Dask worker."""
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


def _store_progress(event: tuple[float, Any], progress: dict[str, Progress]) -> None:
    report = event[1]
    progress[report["take"]] = (report["stage"], report["done"], report["total"])


def _as_completed(
    futures: Mapping[int, Any], takes: Sequence[Path], outs: Sequence[Path], progress: Mapping[str, Progress], monitor: Monitor
) -> Iterator[tuple[int, Outcome]]:
    """The index and the outcome of each take as soon as it has ended."""
    waiting, reported = dict(futures), dict[str, Progress]()
    while waiting:
        ended = [i for i, future in waiting.items() if future.done()]
        for i in ended:
            yield i, _outcome(waiting.pop(i), takes[i], outs[i])
        for take, state in list(progress.items()):
            if reported.get(take) != state:
                reported[take] = state
                monitor.step(f"{Path(take).name}: {state[0]}", *state[1:])
        monitor.step("takes", len(futures) - len(waiting), len(futures))
        if waiting and not ended:
            time.sleep(WAIT_S)


def _outcome(future: Any, take: Path, out: Path) -> Outcome:
    if future.status == "finished":
        table = future.result()
        return Outcome(**{**table, "status": Status(table["status"])})
    error = future.exception()
    said = f"Its worker died repeatedly ({type(error).__name__}): check that it has enough memory and that every worker has Tricap."
    return Outcome(take=str(take), out=str(out), status=Status.LOST, said=said)


def _write(folder: Path, engine: Engine, takes: Sequence[Path], outs: Sequence[Path], outcomes: Mapping[int, Outcome]) -> None:
    waiting = [asdict(outcomes[i]) if i in outcomes else {"take": str(takes[i]), "out": str(outs[i]), "status": "waiting"}
               for i in range(len(takes))]  # fmt: skip
    where = {"scheduler": engine.scheduler} if engine.scheduler else {"workers": engine.workers}
    store.write_json(Path(folder) / SUMMARY, {"format": FORMAT, "version": VERSION, **where, "takes": waiting})


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """A table with a line for each take, and the number of takes by status."""
    names = [
        "".join(c if c.isprintable() else ascii(c)[1:-1] for c in Path(o.out).name) for o in outcomes
    ]  # a line break would forge a row
    width = max(map(len, names))
    lines = [f"{name:<{width}}  {o.status:<13}  {o.seconds:8.1f} s  {o.said}" for name, o in zip(names, outcomes)]
    counts = {status: sum(o.status == status for o in outcomes) for status in Status}
    return [*lines, f"{len(outcomes)} takes: " + ", ".join(f"{n} {status}" for status, n in counts.items() if n)]


def as_json(outcomes: Sequence[Outcome]) -> str:
    """The outcomes as JSON."""
    return json.dumps([asdict(o) for o in outcomes], indent=1, ensure_ascii=False)
