"""Waiting for what happens, never for a time: a busy machine is slower, not wrong."""

import threading
import time
from collections.abc import Callable

import pytest

from tricap.core.foundation.progress import Cancelled, Monitor

PATIENCE_S = 300.0  # after which something does not happen any more


def wait_until(happened: Callable[[], object]) -> None:
    """Return as soon as `happened()` is true."""
    began = time.monotonic()
    while not happened():
        assert time.monotonic() - began < PATIENCE_S, "it does not happen"
        time.sleep(0.002)


def when(happened: Callable[[], object], act: Callable[[], object]) -> threading.Thread:
    """A thread that acts as soon as `happened()` is true; it is running when this returns."""

    def watch() -> None:
        wait_until(happened)
        act()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


def seconds_to_cancel(compute: Callable[[Monitor], object]) -> float:
    """Cancel a computation from another thread after its first step; the seconds of the processor from there until it has stopped."""
    at_work, pressed = threading.Event(), list[float]()
    monitor = Monitor(lambda *_: at_work.set())

    def press() -> None:
        pressed.append(time.process_time())
        monitor.cancel()

    thread = when(at_work.is_set, press)
    with pytest.raises(Cancelled):
        while thread.is_alive() or monitor.cancelled:
            compute(monitor)
    thread.join()
    return time.process_time() - pressed[0]
