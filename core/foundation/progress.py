"""Progress and cancellation: one object, passed to every function that can take longer than 0.2 s."""

import threading
from collections.abc import Callable


class Cancelled(Exception):
    """The user asked to stop. Finished results are kept; the message lists them."""


class Monitor:
    """Reports the progress of a stage, and raises `Cancelled` once somebody has asked to stop.

    `report(stage, done, total)` is called from the thread that computes; `cancel()` may be called from any thread.
    """

    def __init__(self, report: Callable[[str, float, float], None] | None = None) -> None:
        self._report = report
        self._cancel = threading.Event()
        self.task = ""  # the name of what is computed now, for machines

    def begin(self, task: str) -> None:
        """Name the task, such as a stage of a run, to which the next steps belong."""
        self.task = task

    def step(self, stage: str, done: float, total: float) -> None:
        """Report that `done` of `total` parts of `stage` are finished.

        Raises:
            Cancelled: `cancel()` was called.
        """
        if self._cancel.is_set():
            raise Cancelled(f"Stopped during {stage}, {done:g} of {total:g} done.")
        if self._report is not None:
            self._report(stage, done, total)

    def check(self) -> None:
        """Raise if somebody has asked to stop, without a report; for loops within a step.

        Raises:
            Cancelled: `cancel()` was called.
        """
        if self.cancelled:
            raise Cancelled("Stopped.")

    def part(self, stage: str, index: int, total: int) -> "Monitor":
        """A monitor for part `index` of `total`: its progress is a fraction of that part, and it is cancelled with this one."""
        return _Part(self, stage, index, total)

    def cancel(self) -> None:
        """Ask the computation to stop at its next step."""
        self._cancel.set()

    @property
    def cancelled(self) -> bool:
        """True once `cancel()` was called."""
        return self._cancel.is_set()


class _Part(Monitor):
    def __init__(self, whole: Monitor, stage: str, index: int, total: int) -> None:
        super().__init__()
        self._whole, self._stage, self._index, self._total, self._reached = whole, stage, index, total, 0.0

    def step(self, stage: str, done: float, total: float) -> None:
        self._reached = max(self._reached, min(1.0, done / total if total else 1.0))  # the steps of a part may start again
        self._whole.step(self._stage, self._index + self._reached, self._total)

    def cancel(self) -> None:
        self._whole.cancel()

    @property
    def cancelled(self) -> bool:
        return self._whole.cancelled
