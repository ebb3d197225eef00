"""bpy.ops.tricap.check(), .mend_offsets(), .match_names(), .set_fields()

The findings name buttons and settings of the panel, where the command names files and options (`in_panel`).
In the window, the check begins by itself when footage and cameras are there and nothing else runs; it gives way to any other job.
"""

import dataclasses
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import bpy

from ...core.calibration.view_names import names_for_views
from ...core.checking.findings import Cause, Checked
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.geometry.rig import read_rig, renamed
from ...core.images.interlace import BOTH
from ...core.take.bar_file import read_bar
from .. import project, properties
from ..alone import override
from ..jobs import JobOperator
from ..session import get_session
from . import states, watch
from .cameras import use_rig
from .simple_operator import SimpleOperator

GOOD = "No problems found."
OPTION = re.compile(r"--set (\w+)\.(\w+)=([\w.-]*\w)")  # in the advice of a finding
LOOK_S = 2.0  # between two looks whether a check should begin by itself


@dataclass(frozen=True, kw_only=True)
class Mends:
    """What a check found that a press mends; empty where it found nothing."""

    late_frames: Mapping[str, int] = field(default_factory=dict)  # the delay of each view
    camera_of: Mapping[str, str] = field(default_factory=dict)  # the camera that fits each view, where views are swapped
    first_field: str = ""  # where combing was found


def mends_of(checked: Checked) -> Mends:
    """What can be mended of the findings."""
    offsets: Any = checked.figures.get("offsets", {})
    by_cause = {finding.cause: finding.figures for finding in checked.findings}
    return Mends(
        late_frames={view: round(o["late_frames"]) for view, o in offsets.items() if o["late_frames"] is not None},
        camera_of=by_cause.get(Cause.SWAPPED_VIEWS, {}).get("camera_of", {}),
        first_field=str(by_cause[Cause.COMBING]["first_field"] or "odd") if Cause.COMBING in by_cause else "",
    )


def in_panel(checked: Checked, mends: Mends) -> list[str]:
    """The findings as lines for the panel: what a button below mends names that button, and a setting its place in the panel."""
    pressed = {
        Cause.COMBING: SetFields.bl_label if mends.first_field else "",
        Cause.SWAPPED_VIEWS: MatchNames.bl_label if mends.camera_of else "",
        Cause.NOT_SYNCHRONISED: SetOffsets.bl_label if any(mends.late_frames.values()) else "",
    }
    lines = []
    for finding in checked.findings:
        button = pressed.get(finding.cause, "")
        if finding.cause == Cause.NOT_SYNCHRONISED and not mends.late_frames.get(finding.figures.get("view", ""), 0):
            button = ""
        advice = f"Press {button}, and check again." if button else finding.advice
        lines.append(str(replace(finding, advice=OPTION.sub(_named_setting, advice))))
    return [*(lines or [GOOD]), *checked.notes]


def _named_setting(option: re.Match[str]) -> str:
    """An option of the command, `--set matching.patch_px=21`, as the panel shows it: Patch [px] 21 (step 4 Surface)."""
    from ...core.run.stages import STAGE_INPUTS

    group, name, value = option.groups()
    knob = next(field for field in dataclasses.fields(properties.stages()[group]) if field.name == name)
    step = next((step for step, stage in states.STAGE.items() if group in STAGE_INPUTS[stage].settings), "")
    number = states.STEPS.index(step) if step else -1
    place = f" (step {number + 1} {states.TITLES[number]})" if step else ""
    return f"{properties.label(knob)} {value}{place}"


def found(scene: bpy.types.Scene) -> Mends:
    """What the last check of the scene's input found in this session."""
    mends: Mends = get_session().file.mends.get(scene.tricap.check_key, Mends())
    return mends


class Check(JobOperator, bpy.types.Operator):
    """Check whether the footage is synchronized, the cameras fit it, views are swapped, and the clothes have enough texture"""

    bl_idname = "tricap.check"
    bl_label = "Check Footage, Cameras and Sync"
    step = "cameras"
    if_stopped = "Nothing was changed."
    gives_way = True

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], Checked]:
        """The project with the scene's current values."""
        from ...core.run.check import check_take

        folder: Path = project.chosen(context.scene, "", "")[0]
        return lambda monitor: check_take(folder, monitor)

    def finish(self, context: bpy.types.Context, result: Checked) -> set[str]:
        """Store the findings for the panel."""
        props = context.scene.tricap
        mends = mends_of(result)
        props.check_said = "\n".join(in_panel(result, mends))
        props.check_passed = not result.findings
        props.check_key = watch.refresh(context.scene).keys.get("measure", "")
        get_session().file.mends[props.check_key] = mends
        context.window_manager.tricap_steps.cameras = context.window_manager.tricap_steps.cameras or not props.check_passed
        for line in props.check_said.splitlines():
            self.report({"INFO" if props.check_passed else "WARNING"}, line)
        return {"FINISHED"}


class SetOffsets(SimpleOperator, bpy.types.Operator):
    """Set the offsets of the views to those that the check found, in whole frames"""

    bl_idname = "tricap.mend_offsets"
    bl_label = "Set Offsets"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only after a check in this session that found offsets."""
        return any(found(context.scene).late_frames.values())

    def do(self, context: bpy.types.Context) -> str:
        """Set them."""
        late = found(context.scene).late_frames
        for view in context.scene.tricap.views:
            view.offset_frames -= late.get(view.name, 0)
        return "Offsets: " + ", ".join(f"{view.name} {view.offset_frames}" for view in context.scene.tricap.views)


class MatchNames(SimpleOperator, bpy.types.Operator):
    """Give the cameras the names of the views that they fit: as the check found, or as their names or their order say"""

    bl_idname = "tricap.match_names"
    bl_label = "Match Names"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only after a check in this session that found swapped views, or where a view has no camera."""
        now = get_session().file.step_states.get(context.scene.name_full)
        unnamed = now is not None and now.states["cameras"].fix == states.Fix.MATCH_NAMES
        return unnamed or bool(found(context.scene).camera_of)

    def do(self, context: bpy.types.Context) -> str:
        """Rename the cameras in rig.toml; the bar stays with them."""
        path = project.take(context.scene).rig_path
        rig = read_rig(path)
        names = names_for_views(rig, [view.name for view in context.scene.tricap.views])
        names = names or {camera: view for view, camera in found(context.scene).camera_of.items() if view != camera}
        use_rig(context.scene, renamed(rig, names), read_bar(path, rig))
        return "Cameras: " + ", ".join(f"{camera} is {view} now" for camera, view in names.items()) + "."


class SetFields(SimpleOperator, bpy.types.Operator):
    """Measure both fields of the interlaced footage as frames, in the order that the check found"""

    bl_idname = "tricap.set_fields"
    bl_label = "Set Field Order"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only after a check in this session that found combing."""
        return bool(found(context.scene).first_field)

    def do(self, context: bpy.types.Context) -> str:
        """Set them, and show the fields."""
        props = context.scene.tricap
        first = found(context.scene).first_field
        before = props.interlaced, props.first_field
        props.interlaced, props.first_field = BOTH, first
        try:
            project.show_fields(context.scene)
        except InputError:
            props.interlaced, props.first_field = before
            raise
        return f"Both fields are measured, the {'upper' if first == 'odd' else 'lower'} one first: every field is a frame now."


def is_doubtful(scene: bpy.types.Scene) -> bool:
    """Whether the last check found something, with the inputs as they are now."""
    props, now = scene.tricap, watch.current(scene)
    done = now.states["cameras"].status == states.Status.DONE
    return done and bool(props.check_said) and not props.check_passed and props.check_key == now.keys.get("measure")


def draw_mends(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Buttons that mend what the check found."""
    for mend, icon in ((SetFields, "RENDERLAYERS"), (MatchNames, "SORTALPHA"), (SetOffsets, "TIME")):
        if mend.poll(context):
            layout.operator(mend.bl_idname, icon=icon)


def should_begin(scene: bpy.types.Scene) -> bool:
    """Whether the check should begin by itself: with new footage or cameras, before the surface is measured, while nothing runs."""
    session, now = get_session(), get_session().file.step_states.get(scene.name_full)
    if now is None or session.job is not None or session.click_operator is not None or session.file.changed:
        return False
    key = now.keys.get("measure", "")
    if not key or key in session.file.checked_keys or key == scene.tricap.check_key:
        return False
    done, unmeasured = states.Status.DONE, (states.Status.READY, states.Status.EMPTY)
    return now.states["footage"].status == now.states["cameras"].status == done and now.states["surface"].status in unmeasured


def _look() -> float:
    context = bpy.context
    scene, window = context.scene, next(iter(context.window_manager.windows), None)
    if scene is not None and window is not None and not bpy.app.background and should_begin(scene):
        get_session().file.checked_keys.add(watch.current(scene).keys["measure"])
        with override(window=window):
            bpy.ops.tricap.check("INVOKE_DEFAULT")
    return LOOK_S


def begin() -> None:
    """Begin to look whether a check should begin."""
    bpy.app.timers.register(_look, first_interval=LOOK_S, persistent=True)


def end() -> None:
    """Stop looking."""
    bpy.app.timers.unregister(_look)


CLASSES = (Check, SetOffsets, MatchNames, SetFields)
