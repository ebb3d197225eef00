"""Keeping the steps' states up to date without work in draw(): looked at again once a second if something changed in the scene or on disk,
at once when a job or an operator of ours ends, and when a file is loaded.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import bpy

from ...core.foundation.errors import InputError
from .. import folders, jobs, project
from ..session import get_session
from . import states
from .states import STEPS, Look, State

TICK_S = 1.0


@dataclass(frozen=True, kw_only=True, slots=True)
class StepEnd:
    """A step that failed or was stopped: the key of its input, whether it failed, and the sentence to show as long as the input stays."""

    key: str
    failed: bool
    why: str


class OpenSteps(bpy.types.PropertyGroup):
    """Which steps are unfolded in the panel; lives in the WindowManager: neither saved nor undone."""

    __annotations__ = {step: bpy.props.BoolProperty(name=title, default=step == "footage", options={"SKIP_SAVE"},
                                                    description=f"Show step {n}, {title}")
                       for n, (step, title) in enumerate(zip(STEPS, states.TITLES), 1)}  # fmt: skip


def look(scene: bpy.types.Scene) -> Look:
    """The states as they were found last; nothing is computed but the first time."""
    return get_session().file.looks.get(scene.name_full) or refresh(scene)


def refresh(scene: bpy.types.Scene) -> Look:
    """Look at everything now. The next step is unfolded when it becomes another one, and what is done is folded, but the last."""
    file, name = get_session().file, scene.name_full
    before, now = file.looks.get(name), _with_ends(scene, states.compute(scene))
    file.looks[name], file.stamps[name], file.changed = now, _stamp(scene), False
    if before is None or before.next != now.next:
        _unfold(before, now)
    return now


def mark(*_: Any) -> None:
    """Something changed; look again soon."""
    get_session().file.changed = True


def state_of(context: bpy.types.Context, step: str) -> State:
    """The state of a step to show: what was found, or that it is running."""
    job = context.window_manager.tricap
    return State(word="running", why=job.left) if job.running and job.step == step else look(context.scene).states[step]


def _with_ends(scene: bpy.types.Scene, now: Look) -> Look:
    """A step that failed with the input that it still has stays failed, and one that was stopped says what was kept."""
    found, ends = dict(now.states), get_session().file.step_ends
    for (name, step), end in list(ends.items()):
        if name == scene.name_full and step in found:
            same = end.key == _input(step, now)
            if same and found[step].word in ("ready", "stale"):
                found[step] = State(word="failed" if end.failed else found[step].word, why=end.why)
            elif not same or found[step].word == "done":
                del ends[name, step]
    return Look(states=found, keys=now.keys)


def _input(step: str, now: Look) -> str:
    return now.keys.get(states.STAGE.get(step, ""), "")


def _ended(context: bpy.types.Context, step: str, failed: str, stopped: str) -> None:
    scene, ends = context.scene, get_session().file.step_ends
    ends.pop((scene.name_full, step), None)
    now = refresh(scene)
    if (failed or stopped) and step in STEPS:
        ends[scene.name_full, step] = StepEnd(key=_input(step, now), failed=bool(failed), why=failed or stopped)
        refresh(scene)


def _unfold(before: Look | None, now: Look) -> None:
    shown: Mapping[str, Any] = bpy.context.window_manager.tricap_steps
    if before is not None and before.next not in (None, STEPS[-1]) and now.states[before.next].word in ("done", "empty"):
        setattr(shown, before.next, False)
    if now.next:
        setattr(shown, now.next, True)


def _stamp(scene: bpy.types.Scene) -> Any:
    """Sizes and times of the files on which the states depend."""
    try:
        folder, out = project.folder_of(scene), folders.output_folder("", scene)
    except InputError:
        return None
    return [_time(path) for path in (folder, folder / "take.toml", folder / "rig.toml", out, out / "run.json")]


def _time(path: Any) -> tuple[int, int] | None:
    try:
        state = path.stat()
    except OSError:
        return None
    return state.st_mtime_ns, state.st_size


def _tick() -> float:
    context = bpy.context
    scene, runs = context.scene, context.window_manager.tricap.running
    if scene is not None:
        file, name = get_session().file, scene.name_full
        if (
            (file.changed and not runs) or name not in file.looks or file.stamps.get(name) != _stamp(scene)
        ):  # a run finishes step after step
            before = file.looks.get(name)
            if refresh(scene) != before:
                jobs.redraw(context)
    return TICK_S


@bpy.app.handlers.persistent
def _scene_changed(*_: Any) -> None:
    mark()


HANDLERS = ("depsgraph_update_post", "undo_post", "redo_post")


def register() -> None:
    """Begin to watch."""
    bpy.utils.register_class(OpenSteps)
    bpy.types.WindowManager.tricap_steps = bpy.props.PointerProperty(type=OpenSteps)
    for name in HANDLERS:
        getattr(bpy.app.handlers, name).append(_scene_changed)
    session = get_session()
    session.on_job_end.append(_ended)
    session.on_value_change.append(mark)
    bpy.app.timers.register(_tick, first_interval=TICK_S, persistent=True)


def unregister() -> None:
    """Watch no longer."""
    bpy.app.timers.unregister(_tick)
    session = get_session()
    session.on_job_end.remove(_ended)
    session.on_value_change.remove(mark)
    for name in HANDLERS:
        getattr(bpy.app.handlers, name).remove(_scene_changed)
    del bpy.types.WindowManager.tricap_steps
    bpy.utils.unregister_class(OpenSteps)
