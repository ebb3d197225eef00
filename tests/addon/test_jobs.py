"""Jobs: the blocking driver, the worker thread, and everything that must stop it. The modal driver needs a window: tests/gui."""

import importlib
import sys
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from ..waiting import PATIENCE_S, wait_until

ADDON = "bl_ext.user_default.tricap.addon"
STOP_S = 1.0


@pytest.fixture
def jobs(blender: ModuleType) -> ModuleType:
    """The add-on's own module, as Blender has it."""
    module = importlib.import_module("bl_ext.user_default.tricap.addon.jobs")
    yield module
    module.stop_current()


def endless(monitor: object) -> None:
    """A job that ends only when it is stopped."""
    for i in range(10**12):
        monitor.step("spinning", i % 100, 100)


def session_of(jobs: ModuleType) -> Any:
    """The session of the add-on to which this module belongs."""
    return importlib.import_module(f"{jobs.__package__}.session").get_session()


def running(jobs: ModuleType) -> object:
    """An endless job on its thread, known to the module as the present one."""
    job = jobs.Job(endless)
    session_of(jobs).job = job
    job.start()
    wait_until(lambda: job.stage)
    assert job.alive and job.stage == "spinning" and 0 <= job.fraction <= 1
    return job


def test_an_operator_is_alone(jobs: ModuleType) -> None:
    seen = [0]

    def count(monitor: object) -> None:
        while True:
            monitor.check()
            seen[0] += 1

    module, session = importlib.import_module(f"{ADDON}.alone"), session_of(jobs)
    session.job = jobs.Job(count)
    finder = SimpleNamespace(finish=lambda seconds: seen.append(seen[0]))
    session.finders.append(finder)
    session.job.start()
    wait_until(lambda: seen[0])
    try:
        with module.alone():
            held = seen[0]
            threading.Event().wait(0.05)  # a thread that goes on counts some thousands; a busy machine only asks less
            assert seen == [held, held], "the finder was asked, and the job stands still"
            late = jobs.Job(lambda monitor: seen.append(-1))
            late.start()
            threading.Event().wait(0.05)
            assert seen == [held, held], "no job begins meanwhile"
    finally:
        session.finders.remove(finder)
    wait_until(lambda: seen[-1] == -1 and seen[0] > held)


def test_an_operator_does_not_wait_for_a_job_that_never_looks(jobs: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    module, session, end = importlib.import_module(f"{ADDON}.alone"), session_of(jobs), threading.Event()
    session.job = jobs.Job(lambda monitor: end.wait(PATIENCE_S))
    session.job.start()
    monkeypatch.setattr(module, "LONGEST_S", 0.05)
    with module.alone():
        assert session.job.alive
    end.set()


def test_here_and_on_a_thread_give_the_same(jobs: ModuleType) -> None:
    def compute(monitor: object) -> tuple[int, bool]:
        monitor.step("adding", 1, 2)
        return sum(range(1000)), threading.current_thread() is threading.main_thread()

    here, there = jobs.Job(compute), jobs.Job(compute)
    here.run()
    there.start()
    there._thread.join()
    assert here.result == (499500, True) and there.result == (499500, False)
    assert here.fraction == there.fraction == 0.5


def test_steps_on_the_main_thread_are_taken_in_turns_with_the_window(jobs: ModuleType) -> None:
    """What needs Blender after the computation: some steps at a time, stopped like it, with its mistakes reported."""
    left: list[str] = []

    def steps(job: Any, last: int) -> Any:
        try:
            for i in range(last):
                job.monitor.step("reading", i, last)
                yield
        finally:
            left.append("tidy")
        return f"{last} steps after {job.result}"

    def advanced(last: int, seconds: float) -> Any:
        job = jobs.Job(lambda monitor: "it")
        job.run()
        return job, lambda: job.advance(lambda: steps(job, last), seconds)

    job, advance = advanced(3, float("inf"))
    assert advance() and job.result == "3 steps after it" and job.error is None
    job, advance = advanced(3, -1.0)
    assert [advance() for _ in range(4)] == [False, False, False, True] and job.result == "3 steps after it" and job.done == 2
    job, advance = advanced(3, -1.0)
    assert not advance()
    job.monitor.cancel()
    assert advance() and type(job.error).__name__ == "Cancelled"
    job, advance = advanced(3, -1.0)
    assert not advance()
    job.leave()
    assert left == ["tidy"] * 4, "however they end, what they changed is put back"
    failed = jobs.Job(lambda monitor: 1 / 0)
    failed.run()
    assert failed.advance(lambda: steps(failed, 1), 1.0) and isinstance(failed.error, ZeroDivisionError)


def test_the_window_gets_its_turn_while_python_computes(jobs: ModuleType) -> None:
    """A worker that never leaves the interpreter: the main thread has its turn between any two of its steps."""
    before, worked = sys.getswitchinterval(), threading.Event()

    def compute(monitor: object) -> None:
        total = 0
        for i in range(10**9):
            total += i * i
            if i % 1000 == 0:
                worked.set()
                monitor.step("counting", 0, 1)

    job = jobs.Job(compute)
    job.start()
    for _ in range(40):
        worked.clear()
        assert worked.wait(PATIENCE_S)
    assert sys.getswitchinterval() == pytest.approx(jobs.SWITCH_S, rel=1e-3)
    job.cancel_and_join()
    assert sys.getswitchinterval() == before


def test_words_are_told_in_one_workspace(blender: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    panels, told = importlib.import_module(f"{ADDON}.panels"), {}

    class Workspace(SimpleNamespace):
        def status_text_set(self, words: str | None) -> None:
            told[self.name] = words

    layout, clicks = Workspace(name="Layout"), Workspace(name="Clicks")
    monkeypatch.setattr(panels, "bpy", SimpleNamespace(data=SimpleNamespace(workspaces={"Layout": layout, "Clicks": clicks})))
    override, meant = lambda workspace: meant.append(workspace.name) or nullcontext(), []

    def showing(workspace: Workspace) -> SimpleNamespace:
        return SimpleNamespace(workspace=layout, window=SimpleNamespace(workspace=workspace), temp_override=override)

    panels.show_status(showing(layout), "elbow.R")
    panels.show_status(showing(clicks), "wrist.R")
    assert told == {"Layout": None, "Clicks": "wrist.R"} and meant == ["Layout", "Layout", "Clicks"]
    panels.show_status(showing(layout), None)
    assert told == {"Layout": None, "Clicks": None}


def test_progress_is_drawn_a_few_times_a_second(jobs: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """And not at all where nothing new is to be told; that it is stopping is told at once."""
    told, now = list[str](), [100.0]
    monkeypatch.setattr(jobs, "show_status", lambda context, words: told.append(words))
    monkeypatch.setattr(jobs, "redraw", lambda context: None)
    monkeypatch.setattr(jobs, "time", SimpleNamespace(monotonic=lambda: now[0]))
    watcher = jobs.JobOperator()
    watcher.job = SimpleNamespace(monitor=SimpleNamespace(cancelled=False), stage_text="surface", fraction=0.0, left_text="")
    for tick in range(40):  # four seconds
        watcher.job.fraction, now[0] = tick // 20 * 0.3 + tick % 20 / 100, 100.0 + jobs.TICK_S * tick
        watcher._show(None)
    assert 12 <= len(told) <= 17 and len(set(told)) == len(told)
    watcher.job.monitor.cancelled, watcher.job.stage_text = True, "Stopping"
    watcher._show(None)
    now[0] += 10
    watcher._show(None)
    assert told[-1] == "Tricap: Stopping" and told.count("Tricap: Stopping") == 1


def test_cancelling_joins_within_a_second(jobs: ModuleType) -> None:
    job = running(jobs)
    began = time.process_time()
    job.cancel_and_join()
    assert time.process_time() - began < STOP_S
    assert not job.alive and "Stopped during spinning" in str(job.error)


def test_another_file_stops_the_job(jobs: ModuleType, blender: ModuleType) -> None:
    job = running(jobs)
    blender.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert not job.alive and session_of(jobs).job is None


def test_the_cancel_operator_is_there_only_while_a_job_runs(jobs: ModuleType, blender: ModuleType) -> None:
    assert not blender.ops.tricap.cancel.poll()
    job = running(jobs)
    assert blender.ops.tricap.cancel.poll()
    assert blender.ops.tricap.cancel() == {"FINISHED"}
    job._thread.join(STOP_S)
    assert not job.alive


def test_disabling_the_extension_stops_the_job(blender: ModuleType) -> None:
    import addon_utils

    name = "bl_ext.user_default.tricap"
    job = running(importlib.import_module(f"{name}.addon.jobs"))
    try:
        addon_utils.disable(name)
        assert not job.alive
        assert not hasattr(blender.types.Scene, "tricap") and not hasattr(blender.types.WindowManager, "tricap")
    finally:
        addon_utils.enable(name)


def test_wrong_input_is_one_sentence(jobs: ModuleType, blender: ModuleType, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    with pytest.raises(RuntimeError, match=r"has no results of Tricap \(no run.json\)"):
        blender.ops.tricap.build_scene(out=str(tmp_path))
    with pytest.raises(RuntimeError, match="Choose the take first"):
        blender.ops.tricap.run()
    with pytest.raises(RuntimeError, match="is not a folder; choose the folder that contains take.toml"):
        blender.ops.tricap.run(take=str(tmp_path / "nowhere"))
    with pytest.raises(RuntimeError, match="relative to the Blender file, which was never saved"):
        blender.ops.tricap.build_scene(out="//results")
    assert "Traceback" not in "".join(capfd.readouterr())


def test_a_bug_in_the_scene_is_told_too_and_the_panel_hears_of_the_end(
    jobs: ModuleType, blender: ModuleType, caplog: pytest.LogCaptureFixture
) -> None:
    class BrokenEnd(jobs.JobOperator, blender.types.Operator):
        bl_idname = "tricap.broken_end"
        bl_label = "Broken End"
        step = "surface"

        def snapshot(self, context: object) -> object:
            return lambda monitor: {}

        def finish(self, context: object, result: dict[str, int]) -> set[str]:
            return {"FINISHED"} if result["nothing"] else {"CANCELLED"}

    heard: list[tuple[str, str]] = []
    listener = lambda context, step, failed, stopped, error: heard.append((step, failed))  # noqa: E731
    blender.utils.register_class(BrokenEnd)
    session_of(jobs).on_job_end.append(listener)
    try:
        with pytest.raises(RuntimeError, match="Internal error in Tricap .KeyError"):
            blender.ops.tricap.broken_end()
    finally:
        session_of(jobs).on_job_end.remove(listener)
        blender.utils.unregister_class(BrokenEnd)
    assert 'result["nothing"]' in caplog.text and [step for step, _ in heard] == ["surface"]
    assert heard[0][1].startswith("Internal error in Tricap (KeyError")


def test_a_bug_is_told_with_its_traceback(jobs: ModuleType, blender: ModuleType, caplog: pytest.LogCaptureFixture) -> None:
    class Broken(jobs.JobOperator, blender.types.Operator):
        bl_idname = "tricap.broken"
        bl_label = "Broken"

        def snapshot(self, context: object) -> object:
            return lambda monitor: 1 // 0

    blender.utils.register_class(Broken)
    try:
        with pytest.raises(RuntimeError, match="Internal error in Tricap .ZeroDivisionError"):
            blender.ops.tricap.broken()
    finally:
        blender.utils.unregister_class(Broken)
    assert "1 // 0" in caplog.text
