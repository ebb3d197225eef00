"""Progress and cancellation: one object, passed to every function that can take longer than 0.2 s."""

import threading
import time
from collections.abc import Callable, Sequence

SKIPPED = 0.1  # of the expected time: progress that took less was read from checkpoints, and says nothing of the pace
TOGETHER_S = 1.0  # expected seconds that are judged together: several frames may be done at once, after a wait
ENOUGH = 0.1  # of all work, after which the time left is estimated


class Cancelled(Exception):
    """The user asked to stop. Finished results are kept; the message lists them."""


class Monitor:
    """Reports the progress of a stage, and raises `Cancelled` once somebody has asked to stop.

    `report(stage, done, total)` is called from the thread that computes; `cancel()` may be called from any thread.
    """

    def __init__(self, report: Callable[[str, float, float], None] | None = None) -> None:
        self.report = report
        self._cancel = threading.Event()
        self.task = ""  # the name of what is computed now, for machines
        self.course: Course | None = None  # of all tasks, where it is known

    def begin(self, task: str) -> None:
        """Name the task, such as a stage of a run, to which the next steps belong."""
        self.task = task

    def step(self, stage: str, done: float, total: float) -> None:
        """Report that `done` of `total` parts of `stage` are finished.

        Raises:
            Cancelled: `cancel()` was called.
        """
        if self.cancelled:
            raise Cancelled(f"Stopped during {stage}, {done:g} of {total:g} done.")
        if self.course is not None:
            self.course.step(stage, done, total)
        if self.report is not None:
            self.report(stage, done, total)

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


class Course:
    """The progress of a computation of several phases as one fraction, and the time left.

    The phases are weighted by the seconds that they usually take; the pace is that of this computation.
    """

    def __init__(self, phases: Sequence[tuple[str, float]], clock: Callable[[], float] = time.monotonic) -> None:
        """`phases`: names, as in `Monitor.step`, and seconds, in the order in which they follow each other."""
        self._index = {name: i for i, (name, _) in enumerate(phases)}
        self._seconds = [seconds for _, seconds in phases]
        self._clock, self._now, self._phase = clock, clock(), 0
        self._position = self._work = self._time = 0.0  # expected seconds that are done, those that were computed, and what they took
        self._gained = self._took = 0.0  # of the progress that was not judged yet

    def step(self, phase: str, done: float, total: float) -> None:
        """Note the progress of a phase; unknown ones, and those that are over, change nothing."""
        i = self._index.get(phase, -1)
        if i < self._phase:
            return
        part = min(1.0, done / total) if total else 1.0
        gained = sum(self._seconds[:i]) + part * self._seconds[i] - self._position
        self._phase = i
        if gained <= 0:
            return
        now = self._clock()
        self._gained, self._took = self._gained + gained, self._took + now - self._now
        self._position, self._now = self._position + gained, now
        if self._gained >= TOGETHER_S or self._position >= sum(self._seconds):
            if self._took > SKIPPED * self._gained:
                self._work, self._time = self._work + self._gained, self._time + self._took
            self._gained = self._took = 0.0

    @property
    def fraction(self) -> float:
        """How much is done, 0…1."""
        return self._position / max(sum(self._seconds), 1e-9)

    @property
    def seconds_left(self) -> float | None:
        """The time left; None as long as too little was computed for an estimate."""
        left = sum(self._seconds) - self._position
        if not self._work or self._work < ENOUGH * (self._work + left):
            return None
        return max(0.0, self._time / self._work * left - (self._clock() - self._now))


def time_text(seconds: float) -> str:
    """A time left: "40 s", "3 min", "1 h 20 min"."""
    whole = max(0, round(seconds))
    if whole < 90:
        return f"{whole} s"
    minutes = round(whole / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


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
