"""How well the body's places are known, on demand: strips for trunk and limbs at the lower edge of the timeline, Dope Sheet and Graph
Editor, and bones coloured in the 3-D view; with a legend, except in a low timeline. The colours are those of the report: blue up to a
millimetre, red from 5 cm.
"""

import re
from collections.abc import Collection

import bpy
import numpy as np

from ...core.body.sigma_colours import SIGMAS_MM, sigma_colours
from ..overlay import canvas
from ..scene import standing
from ..session import get_session
from .curves import keys_of, sigma_curves

STRIP_PX, RULER_PX, OPACITY, BONE_PX = 11.0, 26.0, 0.9, 6.0  # the ruler with the frames stays free
NAME_PX, NAME_GAP_PX = 9.0, 4.0
LEGEND_PX, MARGIN_PX, SHADES = 150.0, 14.0, 48
HIGH_PX = 160.0  # an editor in which there is room for a legend over the strips
TITLE = "Sigma of the joints"
LACKING = "This body has no sigmas of its joints: press Build Rig and Scene again"
CONTROL = re.compile(r"_(fk|ik)(?=\.|$)")  # of the names of controls
EDITORS = ("SpaceDopeSheetEditor", "SpaceGraphEditor")

Sigmas = dict[str, tuple[np.ndarray, np.ndarray]]  # by bone: frames (T,), and how well its place is known in them (T,) [mm]


def sigmas_of(body: bpy.types.Object) -> Sigmas:
    """How well the places of a body's bones are known; empty where a scene of an earlier version does not have it."""
    curves = sigma_curves(body)
    named = {bone.name: curves[f"sigma {bone.name}"] for bone in body.pose.bones if f"sigma {bone.name}" in curves}
    keys = {name: keys_of(curve) for name, curve in named.items() if len(curve.keyframe_points)}
    return {name: (frames, 1e3 * sigma) for name, (frames, sigma) in keys.items()}


def colour_of(sigma_mm: np.ndarray) -> np.ndarray:
    """Colours (N, 4) of sigmas (N,)."""
    return np.concatenate([sigma_colours(sigma_mm) / 255, np.full((len(sigma_mm), 1), OPACITY)], axis=1)


def of_frames(sigmas: Sigmas, bones: Collection[str]) -> tuple[np.ndarray, np.ndarray]:
    """Frames (T,) and in each the largest sigma (T,) of some bones."""
    chosen = [sigmas[name] for name in bones if name in sigmas]
    frames = np.unique(np.concatenate([at for at, _ in chosen])) if chosen else np.zeros(0)
    values = np.zeros((len(chosen), len(frames)))
    for row, (at, sigma) in enumerate(chosen):
        values[row, np.searchsorted(frames, at)] = sigma
    return frames, values.max(axis=0, initial=0.0)


def strips(body: bpy.types.Object, sigmas: Sigmas, chosen: Collection[str], most: int) -> dict[str, list[str]]:
    """The bones of each strip by its name, lowest first: those that are chosen, or else trunk and limbs, as in the bone collections; the
    whole body where there is no room for so many strips."""
    if any(name in sigmas for name in chosen):
        return {"Selected bones": [name for name in chosen if name in sigmas]}
    found: dict[str, list[str]] = {}
    for group in body.data.collections:
        if names := [bone.name for bone in group.bones if bone.name in sigmas]:
            found[group.name] = names
    return dict(reversed(found.items())) if len(found) <= most else {"Least known": list(sigmas)}


def begin() -> None:
    """Add the draw handlers."""
    handles = get_session().uncertainty_handles
    for editor in EDITORS:
        space = getattr(bpy.types, editor)
        handles.append((space, space.draw_handler_add(_draw_strip, (), "WINDOW", "POST_PIXEL")))
    for draw, when in ((_draw_bones, "POST_VIEW"), (_draw_legend, "POST_PIXEL")):
        handles.append((bpy.types.SpaceView3D, bpy.types.SpaceView3D.draw_handler_add(draw, (), "WINDOW", when)))


def end() -> None:
    """Remove them."""
    handles = get_session().uncertainty_handles
    for space, handle in handles:
        space.draw_handler_remove(handle, "WINDOW")
    handles.clear()


def redraw(context: bpy.types.Context) -> None:
    """Draw the editors again that show it."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "DOPESHEET_EDITOR", "GRAPH_EDITOR"):
                area.tag_redraw()


def forget() -> None:
    """Read the sigmas again when they are shown next: they have changed."""
    get_session().file.uncertainty = ((), None)
    redraw(bpy.context)


def _shown() -> tuple[bpy.types.Object, Sigmas] | None:
    """The body whose uncertainty is shown, and its sigmas, which are read once."""
    scene = bpy.context.scene
    if not scene.tricap.show_uncertainty:
        return None
    body = next(standing.all_bodies(scene), None)
    if body is None:
        return None
    actions = [s.action for t in body.animation_data.nla_tracks for s in t.strips] if body.animation_data is not None else []
    key = (body.session_uid, *(action.session_uid for action in actions if action is not None))
    file = get_session().file
    if file.uncertainty[0] != key:
        file.uncertainty = key, sigmas_of(body)
    return body, file.uncertainty[1]


def _draw_strip() -> None:
    found, region = _shown(), bpy.context.region
    if found is None:
        return
    body, sigmas = found
    scale, y = bpy.context.preferences.system.ui_scale, 0.0
    most = int((region.height / scale - RULER_PX) // STRIP_PX)
    playhead = region.view2d.view_to_region(bpy.context.scene.frame_current_final, 0.0, clip=False)[0]
    for name, bones in strips(body, sigmas, chosen_bones(body), most).items():
        _draw_row(region, *of_frames(sigmas, bones), y, (STRIP_PX - 1.0) * scale)
        width = canvas.text_width(name, size=NAME_PX)
        canvas.text(name, name_x(width, playhead, NAME_GAP_PX * scale), y + 1.5 * scale, size=NAME_PX)
        y += STRIP_PX * scale
    if not sigmas:
        canvas.text(LACKING, MARGIN_PX * scale, 4 * scale, size=11)
    elif region.height > HIGH_PX * scale:
        _draw_colours(region.width - (LEGEND_PX + 2 * MARGIN_PX) * scale, y + MARGIN_PX * scale)


def _draw_row(region: bpy.types.Region, frames: np.ndarray, sigma_mm: np.ndarray, y: float, height: float) -> None:
    left, right = (region.view2d.region_to_view(x, 0.0)[0] for x in (0.0, region.width))
    seen = np.flatnonzero((frames > left - 1) & (frames < right + 1))
    if not len(seen):
        return
    pixels = region.width / (right - left)
    boxes = np.concatenate([canvas.rectangle((frame - 0.5 - left) * pixels, y, max(pixels, 1.0), height) for frame in frames[seen]])
    canvas.fill_each(boxes, np.repeat(colour_of(sigma_mm[seen]), 2, axis=0))


def name_x(width: float, playhead: float, gap: float) -> float:
    """Where a strip's name begins: at the left edge, or right of the playhead if that would lie over it."""
    return playhead + gap if 0.0 <= playhead <= gap + width + gap else gap


def chosen_bones(body: bpy.types.Object) -> set[str]:
    """The bones of a body that are selected in Pose Mode, or whose controls are."""
    posed = [thing for thing in (body, standing.controls_of_body(body)) if thing is not None and thing.mode == "POSE"]
    return {CONTROL.sub("", bone.name) for bone in bpy.context.selected_pose_bones or () if bone.id_data in posed}


def bones_drawn(body: bpy.types.Object, sigmas: Sigmas, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Ends (B, 2, 3) and sigmas (B,) of the bones that have one in a frame, which is shown; none if neither the body nor its control rig
    is visible. The body's own bones lie within the controls, also while they are hidden."""
    rig, ends, sigma = standing.controls_of_body(body), [], []
    visible = body.visible_get() or (rig is not None and rig.visible_get())
    for name, (frames, of_bone) in sigmas.items() if visible else ():
        bone, row = body.pose.bones.get(name), int(np.searchsorted(frames, frame))
        if bone is not None and row < len(frames) and frames[row] == frame and name != standing.ROOT:
            ends.append([body.matrix_world @ bone.head, body.matrix_world @ bone.tail])
            sigma.append(of_bone[row])
    return np.array(ends).reshape(-1, 2, 3), np.array(sigma)


def _draw_bones() -> None:
    found = _shown()
    if found is None or not bpy.context.space_data.overlay.show_overlays:
        return
    ends, sigma = bones_drawn(*found, bpy.context.scene.frame_current)
    if len(ends):
        canvas.draw_lines_in_space(ends, colour_of(sigma), BONE_PX)


def _draw_legend() -> None:
    found = _shown()
    if found is None or not bpy.context.space_data.overlay.show_overlays:
        return
    scale, region = bpy.context.preferences.system.ui_scale, bpy.context.region
    width, y = LEGEND_PX * scale, MARGIN_PX * scale
    x = (region.width - width) / 2  # tools and sidebar may lie over both edges
    if not found[1]:
        canvas.text(LACKING, x - width / 2, y, size=11)
        return
    _draw_colours(x, y)


def _draw_colours(x: float, y: float) -> None:
    shades = sigma_colours(np.geomspace(SIGMAS_MM[0], SIGMAS_MM[-1], SHADES)) / 255
    width = LEGEND_PX * bpy.context.preferences.system.ui_scale
    canvas.colour_bar(shades, [f"{value:g} mm" for value in SIGMAS_MM], TITLE, x, y, width)
