"""The `tricap` command, for a terminal and for `blender --command tricap`. __main__.py adds the commands that need Blender.

Exit codes: 0 done, 2 invalid input (one sentence on stderr), 130 cancelled (finished work is saved), 1 a bug (with a traceback).
"""

import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from threadpoolctl import threadpool_limits

from ..foundation.errors import InputError, sentence_of, with_notes
from ..foundation.progress import Cancelled, Monitor, time_text
from . import streams
from .arguments import check_outputs, with_joined_frames
from .parser import Adder, build_parser


def main(argv: list[str] | None = None, adders: tuple[Adder, ...] = ()) -> int:
    """Run one command of the core, or one that `adders` add; returns the exit code."""
    with streams.robust():
        return _run(argv, adders)


def _run(argv: list[str] | None, adders: tuple[Adder, ...]) -> int:
    parser = build_parser(adders)
    try:
        args = parser.parse_args(with_joined_frames(sys.argv[1:] if argv is None else argv))
    except InputError as error:  # of the help text, which cannot be written
        streams.write_line(f"tricap: {error}", sys.stderr)
        return 2
    args.parser = parser
    import cv2

    _prepare_libraries()
    monitor = Monitor()
    if not args.quiet:
        monitor.report = _progress_line(monitor) if sys.stderr.isatty() else _plain_progress(monitor)
    try:
        check_outputs(args)
        with _interrupts(monitor), threadpool_limits(1, user_api="blas"), warnings.catch_warnings():  # BLAS that Blender has loaded
            warnings.simplefilter("ignore", RuntimeWarning)  # numpy's, of numbers in damaged files: the sentence says what is wrong
            lines = args.run(args, monitor)
        for line in lines if not args.quiet or getattr(args, "json", False) else getattr(args, "always_shown", []):
            streams.write_line(line, sys.stdout)
    except Cancelled as stop:
        streams.write_line(f"tricap: {with_notes(stop)}", sys.stderr)
        return 130
    except (InputError, OSError, MemoryError, ImportError, RuntimeError, cv2.error) as error:
        reason = sentence_of(error)
        if reason is None:
            raise
        streams.write_line(f"tricap: {reason}", sys.stderr)
        return 2
    return int(getattr(args, "exit_code", 0))


@contextmanager
def _interrupts(monitor: Monitor) -> Iterator[None]:
    """Ctrl-C cancels at the next step; a second Ctrl-C interrupts at once."""
    try:
        before = signal.getsignal(signal.SIGINT)
        if before is None:  # set outside Python, as Blender does: it could not be restored
            raise ValueError

        def stop(number: int, frame: Any) -> None:
            monitor.cancel()
            signal.signal(signal.SIGINT, before)

        signal.signal(signal.SIGINT, stop)
    except ValueError:  # also outside the main thread: the caller owns the signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _prepare_libraries() -> None:
    """For libraries that the command loads later: one thread in linear algebra (see foundation/threads.py), and no messages of the
    video decoders, because a broken file is reported in one sentence of ours."""
    import cv2

    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    getattr(cv2.utils, "logging", cv2).setLogLevel(0)  # OpenCV 5, OpenCV 4


def _progress_line(monitor: Monitor) -> Callable[[str, float, float], None]:
    """One bar: over all stages of a run with the time left, or else over what is computed."""

    def report(stage: str, done: float, total: float) -> None:
        course, part = monitor.course, min(1.0, done / total) if total else 1.0
        whole = part if course is None else course.fraction
        left = None if course is None else course.seconds_left
        more = "" if left is None else f"{time_text(left)} left"
        end = "\n" if whole >= 1 else ""
        streams.write(f"\r{streams.visible(stage):<24} [{'#' * round(30 * whole):<30}] {100 * whole:3.0f} %  {more:<16}{end}", sys.stderr)

    return report


def _plain_progress(monitor: Monitor) -> Callable[[str, float, float], None]:
    """A line per twentieth of a run with the time left, or else per tenth of what is computed."""
    last: dict[str, int] = {}

    def report(stage: str, done: float, total: float) -> None:
        if (course := monitor.course) is not None:
            twentieth, left = int(20 * course.fraction), course.seconds_left
            if last.setdefault("", -1) < twentieth:
                last[""] = twentieth
                more = "" if left is None or twentieth == 20 else f", {time_text(left)} left"
                streams.write_line(f"{5 * twentieth} %{more} ({stage})", sys.stderr)
            return
        tenth = int(10 * done / total) if total else 10
        if last.get(stage) != tenth:
            last[stage] = tenth
            streams.write_line(f"{stage}: {10 * tenth} %", sys.stderr)

    return report
