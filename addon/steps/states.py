"""The state of every step, from what is on disk and in the scene. `compute` looks; nothing here changes anything.

A step is *empty* (something before it is missing), *ready* (it can be done now), *running*, *done*, *stale* (done with other input), or
*failed*. Each state says in one sentence why, or what to do.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ...core.body.model_file import read_model
from ...core.checking.take_check import DOUBTFUL_RESIDUAL_PX
from ...core.foundation.errors import InputError
from ...core.geometry.rig import read_rig
from ...core.images.sequence import ImageSequence, open_sequence
from ...core.results.run_json import read_run
from ...core.run.stages import stage_keys
from ...core.run.take_run import settings_of
from ...core.take.clicked_points import clicked_depth
from ...core.take.take import Footage, Take, footage_frames, open_take
from .. import folders, project
from ..clicking.click_session import joints_of as joints_in_order
from ..scene.build import KEYS_KEY, OUT_KEY
from ..session import get_session

STEPS = ("footage", "cameras", "seeds", "surface", "tracks", "body", "rig", "retarget")
TITLES = ("Footage", "Cameras", "Seeds (Joint Clicks)", "Surface", "Tracks", "Body", "Rig", "Retarget and Export")
STAGE = {"surface": "measure", "tracks": "track", "body": "fit"}  # the stage of core that a step runs
WRITES = {"surface": "clouds", "tracks": "trajectories.npz", "body": "motion.csv"}
FIND = "Find Footage"
SAVE_FIRST = "Save this file first: the project lies in a folder beside it. Then add the films of your cameras."
NEEDED_JOINTS = 2  # the fit's own least number
MOST_REMEMBERED = 500  # joints
MOST_SEQUENCES = 50  # kept open


@dataclass(frozen=True, kw_only=True)
class State:
    """One of the words, and a sentence."""

    word: str
    why: str = ""


@dataclass(frozen=True, kw_only=True)
class Look:
    """What was found at one look: the states, the keys of the stages now, and the take's frames."""

    states: Mapping[str, State]
    keys: Mapping[str, str]

    @property
    def next(self) -> str | None:
        """The step that is the next thing to do: the first that is not done."""
        if self.states["footage"].word == "empty":
            return "footage"
        return next((step for step in STEPS if self.states[step].word in ("ready", "stale", "failed")), None)


@dataclass(kw_only=True)
class _Found:
    """What the later steps need of the earlier ones."""

    take: Take | None = None
    sequences: tuple[ImageSequence, ...] = ()
    frames: range = range(0)
    footage: Footage | None = None
    keys: Mapping[str, str] | None = None
    run: Mapping[str, Any] | None = None
    problem: str = ""  # why there is no `run` though there is a run.json
    out: Path | None = None


def compute(scene: bpy.types.Scene) -> Look:
    """Look at everything; costs a few milliseconds."""
    found = _Found()
    states: dict[str, State] = {}
    for step, look in (("footage", _footage), ("cameras", _cameras), ("seeds", _seeds)):
        states[step] = _or_failed(look, scene, found)
    found.out = _or_none(lambda: folders.output_folder("", scene))
    found.keys = _or_none(lambda: _keys(found))
    _look_into_run(found)
    for step in STAGE:
        states[step] = _stage(step, states, found)
    states["rig"] = _rig(scene, states, found)
    states["retarget"] = _retarget(scene, states["rig"])
    return Look(states=states, keys=found.keys or {})


def _or_failed(look: Any, scene: bpy.types.Scene, found: _Found) -> State:
    try:
        return look(scene, found)
    except InputError as error:
        return State(word="failed", why=str(error))


def _or_none(look: Any) -> Any:
    """What cannot be found out because an earlier step is not done is None; that step says why."""
    try:
        return look()
    except InputError:
        return None


def _footage(scene: bpy.types.Scene, found: _Found) -> State:
    props = scene.tricap
    if not project.bound(scene):
        if props.take and (project.existing_folder(scene) / "take.toml").exists():
            return State(word="ready", why="Press Open Take to show its footage.")
        if not props.take and not bpy.data.filepath:
            return State(word="empty", why=SAVE_FIRST)
        return State(word="empty", why="Add the movies or image folders of your cameras.")
    folder = project.existing_folder(scene)
    if project.changed_outside(scene):
        raise InputError("take.toml was changed outside this file: reload it, or keep what is here.")
    if len(props.views) < 2:
        return State(word="ready", why="Add the footage of a second camera.")
    if project.shows_other_lines(scene):
        raise InputError(project.OTHER_LINES)
    take = project.take(scene)
    found.sequences = tuple(_sequence(folder, view) for view in take.views)
    spans = [(-view.offset_frames, s.count - view.offset_frames) for view, s in zip(take.views, found.sequences)]
    if take.frames is None and len({stop for _, stop in spans}) > 1:
        lengths = ", ".join(f"{view.name} to {stop - 1}" for view, (_, stop) in zip(take.views, spans))
        raise InputError(f"The views do not end with the same frame ({lengths}): press Use Common Frames, or mend the offsets.")
    found.frames, found.take = footage_frames(take, found.sequences), take
    sizes = " and ".join(sorted({f"{view.clip.size[0]}×{view.clip.size[1]}" for view in props.views}))
    rate = f"{round(props.fps * project.fields_of(scene).per_image, 3):g} a second"
    return State(word="done", why=f"{len(take.views)} views, {len(found.frames)} frames of {sizes} pixels, {rate}.")


def _cameras(scene: bpy.types.Scene, found: _Found) -> State:
    if found.take is None:
        return State(word="empty", why="Comes after the footage.")
    path = found.take.rig_path
    if not path.exists():
        return State(word="ready", why="Read a calibration file, or calibrate from a film of a waved bar.")
    rig = read_rig(path)
    for view in scene.tricap.views:
        size = rig[view.name].size_px
        if tuple(view.clip.size) != size:
            raise InputError(
                f"Camera {view.name} was calibrated with pictures of {size[0]}×{size[1]} pixels, its footage has "
                f"{view.clip.size[0]}×{view.clip.size[1]}; use the footage as it was calibrated."
            )
    found.footage = open_take(found.take, found.sequences)
    return State(word="done", why=f"{len(found.footage.rig.cameras)} cameras, one for each view.")


def _seeds(scene: bpy.types.Scene, found: _Found) -> State:
    take = found.take
    if take is None:
        return State(word="empty", why="Comes after the footage.")
    if take.body_model is None:
        return State(word="done", why="No body is wanted: surface and tracks need no clicks.")
    if take.keypoints:
        return State(word="done", why="Keypoints of another system stand for clicks; clicks may be added.")
    wanted = joints_of(take.body_model)
    clicked = take.seeds.joints
    if found.footage is not None:
        _check_clicks(found.footage)
    whole = [name for name in wanted if len(clicked.get(name, {})) >= 2]
    if len(whole) < min(NEEDED_JOINTS, len(wanted)):
        return State(word="ready", why=f"Click the joints in two views at least: {len(whole)} of {len(wanted)} so far.")
    missing = [name for name in wanted if name not in whole]
    if missing:
        return State(word="done", why=f"{len(whole)} of {len(wanted)} joints; {_and_others(missing)} would make it safer.")
    return State(word="done", why=f"All {len(wanted)} joints are clicked.")


def _and_others(names: list[str]) -> str:
    return " and ".join(names) if len(names) < 3 else f"{names[0]}, {names[1]} and others"


def _check_clicks(footage: Footage) -> None:
    """Each joint's clicks meet in space; what was found of the same clicks and cameras is remembered.

    Raises:
        InputError: those of a joint do not.
    """
    take, rig = footage.take, footage.take.rig_path.stat()
    problems = get_session().file.click_problems
    for name, at in take.seeds.joints.items():
        clicks = tuple((view, *xy.tolist()) for view, xy in sorted(at.items()))
        key = (take.rig_path, rig.st_mtime_ns, rig.st_size, take.reference, name, clicks)
        if key not in problems:
            if len(problems) > MOST_REMEMBERED:
                problems.clear()
            try:
                clicked_depth(footage, name, at)
                problems[key] = ""
            except InputError as error:
                problems[key] = str(error)
        if problems[key]:
            raise InputError(problems[key])


def _stage(step: str, states: Mapping[str, State], found: _Found) -> State:
    if states["footage"].word != "done" or states["cameras"].word != "done" or found.keys is None:
        return State(word="empty", why="Comes after footage and cameras.")
    if step == "body" and found.take is not None and found.take.body_model is None:
        return State(word="empty", why="No body is wanted (step 3).")
    if found.problem:
        return State(word="failed", why=found.problem) if step == "surface" else State(word="empty", why="Comes after the surface.")
    stage = STAGE[step]
    entry = (found.run or {}).get("stages", {}).get(stage)
    if entry is None or found.out is None or not (found.out / WRITES[step]).exists() and "not_done" not in entry:
        if step == "body" and states["seeds"].word != "done":
            return State(word="empty", why="Comes after the clicks (step 3).")
        before = states[STEPS[STEPS.index(step) - 1]].word if step != "surface" else "done"
        return State(word="ready" if before == "done" else "empty", why=_READY[step])
    if entry.get("key") != found.keys[stage]:
        return State(word="stale", why="Something that it depends on was changed since; run it again.")
    if "not_done" in entry and step != "body":
        return State(word="done", why=f"Left out: {entry['not_done']}.")
    if "not_done" in entry:
        return State(word="ready" if states["seeds"].word == "done" else "empty", why=f"No body was fitted: {entry['not_done']}.")
    return State(word="done", why=_figures(step, entry))


_READY = {
    "surface": "Measure the surface of the body in every frame.",
    "tracks": "Follow the surface's points from frame to frame.",
    "body": "Fit the skeleton and its flesh to surface and tracks.",
}


def _figures(step: str, entry: Mapping[str, Any]) -> str:
    if step == "surface":
        doubt = " Their rays miss each other by {:.1f} px: check the cameras, the offsets, and whether views are swapped."
        missed = doubt.format(entry["residual_px"]) if entry["residual_px"] > DOUBTFUL_RESIDUAL_PX else ""
        return f"{entry['points_per_frame']:.0f} points a frame, sigma {entry['sigma_mm']:.2f} mm.{missed}"
    if step == "tracks":
        return f"{entry['trajectories']} trajectories of {entry['mean_length_frames']:.0f} frames on average."
    return f"{sum(entry['frames'].values())} frames, joints to {entry['joint_sigma_mm']:.1f} mm."


def _rig(scene: bpy.types.Scene, states: Mapping[str, State], found: _Found) -> State:
    built = next((c for c in scene.collection.children_recursive if OUT_KEY in c), None)
    if built is None:
        last = "tracks" if found.take is not None and found.take.body_model is None else "body"
        if states[last].word != "done":
            return State(word="empty", why=f"Comes after the {last}.")
        return State(word="ready", why="Build armature, skin and cameras into this scene.")
    moving = any(o.type == "ARMATURE" for o in built.all_objects)
    if states["body"].word == "done" and not moving:
        return State(word="stale", why="The body's armature is not in the scene; build it again.")
    now = found.keys or {}
    if found.keys is not None and any(now.get(stage) != key for stage, key in dict(built.get(KEYS_KEY, {})).items()):
        return State(word="stale", why="It shows an earlier result; build it again once the steps before are done.")
    if found.keys is not None and built_less(built, found):
        return State(word="stale", why="There is more by now than it shows; build it again.")
    return State(word="done", why="The armature plays the motion." if moving else "Surface and tracks are in the scene.")


def built_less(built: bpy.types.Collection, found: _Found) -> bool:
    """Whether a stage was done that the built scene does not have."""
    done = {s for s, entry in (found.run or {}).get("stages", {}).items() if s in STAGE.values() and "not_done" not in entry}
    return bool(done - set(dict(built.get(KEYS_KEY, {})))) and OUT_KEY in built and str(found.out) == built[OUT_KEY]


def _retarget(scene: bpy.types.Scene, rig: State) -> State:
    if rig.word == "empty" or rig.word == "ready":
        return State(word="empty", why="Comes after the rig.")
    retarget = scene.tricap_retarget
    if retarget.last or retarget.last_export:
        word = "stale" if rig.word == "stale" else "done"
        return State(word=word, why=retarget.last_export or "The character plays the motion.")
    return State(word="ready", why="Put the motion onto your own character, or export it.")


def joints_of(model: str) -> tuple[str, ...]:
    """The joints of a body model that one is asked to click.

    Raises:
        InputError: there is no such model.
    """
    known = get_session().file.joints
    if model not in known or model.endswith(".toml"):  # a file may change
        known[model] = tuple(joints_in_order(read_model(model).skeleton.joint_names))
    return known[model]


def _keys(found: _Found) -> Mapping[str, str] | None:
    if found.footage is None or found.take is None or found.out is None:
        return None
    return stage_keys(found.footage, settings_of(found.take.settings, {}, "The panel"), found.out)


def _look_into_run(found: _Found) -> None:
    try:
        path = found.out / "run.json" if found.out is not None else None
        found.run = read_run(path) if path is not None and path.exists() else None
    except InputError as error:
        found.problem = str(error)


def _sequence(folder: Path, view: Any) -> ImageSequence:
    """An opened view, kept as long as its folder or file does not change."""
    where = (folder / (view.movie or view.images)) if view.movie else (folder / view.images).parent
    try:
        state = where.stat()
    except OSError as error:
        raise InputError(f"The footage of view {view.name} is not at {where.resolve()} any more; move it back, or press {FIND}.") from error
    key = (str(where), view.images, view.movie, state.st_mtime_ns, state.st_size)
    opened = get_session().file.sequences
    if key not in opened:
        if len(opened) > MOST_SEQUENCES:
            opened.clear()
        opened[key] = open_sequence(folder, images=view.images, movie=view.movie, view=view.name)
    return opened[key]
