"""Where work is done: in processes on this machine, or on a Dask cluster by the address of its scheduler."""

import importlib.util
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ..foundation.errors import InputError

CONNECT_S = 10.0  # timeout of the connection to a scheduler
THREADS_PER_WORKER = 2  # at most: a run gains little from more
RETRIES = 3  # a worker that dies more often than this probably lacks memory
MOST_WORKERS = 8  # unless more are asked for: each needs some 300 MB
MISSING = 'A Dask cluster needs Dask, which this Python does not have; install it with: pip install "tricap[batch]".'


@dataclass(frozen=True, kw_only=True, slots=True)
class Engine:
    """Where work is done: at `scheduler`, or in `workers` local processes. What a dead worker did is done again `retries` times."""

    scheduler: str | None = None
    workers: int = 1
    retries: int = RETRIES


def of_this_machine() -> Engine | None:
    """A worker for every core; None where there is only one."""
    cores = min(os.cpu_count() or 1, MOST_WORKERS)
    return Engine(workers=cores) if cores > 1 else None


@contextmanager
def dask_client(engine: Engine) -> Iterator[Any]:
    """A Dask client; a local cluster ends with it.

    Raises:
        InputError: Dask is not installed, or the scheduler cannot be reached.
    """
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
    settings = {"distributed.logging.distributed": "critical", "distributed.scheduler.allowed-failures": engine.retries}
    with ExitStack() as running:
        try:
            # Else Dask writes to files of fixed names in the folder of all users' temporary files, where others may have put links.
            private = running.enter_context(TemporaryDirectory(prefix="tricap-dask-", ignore_cleanup_errors=True))
            running.enter_context(dask.config.set({**settings, "temporary-directory": private}))
            with _not_interrupted():
                cluster = LocalCluster(
                    n_workers=engine.workers,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address=None,
                    scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # by default one port, which another batch may have
                    memory_limit=0,
                    silence_logs=50,
                    local_directory=private,
                    env=thread_limits(engine.workers, os.cpu_count() or 1),
                )
            running.enter_context(cluster)
            client = running.enter_context(Client(cluster))
        except (OSError, RuntimeError) as error:
            raise InputError(
                f"The worker processes cannot be started ({error}); raise the system's limits of files and processes, or use --workers 1."
            ) from error
        yield client


@contextmanager
def _not_interrupted() -> Iterator[None]:
    """Threads and processes that begin here do not get the Ctrl-C of a terminal: the workers would say so, each with a traceback."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def thread_limits(workers: int, cores: int) -> dict[str, str]:
    """The environment of each worker: the threads of Tricap and OpenCV that its share of the cores allows."""
    threads = str(max(1, min(THREADS_PER_WORKER, cores // workers)))
    return {"TRICAP_THREADS": threads, "OPENCV_FOR_THREADS_NUM": threads}


def python_command(module: str) -> tuple[list[str], dict[str, str]]:
    """The command line of a child process that runs `module` of this very package (such as "core.cli.worker"), and its environment.

    Within Blender the package has another name, and its libraries lie where only Blender looks for them.
    """
    package = Path(__file__).absolute().parents[2]
    search = os.pathsep.join([str(package.parent), *filter(None, sys.path)])
    return [sys.executable, "-P", "-m", f"{package.name}.{module}"], os.environ | {"PYTHONPATH": search}
