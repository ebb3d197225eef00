"""Where motions come from for the command: core's readers, or an armature in a file that Blender imports."""

from pathlib import Path
from typing import Any

import bpy

from ...core.errors import InputError
from ...core.motion.retarget.mapping import RigMap
from ...core.motion.retarget.rig import Motion
from ...core.motion.sources import read_motion_source
from ...core.progress import Monitor
from . import files
from .export import IN_BLENDER
from .memory import recalled
from .read import action_frames, read_motion, read_rig


def open_source(path: Path, monitor: Monitor, *, up: str = "", unit: str = "") -> Motion:
    """The motion in a run's folder or a file; a file for Blender takes the place of the open one. `up`, `unit`: of `read_motion_source`.

    Raises:
        InputError: it cannot be read, or holds no motion, or two.
    """
    if path.suffix.lower() not in IN_BLENDER or path.is_dir():
        return read_motion_source(path, up=up, unit=unit)
    files.open_rig(path)
    moving = [o for o in bpy.data.objects if o.type == "ARMATURE" and o.animation_data and o.animation_data.action]
    if len(moving) != 1:
        raise InputError(f"{path.name} has {len(moving)} armatures with an action; a motion needs one.")
    return recalled(moving[0], read_motion(moving[0], read_rig(moving[0]), action_frames(moving[0]), monitor))


def account(outcome: Any, source_map: RigMap, target_map: RigMap) -> dict[str, Any]:
    """The outcome as a table for JSON."""
    figures, result = outcome.figures, outcome.result
    return {
        "format": "tricap-retarget",
        "version": 1,
        "frames": figures.frames,
        "keys": outcome.written.keys,
        "scale": result.scale,
        "direction_rms_deg": figures.direction_rms_deg,
        "direction_worst_deg": figures.direction_worst_deg,
        "by_part_deg": figures.by_part_deg,
        "slide_mm": figures.slide_mm,
        "penetration_mm": figures.penetration_mm,
        "float_mm": figures.float_mm,
        "largest_step_deg": figures.largest_step_deg,
        "contacts": figures.contacts,
        "notes": list(outcome.notes),
        "source": {role: list(chain) for role, chain in source_map.bones.items()},
        "target": {role: list(chain) for role, chain in target_map.bones.items()},
        "mapped_by": target_map.origin,
    }
