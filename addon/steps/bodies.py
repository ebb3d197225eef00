"""The unfolded steps: their buttons, the settings that users change often, and all other settings under Advanced."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import bpy

from ...core.foundation.errors import InputError
from ...core.images.interlace import BOTH
from .. import clicks, project, properties
from ..calibrate.panel import draw_calibrate
from ..correcting.panel import draw_dofs
from ..editing import operators as editing
from ..operators import control_rig
from ..panels import expanded, sentence
from ..retarget.panel import draw_retarget
from ..scene import excluded, footage_plane, layers, metaballs, standing
from ..scene.options import POINTS_KEY
from . import check, states, watch
from .person import draw_person
from .states import Fix, Status

OFTEN_CHANGED: dict[str, tuple[tuple[str, str], ...]] = {  # changed often; the others are under Advanced
    "surface": (("method", "preset"), ("surface", "quality"), ("matching", "patch_px"), ("growing", "spacing_px")),
    "tracks": (("tracking", "smooth_frames"), ("tracking", "min_length")),
    "body": (),
}
SHOWS = {"surface": "points", "tracks": "tracks", "body": "body"}  # over the footage


def primary(layout: bpy.types.UILayout, operator: str, is_next: bool, **words: Any) -> Any:
    """The main button of a step; large and highlighted as long as the step is the next one."""
    row = layout.row()
    row.scale_y = 1.5 if is_next else 1.0
    return row.operator(operator, depress=is_next, **words)


def offer(layout: bpy.types.UILayout, operator: str, **words: Any) -> None:
    """A button of another part of the add-on, if that part is registered."""
    if hasattr(bpy.types, "TRICAP_OT_" + operator.removeprefix("tricap.")):
        layout.operator(operator, **words)


def footage(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Add footage or open a take; the list of views; how they were recorded."""
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
    if 0 <= props.view_index < len(props.views):
        pair = layout.column(align=True)
        pair.prop(props.views[props.view_index], "fps")
        pair.prop(props.views[props.view_index], "start_s")
        pair.prop(props.views[props.view_index], "readout_s")
    if len(props.views) > 1:
        layout.operator("tricap.synchronise", icon="TIME")
    draw_person(layout, context)
    _draw_fixes(layout, context, is_next)
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
    """Without footage: save the file, add footage, or open a take."""
    props = context.scene.tricap
    if not bpy.data.filepath and not props.take:
        primary(layout, "wm.save_mainfile", True, text="Save File", icon="FILE_TICK")
    else:
        primary(layout, "tricap.add_footage", not props.take, icon="FILE_MOVIE")
    named = bool(props.take) and (Path(bpy.path.abspath(props.take)) / "take.toml").exists()
    primary(layout, "tricap.open_take", named, icon="FILE_FOLDER")
    layout.prop(props, "take", text="Folder", placeholder="next to this file")


def _draw_fixes(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Buttons that repair what can have happened to the footage."""
    state, scene = watch.current(context.scene).states["footage"], context.scene
    if any(view.clip is None for view in scene.tricap.views) or project.shows_other_fields(scene):
        primary(layout, "tricap.reload_footage", True, icon="FILE_REFRESH")
    elif state.fix == Fix.FIND_FOOTAGE:
        primary(layout, "tricap.find_footage", True, icon="VIEWZOOM")
    elif state.fix == Fix.CHOOSE_TAKE:
        row = layout.row()
        row.operator("tricap.reload_take", icon="FILE_REFRESH")
        row.operator("tricap.keep_mine", icon="FILE_TICK")
    elif state.fix == Fix.COMMON_FRAMES:
        primary(layout, "tricap.common_frames", True, icon="PREVIEW_RANGE")
    elif len(scene.tricap.views) < 2:
        primary(layout, "tricap.add_footage", is_next, icon="FILE_MOVIE")


def cameras(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Cameras from a calibration file or from the scene; the check."""
    column = layout.column()
    column.enabled = project.bound(context.scene)
    primary(column, "tricap.cameras_from_file", is_next, icon="FILE_CACHE")
    column.operator("tricap.cameras_from_scene", icon="OUTLINER_OB_CAMERA")
    now, props = watch.current(context.scene), context.scene.tricap
    if now.states["cameras"].fix == Fix.MATCH_NAMES:
        primary(column, "tricap.match_names", True, icon="SORTALPHA")
    if now.states["cameras"].status == Status.DONE:
        column.operator("tricap.check", icon="VIEWZOOM")
        if props.check_said and props.check_key == now.keys.get("measure"):
            for line in props.check_said.splitlines():
                sentence(column.box(), context, line, "CHECKMARK" if props.check_passed else "INFO")
            check.draw_mends(column, context)


def clicked_views(context: bpy.types.Context) -> list[tuple[str, list[str]]]:
    """Every joint to click, with the views in which it is clicked.

    Raises:
        InputError: a clip was deleted, or there is no such model.
    """
    scene = context.scene
    clips = project.clips_of(scene)
    frame = scene.tricap.seed_frame
    model = project.joints_model(scene)
    wanted = states.joints_of(model) if model else ()
    return [(name, [view for view, clip in clips.items() if clicks.get_click(clip, name, frame) is not None]) for name in wanted]


def _clicks(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """The body, the click frame, the button to click, and the joints with their clicks."""
    props = context.scene.tricap
    layout.prop(props, "model")
    if props.model == "own":
        layout.prop(props, "model_file")
    layout.prop(props, "seed_frame")
    buttons = layout.column()
    buttons.enabled = project.bound(context.scene)
    primary(buttons, "tricap.click_joints", is_next, icon="WINDOW", text="Open Views and Click")
    buttons.operator("tricap.find_joints_with_network", icon="OUTLINER_DATA_MESH", text="Find Joints with a Network…")
    try:
        clicked = clicked_views(context)
    except InputError:
        return  # the step's message has the reason
    header, inside = layout.panel("tricap_joints", default_closed=True)
    header.label(text=f"Joints ({sum(len(views) > 1 for _, views in clicked)} of {len(clicked)} clicked)")
    if inside is None:
        return
    column = inside.column(align=True)
    column.scale_y = 0.8
    for name, views in clicked:
        row = column.row()
        row.label(text=name, icon="CHECKMARK" if len(views) > 1 else "LAYER_USED" if views else "BLANK1")
        row.label(text="  ".join(views))


def surface(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Measure the surface."""
    _stage(layout, context, "surface", "tricap.measure", icon="POINTCLOUD_DATA")


def tracks(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Track points."""
    _stage(layout, context, "tracks", "tricap.track", icon="CURVE_PATH")


def body(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Fit the body, or click the joint that the fit asks for; locked and limited degrees of freedom."""
    asked = watch.current(context.scene).states["body"].click
    if asked is not None:
        button = primary(layout, "tricap.click_joints", True, icon="RESTRICT_SELECT_OFF", text=f"Click {asked[0]} in Frame {asked[1]}")
        button.needed, button.frame = asked
        sentence(layout, context, "After it you may click more joints. With three of shoulders and hips, the fit asks no more.", "INFO")
    _stage(layout, context, "body", "tricap.fit", icon="ARMATURE_DATA")
    if watch.current(context.scene).states["body"].status in (Status.DONE, Status.STALE):
        offer(layout, "tricap.review", icon="VIEWZOOM")
        layout.operator("tricap.open_report", icon="TEXT")
    draw_dofs(layout, context.scene)


def _stage(layout: bpy.types.UILayout, context: bpy.types.Context, step: str, operator: str, icon: str) -> None:
    """The settings that users change often, and the button of this step alone; the one for all remaining steps is at the top."""
    now = watch.current(context.scene).states
    column = layout.column()
    column.use_property_split = False  # leaves the full width for their names
    for group, name in OFTEN_CHANGED[step]:
        column.prop(getattr(context.scene.tricap, group), name)
    row = layout.column()
    row.enabled = now["cameras"].status == Status.DONE
    row.operator(operator, icon=icon)
    if now[step].status in (Status.DONE, Status.STALE):
        layout.operator("tricap.open_views", icon="SEQUENCE", text="Show over Footage").show = SHOWS[step]


def rig(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Build the scene, whose options are in the redo panel (F9); what carries the path; its control rig; show its metaballs."""
    column = layout.column()
    column.enabled = watch.current(context.scene).states["surface"].status != Status.EMPTY or bool(context.scene.tricap.out)
    primary(column, "tricap.build_scene", is_next, icon="OUTLINER_OB_ARMATURE", text="Build Rig and Scene")
    body = next(standing.bodies(context.scene), None)
    if body is not None:
        row = layout.row()
        row.enabled = standing.controls_of_body(body) is None  # a control rig carries the path itself
        row.prop(context.scene.tricap, "path")
        row = layout.row()
        row.enabled = standing.controls_of_body(body) is None
        row.prop(context.scene.tricap, "floor_m")
        control_rig.draw(layout, body)
    edited = next(standing.all_bodies(context.scene), None)
    if edited is not None:
        editing.draw(layout, edited)
    if next(footage_plane.screens(context.scene), None) is not None:
        layout.prop(context.scene.tricap, "render_footage")
    if layers.parts(context.scene):
        layout.prop(context.scene.tricap, "body_layer")
    if edited is not None and excluded.exist(context.scene, POINTS_KEY):
        layout.prop(context.scene.tricap, "show_measured")
    if excluded.exist(context.scene, metaballs.COLLECTION_KEY):
        layout.prop(context.scene.tricap, "show_metaballs")


def retarget(layout: bpy.types.UILayout, context: bpy.types.Context, is_next: bool) -> None:
    """Export; retargeting is a section of its own."""
    props = context.scene.tricap_retarget
    expanded(layout, props, "export_source")
    if props.export_source == "PLAYED":
        layout.prop(props, "export")
    button = layout.operator_menu_enum("tricap.export", "kind", text="Export Motion", icon="EXPORT")
    button.source, button.armature = props.export_source, props.export.name if props.export is not None else ""


DRAW = {
    "footage": footage,
    "cameras": cameras,
    "clicks": _clicks,
    "surface": surface,
    "tracks": tracks,
    "body": body,
    "rig": rig,
    "retarget": retarget,
}


def advanced(layout: bpy.types.UILayout, context: bpy.types.Context, step: str) -> None:
    """The further sections of a step: alternatives, and the settings that are seldom changed."""
    if step == "cameras":
        _section(layout, context, "bar", "Calibrate", draw_calibrate)
    if step == "retarget":
        is_next = watch.current(context.scene).next == step
        draw = partial(draw_retarget, is_next=is_next)
        _section(layout, context, "onto", "Retarget to Character", draw, closed=False)
    if step == "footage":
        _section(layout, context, "where", "Advanced", _where)
    if step in states.STAGE:
        _section(layout, context, f"settings_{step}", "Advanced", lambda inside, _: _settings(inside, context, step))


def _section(layout: bpy.types.UILayout, context: bpy.types.Context, name: str, title: str, draw: Any, *, closed: bool = True) -> None:
    header, inside = layout.panel(f"tricap_{name}", default_closed=closed)
    header.label(text=title)
    if inside is not None:
        inside.enabled = not context.window_manager.tricap.blocks
        inside.use_property_split, inside.use_property_decorate = True, False
        draw(inside, context)


def _where(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    props = context.scene.tricap
    layout.prop(props, "take", text="Project")
    layout.prop(props, "out", placeholder="next to this file or the take")
    layout.prop_search(props, "reference_view", props, "views", icon="CAMERA_DATA")


def _settings(layout: bpy.types.UILayout, context: bpy.types.Context, step: str) -> None:
    """All settings of a step's groups, from their definitions in core."""
    from ...core.run.stages import STAGE_INPUTS

    for group in STAGE_INPUTS[states.STAGE[step]].settings:
        header, inside = layout.panel(f"tricap_group_{group}", default_closed=True)
        header.label(text=group.capitalize())
        if inside is not None:
            inside.use_property_split = False  # leaves the full width for their names
            for field in dataclasses.fields(properties.stages()[group]):
                if (group, field.name) not in OFTEN_CHANGED[step]:
                    inside.prop(getattr(context.scene.tricap, group), field.name)
