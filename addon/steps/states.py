"""The state of every step, computed from the scene and the files on disk; nothing is changed here.

Each state has a message of one sentence: a summary, the reason, or what to do.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum
from pathlib import Path
from typing import Any

import bpy

from ...core.body.model_file import read_model
from ...core.body.motion import GUESSED, INFERRED
from ...core.foundation.bounded import real_path
from ...core.foundation.errors import InputError
from ...core.geometry.rig import read_rig
from ...core.images.sequence import ImageSequence, open_sequence
from ...core.results.run_json import read_run
from ...core.run.settings import settings_of
from ...core.take.clicked_points import clicked_depth
from ...core.take.footage import Footage, footage_frames, open_take
from ...core.take.take import AUTO_BODY, START_ALONE, Take
from .. import folders, project
from ..clicking.click_session import joints_of as joints_in_order
from ..scene import stored
from ..scene.options import KEYS_KEY, OUT_KEY
from ..session import get_session

STEPS = ("footage", "cameras", "clicks", "surface", "tracks", "body", "rig", "retarget")
TITLES = ("Footage", "Cameras", "Joint Clicks", "Surface", "Tracks", "Body", "Rig", "Retarget and Export")
STAGE = {"surface": "measure", "tracks": "track", "body": "fit"}  # the stage of the pipeline that a step runs
WRITES = {"surface": "clouds", "tracks": "trajectories.npz", "body": "motion.csv"}
SAVE_FIRST = "Save the Blender file first: the project folder is created next to it. Then add the footage of your cameras."
OUTDATED = "Inputs have changed since this step ran. Run it again."
DOUBTFUL_SHARE = 0.5  # of the frames: a body of which a limb is guessed in more
NEEDED_JOINTS = 2  # the fewest that the fit accepts
CACHED_CLICKS = 500  # joints whose clicks are remembered as checked
CACHED_SEQUENCES = 50


class Status(StrEnum):
    """Where a step is."""

    EMPTY = "empty"  # an earlier step comes first
    READY = "ready"
    RUNNING = "running"
    DONE = "done"
    STALE = "stale"  # done, but with other inputs
    ASKS = "asks"  # the fit asks for a click
    FAILED = "failed"


class Fix(Enum):
    """What repairs a failed step."""

    FIND_FOOTAGE = "find footage"
    CHOOSE_TAKE = "choose take"  # the one on disk or the scene's
    COMMON_FRAMES = "common frames"
    MATCH_NAMES = "match names"


class FixableError(InputError):
    """Something that the panel has a button for."""

    def __init__(self, message: str, fix: Fix) -> None:
        super().__init__(message)
        self.fix = fix


@dataclass(frozen=True, kw_only=True)
class State:
    """The status of a step, the sentence that explains it, and what repairs it if it failed."""

    status: Status
    message: str = ""
    fix: Fix | None = None
    click: tuple[str, int] | None = None  # the joint and the frame whose click the fit asks for
    doubtful: bool = False  # done, but what it found can hardly be right


@dataclass(frozen=True, kw_only=True)
class StepStates:
    """The states of all steps, and the keys of the inputs of every stage."""

    states: Mapping[str, State]
    keys: Mapping[str, str]

    @property
    def next(self) -> str | None:
        """The first step that is not done."""
        if self.states["footage"].status == Status.EMPTY:
            return "footage"
        return next((step for step in STEPS if self.states[step].status in (Status.READY, Status.STALE, Status.ASKS, Status.FAILED)), None)

    @property
    def can_run(self) -> bool:
        """Whether the remaining steps can be run: the next one computes, and waits for no click."""
        return self.next in STAGE and self.states[self.next].status != Status.ASKS


@dataclass(kw_only=True)
class _Project:
    """What later steps need from earlier ones."""

    take: Take | None = None
    sequences: tuple[ImageSequence, ...] = ()
    frames: range = range(0)
    footage: Footage | None = None
    keys: Mapping[str, str] | None = None
    run: Mapping[str, Any] | None = None
    problem: str = ""  # why run.json cannot be read
    out: Path | None = None
    frames_again: str = ""  # fitted again to the clicks as they are now
    nobody_found: bool = False  # by the fit, which began without clicks


def compute(scene: bpy.types.Scene) -> StepStates:
    """The states of all steps now; takes a few milliseconds."""
    found = _Project()
    states: dict[str, State] = {}
    for step, compute_step in (("footage", _footage), ("cameras", _cameras), ("clicks", _clicks)):
        states[step] = _or_failed(compute_step, scene, found)
    found.out = _or_none(lambda: folders.output_folder("", scene))
    _read_run(found)
    found.keys = _or_none(lambda: _keys(found))
    for step in STAGE:
        states[step] = _stage(step, states, found)
    if found.nobody_found and states["clicks"].status == Status.DONE:
        states["clicks"] = State(status=Status.ASKS, message=_where_to_click(found))
    states["rig"] = _rig(scene, states, found)
    states["retarget"] = _retarget(scene, states["rig"])
    return StepStates(states=states, keys=found.keys or {})


def _or_failed(compute_step: Any, scene: bpy.types.Scene, found: _Project) -> State:
    try:
        return compute_step(scene, found)
    except InputError as error:
        return State(status=Status.FAILED, message=str(error), fix=error.fix if isinstance(error, FixableError) else None)


def _or_none(make: Any) -> Any:
    """None where an earlier step is not done; that step's message has the reason."""
    try:
        return make()
    except InputError:
        return None


def _footage(scene: bpy.types.Scene, found: _Project) -> State:
    props = scene.tricap
    if not project.bound(scene):
        if props.take and (project.existing_folder(scene) / "take.toml").exists():
            return State(status=Status.READY, message="Press Open Take to show its footage.")
        if problem := get_session().file.take_problem:
            return State(status=Status.EMPTY, message=problem)
        if not props.take and not bpy.data.filepath:
            return State(status=Status.EMPTY, message=SAVE_FIRST)
        return State(status=Status.EMPTY, message="Add the movies or image folders of your cameras.")
    folder = project.existing_folder(scene)
    if project.changed_outside(scene):
        raise FixableError(project.CHANGED_OUTSIDE, Fix.CHOOSE_TAKE)
    if len(props.views) < 2:
        return State(status=Status.READY, message="Add the footage of a second camera.")
    if project.shows_other_fields(scene):
        raise InputError(project.OTHER_FIELDS)
    take = project.take(scene)
    found.sequences = tuple(_sequence(folder, view) for view in take.views)
    spans = [(-view.offset_frames, s.count - view.offset_frames) for view, s in zip(take.views, found.sequences)]
    if take.frames is None and len({stop for _, stop in spans}) > 1 and not any(view.has_clock for view in take.views):
        ends = ", ".join(f"{view.name} ends with frame {stop - 1}" for view, (_, stop) in zip(take.views, spans))
        raise FixableError(f"The views differ in length: {ends}. Press Use Common Frames, or correct the offsets.", Fix.COMMON_FRAMES)
    try:
        found.frames, found.take = footage_frames(take, found.sequences), take
    except InputError as error:
        raise FixableError(str(error), Fix.COMMON_FRAMES) from error
    sizes = " and ".join(sorted({f"{view.clip.size[0]}×{view.clip.size[1]}" for view in props.views}))
    rate = f"{round(props.fps * project.fields_of(scene).per_image, 3):g} fps"
    doubt = f" Images have no frame rate; {rate} is assumed. Enter FPS." if is_rate_assumed(scene) else ""
    return State(status=Status.DONE, message=f"{len(take.views)} views, {len(found.frames)} frames of {sizes} pixels, {rate}.{doubt}")


def is_rate_assumed(scene: bpy.types.Scene) -> bool:
    """Whether the frame rate is one that nobody entered, and that the footage does not have."""
    return not scene.tricap.is_property_set("fps") and any(view.images for view in scene.tricap.views)


def _cameras(scene: bpy.types.Scene, found: _Project) -> State:
    if found.take is None:
        return State(status=Status.EMPTY, message="Add the footage first.")
    path = found.take.rig_path
    if not path.exists():
        return State(status=Status.READY, message="Import a calibration file, or calibrate with a wand or board.")
    rig = read_rig(path)
    names = [camera.name for camera in rig.cameras]
    if lost := [view.name for view in scene.tricap.views if view.name not in names]:
        message = (
            f"No camera is called {' or '.join(lost)}; the calibration has {', '.join(names)}. Press Match Names, or rename the views."
        )
        raise FixableError(message, Fix.MATCH_NAMES)
    for view in scene.tricap.views:
        size = rig[view.name].size_px
        if tuple(view.clip.size) != size:
            raise InputError(
                f"Camera {view.name} was calibrated with images of {size[0]}×{size[1]} pixels, its footage has "
                f"{view.clip.size[0]}×{view.clip.size[1]}. Use the footage at the size at which it was calibrated."
            )
    sigma_px = settings_of(found.take.settings, {}, "The panel")["fitting"].click_sigma_px
    found.footage = open_take(found.take, found.sequences, click_sigma_px=sigma_px)
    return State(status=Status.DONE, message=f"{len(found.footage.rig.cameras)} cameras, one for each view.")


def _clicks(scene: bpy.types.Scene, found: _Project) -> State:
    take = found.take
    if take is None:
        return State(status=Status.EMPTY, message="Add the footage first.")
    if take.body_model is None:
        return State(status=Status.DONE, message="No body is fitted: surface and tracks need no clicks.")
    if take.keypoints:
        return State(status=Status.DONE, message="The take has keypoints of another system; clicks are optional.")
    wanted = joints_of(str(take.joints_model))
    clicked = take.clicks.joints
    if found.footage is not None:
        _check_clicks(found.footage)
    complete = [name for name in wanted if len(clicked.get(name, {})) >= 2]
    if take.body_model in START_ALONE and len(complete) < len(wanted):
        others = f"{len(complete)} of {len(wanted)} joints are clicked, the others are" if complete else "The joints are"
        part = "" if take.body_model == AUTO_BODY else " Choose another Body if only a part of the person is filmed."
        message = f"{others} found by the fit, which asks for a click where it is not certain.{part}"
        return State(status=Status.DONE, message=message)
    if len(complete) < min(NEEDED_JOINTS, len(wanted)):
        return State(status=Status.READY, message=f"Click each joint in at least two views: {len(complete)} of {len(wanted)} so far.")
    missing = [name for name in wanted if name not in complete]
    if missing:
        message = f"{len(complete)} of {len(wanted)} joints are clicked. Click {_and_others(missing)} for a more reliable fit."
        return State(status=Status.DONE, message=message)
    return State(status=Status.DONE, message=f"All {len(wanted)} joints are clicked.")


def _and_others(names: list[str]) -> str:
    return " and ".join(names) if len(names) < 3 else f"{names[0]}, {names[1]} and others"


def _check_clicks(footage: Footage) -> None:
    """Check that the rays of each joint's clicks intersect; the answer is remembered for the same clicks and cameras.

    Raises:
        InputError: those of a joint do not.
    """
    take, rig = footage.take, footage.take.rig_path.stat()
    problems = get_session().file.click_problems
    for name, at in take.clicks.joints.items():
        clicks = tuple((view, *xy.tolist()) for view, xy in sorted(at.items()))
        key = (take.rig_path, rig.st_mtime_ns, rig.st_size, take.reference, name, clicks, footage.click_sigma_px)
        if key not in problems:
            if len(problems) > CACHED_CLICKS:
                problems.clear()
            try:
                clicked_depth(footage, name, at)
                problems[key] = ""
            except InputError as error:
                problems[key] = str(error)
        if problems[key]:
            raise InputError(problems[key])


def _stage(step: str, states: Mapping[str, State], found: _Project) -> State:
    if states["footage"].status != Status.DONE or states["cameras"].status != Status.DONE or found.keys is None:
        return State(status=Status.EMPTY, message="Footage and cameras come first.")
    if step == "body" and found.take is not None and found.take.body_model is None:
        return State(status=Status.EMPTY, message="No body is chosen in step 3.")
    if found.problem:
        first = step == "surface"
        return State(status=Status.FAILED if first else Status.EMPTY, message=found.problem if first else "Measure the surface first.")
    stage = STAGE[step]
    entry = (found.run or {}).get("stages", {}).get(stage)
    if entry is None or found.out is None or not (found.out / WRITES[step]).exists() and "not_done" not in entry:
        if step == "body" and states["clicks"].status != Status.DONE:
            return State(status=Status.EMPTY, message="Click the joints first (step 3).")
        before = states[STEPS[STEPS.index(step) - 1]].status if step != "surface" else Status.DONE
        return State(status=Status.READY if before == Status.DONE else Status.EMPTY, message=_READY[step])
    if entry.get("key") != found.keys[stage]:
        found.frames_again = _frames_again(found, entry) if step == "body" else ""
        again = f"Frames {found.frames_again} were fitted again to your clicks. Fit Body also adjusts the shape and all other frames."
        return State(status=Status.STALE, message=again if found.frames_again else OUTDATED)
    if "not_done" in entry and step != "body":
        return State(status=Status.DONE, message=f"Skipped: {entry['not_done']}.")
    if "not_done" in entry:
        found.nobody_found = True
        return State(status=Status.EMPTY, message=f"No body was fitted: {entry['not_done']}. Click joints first (step 3).")
    return State(status=Status.DONE, message=_figures(step, entry), doubtful=_is_doubtful(step, entry))


def _frames_again(found: _Project, fit: Mapping[str, Any]) -> str:
    """The frames that *Fit Again* fitted to the clicks as they are now, in words; "" if more than these clicks has changed."""
    if not fit.get("fitted_again") or found.footage is None or found.take is None or found.out is None:
        return ""
    from ...core.run.around_clicks import frames_again

    return frames_again(fit, found.footage, settings_of(found.take.settings, {}, "The panel"), found.out)


_READY = {
    "surface": "Measure the surface of the person in every frame.",
    "tracks": "Track points of the surface through all frames.",
    "body": "Fit skeleton and body shape to surface and tracks.",
}


def _where_to_click(found: _Project) -> str:
    """What to click where the fit does not find the person."""
    whole = found.take is not None and found.take.body_model in START_ALONE
    what = "three joints of the trunk (shoulders, hips, neck, pelvis)" if whole else "two joints of the limb"
    other = ", or choose the limb that is filmed as Body and click its joints" if whole else ""
    return f"The fit does not find the person by itself. Click at least {what} in two views each{other}; then run the fit again."


def _is_doubtful(step: str, entry: Mapping[str, Any]) -> bool:
    """Whether a stage ended with figures that can hardly be right."""
    from ...core.checking.take_check import DOUBTFUL_RESIDUAL_PX

    if step == "surface":
        return bool(entry["residual_px"] > DOUBTFUL_RESIDUAL_PX)
    if step == "tracks":
        return bool(entry["trajectories"] == 0)
    guessed = max((counts.get(GUESSED, 0) for counts in entry.get("limbs", {}).values()), default=0)
    return bool(guessed > DOUBTFUL_SHARE * sum(entry["frames"].values()))


def _figures(step: str, entry: Mapping[str, Any]) -> str:
    if step == "surface":
        doubt = " Rays miss each other by {:.1f} px: check the cameras, the offsets, and whether views are swapped."
        missed = doubt.format(entry["residual_px"]) if _is_doubtful(step, entry) else ""
        return f"{entry['points_per_frame']:.0f} points per frame, accurate to {entry['sigma_mm']:.2f} mm (1 sigma).{missed}"
    if step == "tracks" and _is_doubtful(step, entry):
        return "No trajectory is left after the filters: is there enough texture, and is the surface right?"
    if step == "tracks":
        return f"{entry['trajectories']} trajectories, {entry['mean_length_frames']:.0f} frames long on average."
    text = f"{sum(entry['frames'].values())} frames, joints accurate to {entry['joint_sigma_mm']:.1f} mm (1 sigma)."
    if "chosen_model" in entry:
        text += f" The body is “{entry['chosen_model']}”, chosen automatically."
    for word in (GUESSED, INFERRED):
        limbs = {limb: n for limb, counts in entry.get("limbs", {}).items() if (n := counts.get(word, 0))}
        listed = ", ".join(f"{limb} in {n:.0f} {'frame' if n == 1 else 'frames'}" for limb, n in limbs.items())
        text += f" {word.capitalize()}: {listed}." if limbs else ""
    return text


def _rig(scene: bpy.types.Scene, states: Mapping[str, State], found: _Project) -> State:
    built = next((c for c in scene.collection.children_recursive if OUT_KEY in c), None)
    last = "tracks" if found.take is not None and found.take.body_model is None else "body"
    so_far = built is not None and STAGE[last] not in stored.table(built, KEYS_KEY) and not _has_armature(built)
    if built is None or (so_far and found.take is not None and states[last].status != Status.STALE):
        if states[last].status != Status.DONE:
            return State(status=Status.EMPTY, message=f"Finish step {STEPS.index(last) + 1} first.")
        return State(status=Status.READY, message="Build armature, skin and cameras in this scene.")
    moving = _has_armature(built)
    if states["body"].status == Status.DONE and not moving:
        return State(status=Status.STALE, message="The body's armature is missing from the scene. Build it again.")
    now = found.keys or {}
    if found.keys is not None and any(now.get(stage) != key for stage, key in stored.table(built, KEYS_KEY).items()):
        again = f"The scene plays frames {found.frames_again} as they were fitted again. After Fit Body, build it again."
        earlier = "The scene shows an earlier result. Run the steps before, then build it again."
        return State(status=Status.STALE, message=again if found.frames_again else earlier)
    if found.keys is not None and lacks_results(built, found):
        return State(status=Status.STALE, message="There are results that the scene does not show yet. Build it again.")
    return State(status=Status.DONE, message="The armature plays the motion." if moving else "Surface and tracks are in the scene.")


def _has_armature(built: bpy.types.Collection) -> bool:
    return any(thing.type == "ARMATURE" for thing in built.all_objects)


def lacks_results(built: bpy.types.Collection, found: _Project) -> bool:
    """Whether a stage has results that the built scene lacks."""
    done = {s for s, entry in (found.run or {}).get("stages", {}).items() if s in STAGE.values() and "not_done" not in entry}
    return bool(done - set(stored.table(built, KEYS_KEY))) and OUT_KEY in built and str(found.out) == built[OUT_KEY]


def _retarget(scene: bpy.types.Scene, rig: State) -> State:
    if rig.status in (Status.EMPTY, Status.READY):
        return State(status=Status.EMPTY, message="Build the rig first.")
    props = scene.tricap_retarget
    if props.last_export or props.last:
        status = Status.STALE if rig.status == Status.STALE else Status.DONE
        return State(status=status, message=props.last_export or "The character plays the motion.")
    return State(status=Status.READY, message="Retarget the motion to your own character, or export it.")


def joints_of(model: str) -> tuple[str, ...]:
    """The joints of a body model that the user is asked to click.

    Raises:
        InputError: there is no such model.
    """
    known = get_session().file.joints
    if model not in known or model.endswith(".toml"):  # a file may change
        known[model] = tuple(joints_in_order(read_model(model).skeleton.joint_names))
    return known[model]


def _keys(found: _Project) -> Mapping[str, str] | None:
    if found.footage is None or found.take is None or found.out is None:
        return None
    from ...core.run.file_digests import FileDigests, reads_content
    from ...core.run.stages import known_keys, stage_keys

    footage, out, file = found.footage, found.out, get_session().file
    settings = settings_of(found.take.settings, {}, "The panel")

    def by_content() -> Mapping[str, str]:
        if not reads_content(footage):
            return {}
        file.digests = file.digests or FileDigests()
        return stage_keys(footage, settings, out, file.digests.stamp)

    return known_keys(stage_keys(footage, settings, out), found.run or {}, by_content)


def _read_run(found: _Project) -> None:
    try:
        path = found.out / "run.json" if found.out is not None else None
        found.run = read_run(path) if path is not None and path.exists() else None
    except InputError as error:
        found.problem = str(error)


def _sequence(folder: Path, view: Any) -> ImageSequence:
    """An opened view, cached until its folder or file changes."""
    where = (folder / (view.movie or view.images)) if view.movie else (folder / view.images).parent
    try:
        state = where.stat()
    except OSError as error:
        message = f"The footage of view {view.name} is no longer at {real_path(where)}. Move it back, or press Find Footage."
        raise FixableError(message, Fix.FIND_FOOTAGE) from error
    key = (str(where), view.images, view.movie, state.st_mtime_ns, state.st_size)
    opened = get_session().file.sequences
    if key not in opened:
        if len(opened) > CACHED_SEQUENCES:
            opened.clear()
        opened[key] = open_sequence(folder, images=view.images, movie=view.movie, view=view.name)
    return opened[key]
