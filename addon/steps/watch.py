"""Keeping the steps' states up to date without work in draw(): looked at again once a second if something changed in the scene or on disk,
at once when a job or an operator of ours ends, and when a file is loaded.
"""

from collections.abc import Mapping
from typing import Any

import bpy

from ...core.errors import InputError
from .. import folders, jobs, project, take_properties
from . import states
from .states import STEPS, Look, State

TICK_S = 1.0
_looks: dict[str, Look] = {}  # by scene
_stamps: dict[str, Any] = {}
_ends: dict[tuple[str, str], tuple[str, str, str]] = {}  # (scene, step) -> the input with which it failed or was stopped, the word, why
_changed: set[str] = {"scene"}


class OpenSteps(bpy.types.PropertyGroup):
    """Which steps are unfolded in the panel; lives in the WindowManager: neither saved nor undone."""

    __annotations__ = {step: bpy.props.BoolProperty(name=title, default=step == "footage", options={"SKIP_SAVE"},
                                                    description=f"Show step {n}, {title}")
                       for n, (step, title) in enumerate(zip(STEPS, states.TITLES), 1)}  # fmt: skip


def look(scene: bpy.types.Scene) -> Look:
    """The states as they were found last; nothing is computed but the first time."""
    return _looks.get(scene.name_full) or refresh(scene)


def refresh(scene: bpy.types.Scene) -> Look:
    """Look at everything now. The next step is unfolded when it becomes another one, and what is done is folded, but the last."""
    before, now = _looks.get(scene.name_full), _with_ends(scene, states.compute(scene))
    _looks[scene.name_full], _stamps[scene.name_full] = now, _stamp(scene)
    _changed.clear()
    if before is None or before.next != now.next:
        _unfold(before, now)
    return now


def mark(*_: Any) -> None:
    """Something changed; look again soon."""
    _changed.add("scene")


def state_of(context: bpy.types.Context, step: str) -> State:
    """The state of a step to show: what was found, or that it is running."""
    job = context.window_manager.tricap
    return State(word="running", why=job.left) if job.running and job.step == step else look(context.scene).states[step]


def _with_ends(scene: bpy.types.Scene, now: Look) -> Look:
    """A step that failed with the input that it still has stays failed, and one that was stopped says what was kept."""
    found = dict(now.states)
    for (name, step), (given, word, sentence) in list(_ends.items()):
        if name == scene.name_full and step in found:
            if given == _input(step, now) and found[step].word in ("ready", "stale"):
                found[step] = State(word=word or found[step].word, why=sentence)
            elif given != _input(step, now) or found[step].word == "done":
                del _ends[name, step]
    return Look(states=found, keys=now.keys)


def _input(step: str, now: Look) -> str:
    return now.keys.get(states.STAGE.get(step, ""), "")


def _ended(context: bpy.types.Context, step: str, failed: str, stopped: str) -> None:
    scene = context.scene
    _ends.pop((scene.name_full, step), None)
    now = refresh(scene)
    if (failed or stopped) and step in STEPS:
        _ends[scene.name_full, step] = _input(step, now), "failed" if failed else "", failed or stopped
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
        name = scene.name_full
        if (_changed and not runs) or name not in _looks or _stamps.get(name) != _stamp(scene):  # a run finishes step after step
            before = _looks.get(name)
            if refresh(scene) != before:
                jobs.redraw(context)
    return TICK_S


@bpy.app.handlers.persistent
def _scene_changed(*_: Any) -> None:
    mark()


@bpy.app.handlers.persistent
def _file_loaded(*_: Any) -> None:
    for known in (_looks, _stamps, _ends):
        known.clear()
    mark()


HANDLERS = {"depsgraph_update_post": _scene_changed, "undo_post": _scene_changed, "redo_post": _scene_changed, "load_post": _file_loaded}


def register() -> None:
    """Begin to watch."""
    bpy.utils.register_class(OpenSteps)
    bpy.types.WindowManager.tricap_steps = bpy.props.PointerProperty(type=OpenSteps)
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)
    jobs.ENDED.append(_ended)
    take_properties.TOUCHED.append(mark)
    bpy.app.timers.register(_tick, first_interval=TICK_S, persistent=True)


def unregister() -> None:
    """Watch no longer."""
    bpy.app.timers.unregister(_tick)
    jobs.ENDED.remove(_ended)
    take_properties.TOUCHED.remove(mark)
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    del bpy.types.WindowManager.tricap_steps
    bpy.utils.unregister_class(OpenSteps)
    _file_loaded()
