"""A pose network in a process of its own, whose memory and time are limited: `cli.network_guest`."""

import queue
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation import bounded
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..networks.onnx_file import input_shape, read_onnx
from ..networks.pose_network import PoseNetwork
from .engine import python_command

GUEST = "core.cli.network_guest"  # the module that runs a network
OVER_TIME = int(getattr(signal, "SIGXCPU", 0)) or 1 << 20  # how it ends where it computes too long; Windows has no such limit
LOOK_S, LONGEST_S = 0.2, 300.0  # between two looks at the process, and the longest time of one run


@contextmanager
def open_network(path: Path, monitor: Monitor) -> Iterator[PoseNetwork]:
    """A network that runs in another process as long as the block lasts: OpenCV crashes on some damaged files, and a small file can ask for
    any amount of memory and time, also for some images only.

    Raises:
        InputError: it cannot be read or run, or its layout is not known; also when it is used.
        Cancelled: the user asked to stop; also when it is used.
    """
    data = read_onnx(path)
    input_shape(data, path)
    monitor.check()
    guest = _Guest(path, monitor)
    try:
        description = guest.asked(len(data).to_bytes(8, "little") + data)
        yield PoseNetwork.described(description, lambda blob: np.array(guest.asked(blob.astype("<f4").tobytes())["points"]))
    finally:
        guest.end()


class _Guest:
    """The process. What is written to it and what it answers pass through threads, so that a look at the monitor never waits."""

    def __init__(self, path: Path, monitor: Monitor) -> None:
        command, environment = python_command(GUEST)
        pipe = subprocess.PIPE
        self._process = subprocess.Popen([*command, str(path)], env=environment, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL)
        self._path, self._monitor = path, monitor
        self._questions: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._write, self._read)]
        for thread in self._threads:
            thread.start()

    def asked(self, question: bytes) -> dict[str, Any]:
        """The answer to a question.

        Raises:
            InputError: the process ended instead, or answered with an error.
            Cancelled: the user asked to stop.
        """
        self._questions.put(question)
        for _ in range(round(LONGEST_S / LOOK_S)):
            try:
                line = self._answers.get(timeout=LOOK_S)
                break
            except queue.Empty:
                self._monitor.check()
        else:
            raise InputError(f"OpenCV needs more than {LONGEST_S / 60:.0f} minutes for one run of {self._path}; use a smaller network.")
        if not line:
            raise self._reason()
        answer: dict[str, Any] = bounded.json_of(line)
        if "error" in answer:
            raise InputError(str(answer["error"]))
        return answer

    def _reason(self) -> InputError:
        """Why the process ended."""
        if self._process.wait() == -OVER_TIME:
            return InputError(f"{self._path} computes longer than a network of its size does; use another.")
        return InputError(f"OpenCV crashes when it runs {self._path}; the file is damaged, or of a kind that OpenCV does not know.")

    def end(self) -> None:
        """End the process and the threads."""
        self._process.kill()
        self._process.wait()
        self._questions.put(None)
        for thread in self._threads:
            thread.join()

    def _write(self) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        try:
            with pipe:
                while (question := self._questions.get()) is not None:
                    pipe.write(question)
                    pipe.flush()
        except OSError:  # it has ended; the other thread tells
            return

    def _read(self) -> None:
        """Every line of its answers, and an empty one at their end."""
        pipe = self._process.stdout
        assert pipe is not None
        with pipe:
            for line in pipe:
                self._answers.put(line)
        self._answers.put(b"")
