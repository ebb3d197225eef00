"""Long computations: one job, two drivers.

A job is a function of a `Monitor` that is independent of Blender. `Job.run()` computes it at once (scripts, background); `Job.start()`
computes it on a worker thread while a modal operator watches. Whatever ends the session (Esc, another file, quitting, disabling the
add-on) cancels the job AND waits for its thread.

`JobOperator` gives an operator these moves: `snapshot` (main thread: read what is needed from Blender) → the function it returns
(any thread, no bpy) → `in_steps` (main thread, step by step between redraws: what needs Blender and takes long) → `finish` (main thread:
write the result into the scene).
"""

import atexit
import logging
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import bpy

from ..core.fitting.inputs.start_joints import NeedsClick
from ..core.foundation.errors import InputError, sentence_of, with_notes
from ..core.foundation.progress import Cancelled, Monitor, time_text
from ..core.foundation.threads import one_thread_in_linear_algebra
from .alone import WaitingMonitor
from .panels import check_own, show_status
from .session import get_session

log = logging.getLogger(__name__)

TICK_S = 0.1  # between two looks at a job
STEPS_S = 0.08  # of steps on the main thread, before the window has its turn
SHOW_S = 0.25  # between two drawings of its progress: on a busy machine drawing takes the most time
PACE_S, PACE_PARTS = 20.0, 200  # the time left is estimated from the pace of the last seconds, or parts
ENOUGH = 0.05  # of a stage, or one of its parts, before the time left is estimated
SWITCH_S = 0.0005  # after which the worker hands the interpreter to the window: redrawn after 30…90 ms at worst; with Python's 5 ms 130 ms
BUG = "Internal error in Tricap ({error}). Please report it with the text in the system console."


class Job:
    """One computation with its progress, and afterwards its `result` or `error` (with `trace`, the traceback as text)."""

    def __init__(self, compute: Callable[[Monitor], Any], steps: Mapping[str, str] | None = None, first_step: str = "") -> None:
        self._compute, self._steps, self._first_step = compute, steps or {}, first_step
        self._thread: threading.Thread | None = None
        self.monitor = WaitingMonitor(self._note)
        self.stage, self.done, self.total = "", 0.0, 0.0
        self._pace: deque[tuple[float, float]] = deque(maxlen=PACE_PARTS)  # time, and fraction of the current stage
        self._steps_left: Generator[None, None, Any] | None = None
        self.result: Any = None
        self.error: BaseException | None = None
        self.trace = ""

    def advance(self, steps: Callable[[], Generator[None, None, Any]], seconds: float) -> bool:
        """Take some of the `steps` that follow the computation, on the main thread; whether they have ended. Never raises: see `error`."""
        until = time.monotonic() + seconds
        try:
            if self._steps_left is None and self.error is None:
                self._steps_left = steps()
            while self._steps_left is not None:
                next(self._steps_left)
                if time.monotonic() > until:
                    return False
        except StopIteration as end:
            self.result = end.value
        except BaseException as error:  # the edge of the steps: the operator reports whatever happens
            self.error, self.trace = error, traceback.format_exc()
        return True

    def leave(self) -> None:
        """Give up the steps that are left."""
        if self._steps_left is not None:
            self._steps_left.close()

    def run(self) -> None:
        """Compute at once; never raises: see `error`."""
        try:
            with one_thread_in_linear_algebra():
                self.result = self._compute(self.monitor)
        except BaseException as error:  # the edge of the thread: the operator reports whatever happens
            self.error, self.trace = error, traceback.format_exc()

    def start(self) -> None:
        """Compute on a worker thread."""
        self._thread = self.monitor.job_thread = threading.Thread(target=self._run_in_thread, name="tricap job", daemon=True)
        self._thread.start()

    def _run_in_thread(self) -> None:
        get_session().may_run.wait()
        before = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            self.run()
        finally:
            sys.setswitchinterval(before)

    @property
    def alive(self) -> bool:
        """True while the worker thread computes."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def fraction(self) -> float:
        """The fraction that is done, 0…1: of all stages of a run, or else of the current one."""
        if self.monitor.course is not None:
            return self.monitor.course.fraction
        return min(max(self.done / self.total, 0.0), 1.0) if self.total > 0 else 0.0

    def cancel_and_join(self) -> None:
        """Ask to stop and wait until the thread has stopped."""
        self.monitor.cancel()
        if self._thread is not None:
            self._thread.join()

    @property
    def seconds_left(self) -> float | None:
        """Until the end of the run; of other jobs until the end of the current stage, at its recent pace; None as long as too little is
        done for an estimate, and when that time has passed."""
        if self.monitor.course is not None:
            return self.monitor.course.seconds_left or None
        pace = list(self._pace)
        if len(pace) < 2 or pace[-1][1] - pace[0][1] < min(ENOUGH, 1.0 / max(self.total, 1.0)):
            return None
        (since, before), (last, now) = pace[0], pace[-1]
        left = (last - since) / (now - before) * (1.0 - now) - (time.monotonic() - last)
        return left if left > 0 else None

    @property
    def stage_text(self) -> str:
        """What is computed now, for people."""
        return "Stopping" if self.monitor.cancelled else self.stage or "Starting"

    @property
    def left_text(self) -> str:
        """The time left in the current stage, "" without an estimate."""
        left = self.seconds_left
        return "" if left is None or self.monitor.cancelled else f"{time_text(left)} left"

    @property
    def step(self) -> str:
        """The step of the panel to which the monitor's task belongs."""
        return self._steps.get(self.monitor.task, self._first_step)

    def _note(self, stage: str, done: float, total: float) -> None:
        if stage != self.stage:
            self._pace.clear()
        self.stage, self.done, self.total = stage, done, total
        now = time.monotonic()
        if not self._pace or self.fraction > self._pace[-1][1]:
            self._pace.append((now, self.fraction))
        while len(self._pace) > 2 and self._pace[0][0] < now - PACE_S:
            self._pace.popleft()


class JobState(bpy.types.PropertyGroup):
    """What the panel shows of the running job. Read-only: setting a property would redraw the whole window, including the 3-D view."""

    running: bpy.props.BoolProperty(name="Running", get=lambda _: _watched() is not None)  # type: ignore[valid-type]
    blocks: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Blocks", get=lambda _: _watched() is not None and not get_session().job_operator.gives_way
    )
    progress: bpy.props.FloatProperty(
        name="Progress",
        min=0.0,
        max=1.0,  # type: ignore[valid-type]
        get=lambda _: job.fraction if (job := _watched()) else 0.0,
    )
    stage: bpy.props.StringProperty(name="Stage", get=lambda _: job.stage_text if (job := _watched()) else "")  # type: ignore[valid-type]
    left: bpy.props.StringProperty(name="Time Left", get=lambda _: job.left_text if (job := _watched()) else "")  # type: ignore[valid-type]
    step: bpy.props.StringProperty(name="Step", get=lambda _: job.step if (job := _watched()) else "")  # type: ignore[valid-type]


JobEnded = Callable[[bpy.types.Context, str, str, str], None]  # the step, the error or "", the message of the stop or ""


def _watched() -> Job | None:
    """The job that a modal operator watches."""
    operator = get_session().job_operator
    return operator.job if operator is not None else None


def stop_current(*_: Any) -> None:
    """Cancel the running job and wait for it; the operator that watches it then ends."""
    session = get_session()
    if session.job is not None:
        session.job.cancel_and_join()
    session.job = None


def stop_watching() -> None:
    """Remove the timer and the progress of an operator whose class is about to be unregistered."""
    operator = get_session().job_operator
    if operator is not None:
        operator.clear(bpy.context)


@bpy.app.handlers.persistent
def _stop_before_load(*_: Any) -> None:
    stop_current()


class JobOperator:
    """Mix-in for operators: `execute` computes here and now, `invoke` on a worker thread with progress and Esc."""

    job: Job
    timer: Any = None
    shown: tuple[str, float] = ("", 0.0)  # the text in the status bar, and since when
    step: ClassVar[str] = ""  # of the panel, with which the job begins
    steps: ClassVar[Mapping[str, str]] = MappingProxyType({})  # of the panel, by the monitor's task
    if_stopped: ClassVar[str] = ""  # a sentence for those who stop it
    gives_way: ClassVar[bool] = False  # it is stopped when another job is begun
    gave_way = False

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], Any]:
        """Main thread: read everything from Blender and return the computation."""
        raise NotImplementedError

    def in_steps(self, context: bpy.types.Context, result: Any, monitor: Monitor) -> Generator[None, None, Any]:
        """Main thread: what else is needed from Blender, with a `yield` after each step; returns the result."""
        return result
        yield

    def finish(self, context: bpy.types.Context, result: Any) -> set[str]:
        """Main thread: write the result to the scene; returns the operator's result."""
        raise NotImplementedError

    def after_error(self, context: bpy.types.Context) -> None:
        """Main thread: show what there is after an error; nothing by itself."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Blocking driver, for scripts and background."""
        job = self._prepare(context)
        if job is None:
            return {"CANCELLED"}
        job.run()
        job.advance(lambda: self.in_steps(context, job.result, job.monitor), float("inf"))
        return self._conclude(context, job, asked="ERROR")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event | None) -> set[str]:
        """Modal driver: start the thread and watch it."""
        session = get_session()
        if session.job is not None and session.job_operator is not None and session.job_operator.gives_way:
            session.job_operator.gave_way = True
            stop_current()
            stop_watching()
        if session.job is not None:
            self.report({"ERROR"}, "Another Tricap job is running. Wait for it, or press Esc.")  # type: ignore[attr-defined]
            return {"CANCELLED"}
        job = self._prepare(context)
        if job is None:
            return {"CANCELLED"}
        self.job = job
        session.job, session.job_operator = job, self
        wm = context.window_manager
        self.timer = wm.event_timer_add(TICK_S, window=context.window)
        wm.modal_handler_add(self)
        job.start()
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the progress; Esc cancels, and the window stays responsive until the thread has stopped."""
        if self.gave_way:
            return {"CANCELLED"}
        if event.type == "ESC" and event.value == "PRESS":
            self.job.monitor.cancel()
        elif event.type != "TIMER":
            return {"PASS_THROUGH"}
        if self.job.alive or not self.job.advance(lambda: self.in_steps(context, self.job.result, self.job.monitor), STEPS_S):
            self._show(context)
            return {"RUNNING_MODAL" if event.type == "ESC" else "PASS_THROUGH"}
        self.clear(context)
        return self._conclude(context, self.job, asked="WARNING")

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator (another file, quitting)."""
        self.job.cancel_and_join()
        self.job.leave()
        self.clear(context)

    def _prepare(self, context: bpy.types.Context) -> Job | None:
        try:
            check_own(context.scene)
            return Job(self.snapshot(context), self.steps, self.step)
        except Exception as error:  # the edge of the operator: faults of the input and of the system are told, bugs are raised
            reason = sentence_of(error)
            if reason is None:
                raise
            self.report({"ERROR"}, reason)  # type: ignore[attr-defined]
            return None

    def _conclude(self, context: bpy.types.Context, job: Job, asked: str) -> set[str]:
        """`asked`: how a question is reported: to scripts as an error; the window has a button for it, which an error would cover."""
        error, ended = job.error, {"CANCELLED"}
        if error is None:
            try:
                ended = self.finish(context, job.result)
            except InputError as mistake:
                error = mistake
            except Exception as bug:  # the edge of the job: whatever happens is reported, and the panel learns that the job has ended
                error, job.trace = bug, traceback.format_exc()
        if error is not None:
            self.after_error(context)
            self._report_error(job, error, asked)
        stopped = str(error) if isinstance(error, Cancelled) else ""
        failed = "" if error is None or isinstance(error, (Cancelled, KeyboardInterrupt)) else _message(error)
        for listener in get_session().on_job_end:
            listener(context, job.step, failed, stopped, error)
        return ended

    def _report_error(self, job: Job, error: BaseException, asked: str) -> None:
        if (reason := sentence_of(error)) is not None:
            self.report({asked if isinstance(error, NeedsClick) else "ERROR"}, reason)  # type: ignore[attr-defined]
        elif isinstance(error, (Cancelled, KeyboardInterrupt)):
            self.report({"WARNING"}, f"{with_notes(error)} {self.if_stopped}".strip())  # type: ignore[attr-defined]
        else:
            log.error("A Tricap job failed.\n%s", job.trace)
            self.report({"ERROR"}, _message(error))  # type: ignore[attr-defined]

    def _show(self, context: bpy.types.Context) -> None:
        job = self.job
        text = job.stage_text + ("" if job.monitor.cancelled else f" {job.fraction:.0%}  {job.left_text}  (Esc stops)")
        before, since = self.shown
        if text != before and (job.monitor.cancelled or time.monotonic() - since >= SHOW_S):
            self.shown = text, time.monotonic()
            show_status(context, f"Tricap: {text}")
            redraw(context)

    def clear(self, context: bpy.types.Context) -> None:
        """Remove the timer and the progress."""
        session = get_session()
        session.job_operator = None
        wm = context.window_manager
        if self.timer is not None:
            wm.event_timer_remove(self.timer)
            self.timer = None
        if session.job is self.job:
            session.job = None
        show_status(context, None)
        redraw(context)


def _message(error: BaseException) -> str:
    return sentence_of(error) or BUG.format(error=f"{type(error).__name__}: {error}")


def redraw(context: bpy.types.Context) -> None:
    """Redraw the sidebars with our panels; not the views themselves: a heavy scene would be drawn ten times a second."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "CLIP_EDITOR"):
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()


def register() -> None:
    """Add the state to the WindowManager and stop jobs before another file is loaded and at the end."""
    bpy.utils.register_class(JobState)
    bpy.types.WindowManager.tricap = bpy.props.PointerProperty(type=JobState)
    bpy.app.handlers.load_pre.append(_stop_before_load)
    atexit.register(stop_current)


def unregister() -> None:
    """Stop the running job and unregister everything."""
    stop_current()
    atexit.unregister(stop_current)
    bpy.app.handlers.load_pre.remove(_stop_before_load)
    del bpy.types.WindowManager.tricap
    bpy.utils.unregister_class(JobState)
