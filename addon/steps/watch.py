"""Keeps the steps' states up to date, so that draw() computes nothing. They are computed again once a second if something changed in the
scene or on disk, and at once when a job or one of our operators ends.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import bpy

from ...core.fitting.inputs.start_joints import NeedsClick
from ...core.foundation.errors import InputError
from .. import folders, jobs, project
from ..session import get_session
from . import states
from .states import STEPS, State, Status, StepStates

TICK_S = 1.0


@dataclass(frozen=True, kw_only=True, slots=True)
class StepEnd:
    """How a step failed or was stopped; shown until its input (of this key) changes."""

    key: str
    failed: bool
    message: str
    click: tuple[str, int] | None = None


class OpenSteps(bpy.types.PropertyGroup):
    """Which steps are unfolded in the panel; belongs to the WindowManager, so it is neither saved nor undone."""

    __annotations__ = {step: bpy.props.BoolProperty(name=title, default=step == "footage", options={"SKIP_SAVE"},
                                                    description=f"Show step {n}, {title}")
                       for n, (step, title) in enumerate(zip(STEPS, states.TITLES), 1)}  # fmt: skip


def current(scene: bpy.types.Scene) -> StepStates:
    """The states as computed last; computed now only if they never were."""
    return get_session().file.step_states.get(scene.name_full) or refresh(scene)


def refresh(scene: bpy.types.Scene) -> StepStates:
    """Compute the states now. When another step becomes the next one, it is unfolded, and finished steps are folded, except the last."""
    file, name = get_session().file, scene.name_full
    before, now = file.step_states.get(name), _with_ends(scene, states.compute(scene))
    file.step_states[name], file.stamps[name], file.changed = now, _stamp(scene), False
    if before is None or before.next != now.next:
        _unfold(before, now)
    return now


def mark(*_: Any) -> None:
    """Something changed: compute the states at the next tick."""
    get_session().file.changed = True


def state_of(context: bpy.types.Context, step: str) -> State:
    """The state of a step to show: that it is running, or as computed last."""
    job = context.window_manager.tricap
    running = job.running and job.step == step
    return State(status=Status.RUNNING, message=job.left) if running else current(context.scene).states[step]


def _with_ends(scene: bpy.types.Scene, now: StepStates) -> StepStates:
    """With the steps that failed or were stopped, as long as their input is the same."""
    found, ends = dict(now.states), get_session().file.step_ends
    for (name, step), end in list(ends.items()):
        if name == scene.name_full and step in found:
            same, status = end.key == _input_key(step, now), found[step].status
            if same and status in (Status.READY, Status.STALE):
                ended = Status.ASKS if end.click else Status.FAILED if end.failed else status
                found[step] = State(status=ended, message=end.message, click=end.click)
            elif not same or status == Status.DONE:
                del ends[name, step]
    return StepStates(states=found, keys=now.keys)


def _input_key(step: str, now: StepStates) -> str:
    return now.keys.get(states.STAGE.get(step, ""), "")


def _job_ended(context: bpy.types.Context, step: str, failed: str, stopped: str, error: BaseException | None = None) -> None:
    scene, ends = context.scene, get_session().file.step_ends
    ends.pop((scene.name_full, step), None)
    now = refresh(scene)
    if (failed or stopped) and step in STEPS:
        click = (error.joint, error.frame) if isinstance(error, NeedsClick) else None
        ends[scene.name_full, step] = StepEnd(key=_input_key(step, now), failed=bool(failed), message=failed or stopped, click=click)
        refresh(scene)


def _unfold(before: StepStates | None, now: StepStates) -> None:
    shown: Mapping[str, Any] = bpy.context.window_manager.tricap_steps
    if before is not None and before.next not in (None, STEPS[-1]):
        if now.states[before.next].status in (Status.DONE, Status.EMPTY):
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
        file, before = get_session().file, get_session().file.step_states.get(scene.name_full)
        changed = file.changed and not runs  # a run changes the files, step by step
        if changed or before is None or file.stamps.get(scene.name_full) != _stamp(scene):
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
    session.on_job_end.append(_job_ended)
    session.on_value_change.append(mark)
    bpy.app.timers.register(_tick, first_interval=TICK_S, persistent=True)


def unregister() -> None:
    """Stop watching."""
    bpy.app.timers.unregister(_tick)
    session = get_session()
    session.on_job_end.remove(_job_ended)
    session.on_value_change.remove(mark)
    for name in HANDLERS:
        getattr(bpy.app.handlers, name).remove(_scene_changed)
    del bpy.types.WindowManager.tricap_steps
    bpy.utils.unregister_class(OpenSteps)
