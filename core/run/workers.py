"""The frames of one take on several processes: the starts of all frames one after the other, and meanwhile the frames that have theirs.

A frame's surface depends on its start alone (surface/starts.py), and workers leave what they measured as checkpoints, so the result has the
same bytes for any number of workers, and a stopped run resumes.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from ..foundation import bounded
from ..foundation.errors import InputError
from ..foundation.progress import Cancelled, Monitor
from ..foundation.settings import from_table, to_table
from ..results.folder import Results
from ..surface.measure import measure_frames, measure_piece
from ..surface.resolution import measured_footage
from ..surface.starts import FrameStarts, MeasureSettings
from ..take.footage import Footage, open_take
from ..take.take import read_take
from .engine import Engine, dask_client, python_command, thread_limits
from .settings import SETTINGS
from .take_run import Run, only_frames

PIECE = 4  # frames of a task
WAIT_S = 0.2  # between two looks at the workers
OWN_GROUP: dict[str, Any] = {"process_group": 0}  # of a worker: the Ctrl-C of a terminal does not reach it; we end it
if sys.platform == "win32":
    OWN_GROUP = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
FEWEST = 12  # frames to be measured; for fewer, local processes take longer to start than they gain
Task = dict[str, Any]  # plain values: it travels as JSON


def measure_at_once(run: Run, engine: Engine, monitor: Monitor, kept: set[int]) -> None:
    """Measure the frames of a run by workers, as far as they have no checkpoints. Nothing where frames depend on each other. If it is
    stopped, those that have one are added to `kept`.

    Raises:
        InputError: the images cannot be read, workers keep dying, or Dask cannot be used.
        NothingMeasured: see `measure_frames`.
        Cancelled: the frames measured so far have their checkpoints.
    """
    settings, footage = MeasureSettings.of(run.settings), run.measured_footage
    if engine.scheduler is None and len(footage.frames) < FEWEST:
        return
    starts = FrameStarts(footage, settings, run.results, run.begin)
    if not starts.alone:
        return
    steps = 1 + len(starts.order)
    first = measure_frames(footage, settings, run.results, monitor.part("seeds", 0, steps), run.begin)
    next(first)  # fails early where nothing can be measured
    waiting, least, keys = list[tuple[int, str]](), FEWEST if engine.scheduler is None else 1, dict[int, str]()
    try:
        with _running(engine) as submit:
            work = list[Any]()
            for done, frame in enumerate(starts.order):
                key = keys[frame] = starts.at(frame, monitor.part("seeds", 1 + done, steps))[0].key
                if run.results.load_checkpoint("surface", f"{frame:04d}", key) is None:
                    waiting.append((frame, key))
                if len(waiting) >= least:
                    least = PIECE
                    while len(waiting) >= PIECE:  # always the same frames, whatever the number of workers
                        work.append(submit(_task(run, dict(waiting[:PIECE]))))
                        del waiting[:PIECE]
            if waiting and least == PIECE:
                work.append(submit(_task(run, dict(waiting))))
            for finished in _finished(work):
                monitor.step("surface", finished, len(work))
    except Cancelled:
        kept.update(frame for frame, key in keys.items() if run.results.has_checkpoint("surface", f"{frame:04d}", key))
        raise


class Pieces:
    """Measures the frames of one task after the other. The footage stays open from task to task: a movie is decoded from its beginning."""

    def __init__(self) -> None:
        self._opened: tuple[Any, Footage] | None = None

    def run(self, task: Task) -> None:
        """The task of a worker: measure its frames.

        Raises:
            InputError: see `measure_piece`.
        """
        settings: dict[str, Any] = {name: from_table(kind, task["settings"][name], f"[{name}]") for name, kind in SETTINGS.items()}
        same = [task[name] for name in ("take", "frames", "delay_images", "reduced_for_m", "settings")]
        if self._opened is None or self._opened[0] != same:
            self._opened = same, _opened(task, settings)
        keys = {int(frame): key for frame, key in task["keys"].items()}
        measure_piece(self._opened[1], MeasureSettings.of(settings), Results(Path(task["out"])), keys, Monitor())


def run_piece(task: Task) -> None:
    """A single task; see `Pieces.run`."""
    Pieces().run(task)


def _opened(task: Task, settings: Mapping[str, Any]) -> Footage:
    take = read_take(Path(task["take"]))
    footage = only_frames(open_take(take, click_sigma_px=settings["fitting"].click_sigma_px), (task["frames"][0], task["frames"][1]))
    footage = replace(footage, delay_images=tuple(task["delay_images"]))
    return measured_footage(footage, MeasureSettings.of(settings), task["reduced_for_m"])


def _task(run: Run, keys: Mapping[int, str]) -> Task:
    frames = run.footage.frames
    return {
        "take": str(bounded.real_path(run.footage.take.folder)),
        "out": str(run.results.folder),
        "frames": [frames.start, frames.stop],
        "delay_images": list(run.footage.delay_images),
        "reduced_for_m": run.reduced_for_m,
        "settings": {name: to_table(value) for name, value in run.settings.items()},
        "keys": {str(frame): key for frame, key in keys.items()},
    }


@contextmanager
def _running(engine: Engine) -> Iterator[Callable[[Task], Any]]:
    """A function that hands a task to the workers and gives its future. Leaving stops the workers."""
    futures = list[Any]()
    if engine.scheduler is not None:
        with dask_client(engine) as client:

            def send(task: Task) -> Any:
                futures.append(client.submit(run_piece, task, pure=False, retries=engine.retries))
                return futures[-1]

            try:
                yield send
            finally:
                client.cancel(futures)
        return
    workers, idle = [_Worker(engine) for _ in range(engine.workers)], SimpleQueue[_Worker]()
    for worker in workers:
        idle.put(worker)

    def run(task: Task) -> None:
        worker = idle.get()
        try:
            worker.run(task)
        finally:
            idle.put(worker)

    with ThreadPoolExecutor(len(workers)) as pool:

        def start(task: Task) -> Any:
            futures.append(pool.submit(run, task))
            return futures[-1]

        try:
            yield start
        finally:
            for future in futures:
                future.cancel()
            for worker in workers:
                worker.stop()


def _finished(futures: Sequence[Any]) -> Iterator[int]:
    """How many of the futures are finished, again and again until all are; raises what a worker raised."""
    while True:
        done = [future for future in futures if future.done()]
        for future in done:
            future.result()
        yield len(done)
        if len(done) == len(futures):
            return
        time.sleep(WAIT_S)


class _Worker:
    """A local process that does one task after the other (cli/worker.py); it is started with the first."""

    def __init__(self, engine: Engine) -> None:
        self._retries, self._stopped = engine.retries, False
        self._command, environment = python_command("core.cli.worker")
        self._environment = environment | thread_limits(engine.workers, os.cpu_count() or 1) | {"OPENBLAS_NUM_THREADS": "1"}
        self._process: subprocess.Popen[str] | None = None

    def run(self, task: Task) -> None:
        """Do a task, again if the process dies.

        Raises:
            InputError: what the task raised, or the process died too often.
        """
        for _ in range(self._retries + 1):
            answer = self._ask(json.dumps(task))
            if answer or self._stopped:
                break
            self._process = None
        if not answer:
            raise InputError(f"A worker process died {self._retries + 1} times: is there enough memory? Use fewer --workers.")
        if error := bounded.json_of(answer).get("error"):
            raise InputError(error)

    def stop(self) -> None:
        """End the process; what it measured is kept."""
        self._stopped = True
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def _ask(self, line: str) -> str:
        """The answer of the process; empty if it died."""
        if self._process is None:
            pipe = subprocess.PIPE
            self._process = subprocess.Popen(
                self._command, env=self._environment, text=True, encoding="utf-8", stdin=pipe, stdout=pipe, **OWN_GROUP
            )
            if self._stopped:  # meanwhile: `stop` may not have seen the process
                self._process.kill()
        try:
            assert self._process.stdin is not None and self._process.stdout is not None
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
            return self._process.stdout.readline()
        except (BrokenPipeError, ValueError):  # it died, or was stopped
            return ""
