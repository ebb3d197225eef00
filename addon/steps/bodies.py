"""What each step offers when it is unfolded: the knobs that a person touches, the buttons, and all other knobs under Advanced."""

import dataclasses
from pathlib import Path
from typing import Any

import bpy

from ...core.foundation.errors import InputError
from ...core.images.interlace import BOTH
from ...core.run.stages import STAGE_INPUTS
from .. import clicks, project, properties
from ..calibrate.panel import draw_calibrate
from ..correcting.panel import draw_dofs
from ..panels import sentence
from ..retarget.panel import draw_retarget
from . import check, states, watch
from .person import draw_person

KNOBS: dict[str, tuple[tuple[str, str], ...]] = {  # what a person touches; the others are under Advanced
    "surface": (("matching", "patch_px"), ("growing", "spacing_px")),
    "tracks": (("tracking", "smooth_frames"), ("tracking", "min_length")),
    "body": (),
}
SHOWS = {"surface": "points", "tracks": "tracks", "body": "body"}  # over the footage


def primary(layout: bpy.types.UILayout, operator: str, is_next: bool, **words: Any) -> Any:
    """The step's own button; large and lit as long as it is the next thing to do."""
    row = layout.row()
    row.scale_y = 1.5 if is_next else 1.0
    return row.operator(operator, depress=is_next, **words)


def offer(layout: bpy.types.UILayout, operator: str, **words: Any) -> None:
    """A button of another part of the add-on, where that part is there."""
    if hasattr(bpy.types, "TRICAP_OT_" + operator.removeprefix("tricap.")):
        layout.operator(operator, **words)


def footage(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Add or open; the list of views; how they were recorded."""
    props = context.scene.tricap
    if not project.bound(context.scene):
        _begin(layout, context)
        return
    row = layout.row()
    row.template_list("TRICAP_UL_views", "", props, "views", props, "view_index", rows=3)
    side = row.column(align=True)
    side.operator("tricap.add_footage", text="", icon="ADD")
    side.operator("tricap.remove_view", text="", icon="REMOVE")
    side.operator("tricap.move_view", text="", icon="TRIA_UP").up = True
    side.operator("tricap.move_view", text="", icon="TRIA_DOWN").up = False
    draw_person(layout, context)
    _mend_footage(layout, context, is_next)
    layout.prop(props, "fps")
    layout.prop(props, "interlaced")
    if props.interlaced == BOTH:
        layout.prop(props, "first_field")
    layout.prop(props, "all_frames")
    if not props.all_frames:
        pair = layout.column(align=True)
        pair.prop(props, "first_frame")
        pair.prop(props, "last_frame")


def _begin(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Nothing is there: save, add footage, or open a take."""
    props = context.scene.tricap
    if not bpy.data.filepath and not props.take:
        primary(layout, "wm.save_mainfile", True, text="Save the File", icon="FILE_TICK")
    else:
        primary(layout, "tricap.add_footage", not props.take, icon="FILE_MOVIE")
    named = bool(props.take) and (Path(bpy.path.abspath(props.take)) / "take.toml").exists()
    primary(layout, "tricap.open_take", named, icon="FILE_FOLDER")
    layout.prop(props, "take", text="Folder", placeholder="beside this file")


def _mend_footage(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Buttons for what can have happened to the footage."""
    state, scene = watch.look(context.scene).states["footage"], context.scene
    if any(view.clip is None for view in scene.tricap.views) or project.shows_other_lines(scene):
        primary(layout, "tricap.reload_footage", True, icon="FILE_REFRESH")
    elif states.FIND in state.why:
        primary(layout, "tricap.find_footage", True, icon="VIEWZOOM")
    elif "changed outside" in state.why:
        row = layout.row()
        row.operator("tricap.reload_take", icon="FILE_REFRESH")
        row.operator("tricap.keep_mine", icon="FILE_TICK")
    elif state.word == "failed" and "frame" in state.why:
        primary(layout, "tricap.common_frames", True, icon="PREVIEW_RANGE")
    elif len(scene.tricap.views) < 2:
        primary(layout, "tricap.add_footage", is_next, icon="FILE_MOVIE")


def cameras(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Three ways to cameras."""
    column = layout.column()
    column.enabled = project.bound(context.scene)
    primary(column, "tricap.cameras_from_file", is_next, icon="FILE_CACHE", text="From a Calibration File")
    column.operator("tricap.cameras_from_scene", icon="OUTLINER_OB_CAMERA", text="From This Scene's Cameras")
    now, props = watch.look(context.scene), context.scene.tricap
    if now.states["cameras"].word == "done":
        column.operator("tricap.check", icon="VIEWZOOM")
        if props.check_said and props.check_key == now.keys.get("measure"):
            for line in props.check_said.splitlines():
                sentence(column.box(), context, line, "CHECKMARK" if line == check.GOOD else "INFO")
            if "offset" in props.check_said:
                column.operator("tricap.mend_offsets", icon="TIME")


def seeds_of(context: bpy.types.Context) -> list[tuple[str, list[str]]]:
    """Every joint to click, with the views in which it is clicked.

    Raises:
        InputError: a clip was deleted, or there is no such model.
    """
    scene = context.scene
    clips = project.clips_of(scene)
    frame = scene.tricap.seed_frame
    model = project.body_model(scene)
    wanted = states.joints_of(model) if model else ()
    return [(name, [view for view, clip in clips.items() if clicks.get_click(clip, name, frame) is not None]) for name in wanted]


def _seeds(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Which body, in which frame; the views to click in; what is clicked."""
    props = context.scene.tricap
    layout.prop(props, "model")
    if props.model == "own":
        layout.prop(props, "model_file")
    layout.prop(props, "seed_frame", text="Click in Frame")
    buttons = layout.column()
    buttons.enabled = project.bound(context.scene)
    primary(buttons, "tricap.click_joints", is_next, icon="WINDOW", text="Open the Views and Click")
    try:
        clicked = seeds_of(context)
    except InputError:
        return  # the step's sentence says it
    column = layout.column(align=True)
    column.scale_y = 0.8
    for name, views in clicked:
        row = column.row()
        row.label(text=name, icon="CHECKMARK" if len(views) > 1 else "LAYER_USED" if views else "BLANK1")
        row.label(text="  ".join(views))


def surface(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Measure."""
    _stage(layout, context, "surface", "tricap.measure", is_next, icon="POINTCLOUD_DATA")


def tracks(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Follow."""
    _stage(layout, context, "tracks", "tricap.track", is_next, icon="CURVE_PATH")


def body(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Fit; what is locked or limited."""
    _stage(layout, context, "body", "tricap.fit", is_next, icon="ARMATURE_DATA")
    draw_dofs(layout, context.scene)


def _stage(layout: bpy.types.UILayout, context: bpy.types.Context, step: str, operator: str, is_next: bool, icon: str) -> None:
    now = watch.look(context.scene).states
    column = layout.column()
    column.use_property_split = False  # the whole width for their names
    for group, name in KNOBS[step]:
        column.prop(getattr(context.scene.tricap, group), name)
    row = layout.column()
    row.enabled = now["cameras"].word == "done"
    primary(row, operator, is_next, icon=icon)
    if now[step].word in ("done", "stale"):
        layout.operator("tricap.open_views", icon="SEQUENCE", text="Show It over the Footage").show = SHOWS[step]


def rig(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Build; options are offered after it (F9)."""
    column = layout.column()
    column.enabled = watch.look(context.scene).states["surface"].word != "empty" or bool(context.scene.tricap.out)
    primary(column, "tricap.build_scene", is_next, icon="OUTLINER_OB_ARMATURE", text="Build Rig and Scene")


def retarget(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Onto another rig, or into a file."""
    row = layout.row()
    row.operator_menu_enum("tricap.export", "kind", text="Export the Motion", icon="EXPORT")


DRAW = {
    "footage": footage,
    "cameras": cameras,
    "seeds": _seeds,
    "surface": surface,
    "tracks": tracks,
    "body": body,
    "rig": rig,
    "retarget": retarget,
}


def advanced(layout: bpy.types.UILayout, context: bpy.types.Context, step: str) -> None:
    """The further sections of a step: other ways, and all the knobs that a person seldom touches."""
    if step == "cameras":
        _section(layout, context, "bar", "From a Waved Bar", draw_calibrate)
    if step == "retarget":
        _section(layout, context, "onto", "Onto a Character", draw_retarget, closed=False)
    if step == "footage":
        _section(layout, context, "where", "Advanced", _where)
    if step in states.STAGE:
        _section(layout, context, f"knobs_{step}", "Advanced", lambda inside, _: _knobs(inside, context, step))


def _section(layout: bpy.types.UILayout, context: bpy.types.Context, name: str, title: str, draw: Any, *, closed: bool = True) -> None:
    header, inside = layout.panel(f"tricap_{name}", default_closed=closed)
    header.label(text=title)
    if inside is not None:
        inside.enabled = not context.window_manager.tricap.running
        inside.use_property_split, inside.use_property_decorate = True, False
        draw(inside, context)


def _where(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    props = context.scene.tricap
    layout.prop(props, "take", text="Project")
    layout.prop(props, "out", placeholder="beside this file or the take")
    layout.prop_search(props, "reference_view", props, "views", icon="CAMERA_DATA")


def _knobs(layout: bpy.types.UILayout, context: bpy.types.Context, step: str) -> None:
    """All the knobs of a step's groups, made from core's definitions."""
    for group in STAGE_INPUTS[states.STAGE[step]].settings:
        header, inside = layout.panel(f"tricap_group_{group}", default_closed=True)
        header.label(text=group.capitalize())
        if inside is not None:
            inside.use_property_split = False  # the whole width for their names
            for field in dataclasses.fields(properties.stages()[group]):
                if (group, field.name) not in KNOBS[step]:
                    inside.prop(getattr(context.scene.tricap, group), field.name)
