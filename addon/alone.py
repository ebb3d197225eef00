"""Operators in an overridden context, while none of our threads runs Python.

`bpy.ops` gives up Python's lock, and Blender then reads the overridden context. In Blender 4.5, with Python 3.11, it takes no lock for that
if any thread runs Python, for it takes that thread for itself, and crashes (`_PyThreadState_UncheckedGet` became a thread's own with 3.12).
So threads wait meanwhile: jobs at the next look whether they were cancelled, finders of proposals when they have answered.
"""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import bpy

from ..core.foundation.progress import Monitor
from .session import get_session

NEEDED = sys.version_info < (3, 12)
LONGEST_S = 1.0  # for which the window waits for a thread: jobs look at least so often


class WaitingMonitor(Monitor):
    """A monitor of a job: whoever asks it whether to stop waits as long as an operator has to be alone."""

    job_thread: threading.Thread | None = None

    @property
    def cancelled(self) -> bool:
        """True once `cancel()` was called."""
        session, thread = get_session(), threading.current_thread()
        if not session.may_run.is_set() and thread is not threading.main_thread():
            if thread is self.job_thread:
                session.job_waits.set()
            session.may_run.wait()
        return super().cancelled


@contextmanager
def alone() -> Iterator[None]:
    """No thread of ours runs Python; a job that does not look within `LONGEST_S` goes on all the same."""
    session = get_session()
    session.job_waits.clear()
    session.may_run.clear()
    try:
        if session.job is not None and session.job.alive:
            session.job_waits.wait(LONGEST_S)
        for finder in session.finders:
            finder.finish(LONGEST_S)
        yield
    finally:
        session.may_run.set()


@contextmanager
def override(**members: Any) -> Iterator[None]:
    """`temp_override` for operators: alone, where Blender needs that."""
    with alone() if NEEDED else nullcontext(), bpy.context.temp_override(**members):
        yield
