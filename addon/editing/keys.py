"""Smoothing and key reduction of the curves of a body's action."""

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.motion.plausible import check_times
from ...core.motion.retarget.rig import needed_keys
from ...core.motion.smoothing import smooth
from ..scene.action import METRES_PER_RADIAN, SIMPLE_NAME, set_keys
from ..scene.standing import dofs_of
from .curves import bone_of, curves_of, edited_action, keys_of, motion_curves, sigma_curves


def smooth_uncertain(body: bpy.types.Object, acceleration: float) -> str:
    """Smooth the (selected) channels by their sigmas, with keys in every frame afterwards; returns a summary. `acceleration` [rad/s²].

    Raises:
        InputError: there is nothing to edit, or the sigmas are missing.
    """
    sigmas, scene = sigma_curves(body), bpy.context.scene
    dofs = {(dof["bone"], dof["path"], dof["index"]): name for name, dof in dofs_of(body).items()}
    named = [
        (curve, dofs.get((bone_of(curve), curve.data_path.rpartition(".")[2], curve.array_index)))
        for curve in motion_curves(body, selected=True)
    ]
    chosen = [(key_of(curve), sigmas[f"sigma {dof}"]) for curve, dof in named if f"sigma {dof}" in sigmas]
    if not chosen:
        raise InputError("The sigmas of this motion are not in the scene; build the rig again (step 7).")
    fps, worst = scene.render.fps / scene.render.fps_base, 0.0
    check_times(np.arange(1), fps, "The scene plays")
    by_key = {key_of(curve): curve for curve in curves_of(edited_action(body))}
    for key, sigma_curve in chosen:
        curve = by_key[key]
        first, last = (int(round(frame)) for frame in curve.range())
        frames = np.arange(first, last + 1)
        values = np.array([curve.evaluate(frame) for frame in frames])
        measured, sigma = keys_of(sigma_curve)
        at_frame = np.full(len(frames), np.nan)
        inside = (measured >= first) & (measured <= last)
        at_frame[np.round(measured[inside]).astype(int) - first] = sigma[inside]
        unit = METRES_PER_RADIAN if key[0].endswith("location") else 1.0
        smoothed = smooth(values, at_frame, fps, acceleration * unit)
        worst = max(worst, float(np.abs(smoothed - values).max()) / unit)
        set_keys(curve, frames, smoothed)
    return f"{len(chosen)} channels were smoothed; the largest change is {np.degrees(worst):.1f}°."


def reduce_keys(body: bpy.types.Object, tolerance: float) -> str:
    """Remove keys of the (selected) channels as long as none changes by more than `tolerance` [rad]; returns a summary.

    Raises:
        InputError: there is nothing to edit.
    """
    wanted, before, after = [key_of(curve) for curve in motion_curves(body, selected=True)], 0, 0
    by_key = {key_of(curve): curve for curve in curves_of(edited_action(body, SIMPLE_NAME))}
    for curve in (by_key[key] for key in wanted):
        frames, values = keys_of(curve)
        kept = needed_keys(frames, values, tolerance * (METRES_PER_RADIAN if curve.data_path.endswith("location") else 1.0))
        before, after = before + len(frames), after + len(kept)
        set_keys(curve, frames[kept], values[kept])
    return f"{after} of {before} keys are left."


def key_of(curve: bpy.types.FCurve) -> tuple[str, int]:
    """What a curve moves: its path and index."""
    return curve.data_path, curve.array_index
