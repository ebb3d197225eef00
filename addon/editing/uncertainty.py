"""The uncertainty of the body's motion, on demand: a coloured strip at the lower edge of the timeline, Dope Sheet and Graph Editor, and
bones coloured by their sigma in the 3-D view. Colours: green where certain, by yellow to red at 10°.
"""

import re

import bpy
import numpy as np

from ..overlay import canvas
from ..scene import standing
from ..scene.action import METRES_PER_RADIAN
from ..session import get_session
from .curves import BONE, keys_of, sigma_curves

GREEN_DEG, RED_DEG = 1.0, 10.0
QUARTILE = 0.75
STRIP_PX, OPACITY, BONE_PX = 8.0, 0.9, 6.0
CONTROL = re.compile(r"_(fk|ik)(?=\.|$)")  # of the names of controls
EDITORS = ("SpaceDopeSheetEditor", "SpaceGraphEditor")

Sigmas = dict[str, tuple[np.ndarray, np.ndarray]]  # by bone: frames (T,), and the largest sigma (T,) of its channels [degrees]


def sigmas_of(body: bpy.types.Object) -> Sigmas:
    """The sigmas of a body's bones; those of locations count as angles (METRES_PER_RADIAN)."""
    found: Sigmas = {}
    dofs = standing.dofs_of(body)
    for name, curve in sigma_curves(body).items():
        at = BONE.match(curve.data_path)
        if at is None or not len(curve.keyframe_points):
            continue
        frames, sigma = keys_of(curve)
        in_metres = dofs.get(name.removeprefix("sigma "), {}).get("path") == "location"
        sigma = np.degrees(sigma / (METRES_PER_RADIAN if in_metres else 1.0))
        before = found.get(at[1])
        found[at[1]] = (frames, np.maximum(before[1], sigma) if before is not None and len(before[1]) == len(sigma) else sigma)
    return found


def colour_of(sigma_deg: np.ndarray) -> np.ndarray:
    """Colours (N, 4) of sigmas (N,)."""
    part = np.clip(np.log(np.maximum(sigma_deg, 1e-6) / GREEN_DEG) / np.log(RED_DEG / GREEN_DEG), 0.0, 1.0)
    red, green = np.minimum(1.0, 2 * part), np.minimum(1.0, 2 - 2 * part)
    return np.stack([0.9 * red, 0.75 * green, np.full(len(part), 0.1), np.full(len(part), OPACITY)], axis=1)


def of_frames(sigmas: Sigmas, bones: set[str]) -> tuple[np.ndarray, np.ndarray]:
    """Frames (T,) and in each the largest sigma (T,) of some bones; of all bones, if none of these has one, the sigma that a quarter of
    them exceeds, because some bone is uncertain in nearly every frame."""
    chosen = [sigmas[name] for name in bones if name in sigmas]
    part, chosen = (1.0, chosen) if chosen else (QUARTILE, list(sigmas.values()))
    frames = np.unique(np.concatenate([at for at, _ in chosen])) if chosen else np.zeros(0)
    values = np.zeros((len(chosen), len(frames)))
    for row, (at, sigma) in enumerate(chosen):
        values[row, np.searchsorted(frames, at)] = sigma
    return frames, np.quantile(values, part, axis=0) if chosen else np.zeros(0)


def begin() -> None:
    """Add the draw handlers."""
    handles = get_session().uncertainty_handles
    for editor in EDITORS:
        space = getattr(bpy.types, editor)
        handles.append((space, space.draw_handler_add(_draw_strip, (), "WINDOW", "POST_PIXEL")))
    handles.append((bpy.types.SpaceView3D, bpy.types.SpaceView3D.draw_handler_add(_draw_bones, (), "WINDOW", "POST_VIEW")))


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
    frames, worst = of_frames(sigmas, chosen_bones(body))
    height, to_region = STRIP_PX * bpy.context.preferences.system.ui_scale, region.view2d.view_to_region
    for frame, colour in zip(frames, colour_of(worst)):
        left, right = (to_region(frame + half, 0.0, clip=False)[0] for half in (-0.5, 0.5))
        if right >= 0 and left <= region.width:
            canvas.fill(canvas.rectangle(left, 0.0, max(right - left, 1.0), height), tuple(colour))


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
