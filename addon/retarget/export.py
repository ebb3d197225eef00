"""Motions for other programs: text and points by core's writers, the rest by Blender's exporters with options that were checked by
reading the files back (tests/addon/test_retarget_export.py)."""

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core import store
from ...core.body.shape import read_body
from ...core.errors import InputError
from ...core.motion.bvh import write_bvh
from ...core.motion.c3d import write_c3d
from ...core.motion.markers import Markers
from ...core.motion.points_csv import rate, write_points_csv
from ...core.motion.retarget.mapping import Preset, RigMap, find_map, read_preset
from ...core.motion.retarget.rig import Motion, Rig
from ...core.motion.sources import read_motion_source
from ...core.motion.tables import read_joints
from ...core.motion.trc import write_trc
from ...core.progress import Monitor

PRESETS = Path(__file__).resolve().parent.parent / "presets"


@dataclass(frozen=True, kw_only=True)
class Program:
    """What a program wants: bones' names (a file in presets/), the unit of text formats, and the axes of points."""

    names: str = ""
    unit_m: float = 1.0
    axes: str = "Z up"


PROGRAMS = {
    "plain": Program(),
    "mixamo": Program(names="mixamo", unit_m=0.01, axes="Y up"),
    "unreal": Program(names="unreal", unit_m=0.01),
    "unity": Program(names="unity", axes="Y up"),
    "maya": Program(names="mixamo", unit_m=0.01, axes="Y up"),
    "opensim": Program(axes="OpenSim"),
}


def export_file(out: Path, kind: str, file: Path, preset: str, monitor: Monitor) -> str:
    """Write the motion or the points in OUT to `file`; a sentence about what was written.

    Raises:
        InputError: OUT lacks what the format needs, or the file cannot be written.
        Cancelled: the monitor was cancelled.
    """
    program = PROGRAMS[preset]
    monitor.step("exporting", 0, 1)
    if kind in ("trc", "c3d", "csv"):
        markers = points_of(out)
        axes = program.axes if preset != "plain" else {"trc": "OpenSim"}.get(kind, "Z up")
        if kind == "csv":
            write_points_csv(file, markers)
        elif kind == "trc":
            write_trc(file, markers, axes=axes)
        else:
            write_c3d(file, markers, axes=axes)
        return f"{len(markers.names)} points in {len(markers.frames)} frames"
    if kind == "ply":
        return _copy_skins(out, file)
    motion = read_motion_source(out)
    names = _names(motion.rig, program)
    if kind == "bvh":
        write_bvh(file, motion, unit_m=program.unit_m, names=names)
    else:
        _by_blender(kind, out, file, renamed(motion, names))
    return f"{len(motion.rig.names)} bones in {len(motion.frames)} frames"


def points_of(out: Path) -> Markers:
    """The joints of a run with their sigmas, or the heads of a motion's bones."""
    if out.is_dir() and (out / "joints.csv").is_file():
        table = read_joints(out / "joints.csv")
        names = tuple(table.joints_m)
        xyz, sigma = (np.stack([column[name] for name in names], axis=1) for column in (table.joints_m, table.sigma_m))
        return Markers(names=names, fps=rate(table.frames, table.time_s), frames=table.frames, xyz_m=xyz, sigma_m=sigma)
    motion = read_motion_source(out)
    shape = motion.head_m.shape[:2]
    return Markers(names=motion.rig.names, fps=motion.fps, frames=motion.frames, xyz_m=motion.head_m, sigma_m=np.full(shape, np.nan))


def _copy_skins(out: Path, folder: Path) -> str:
    files = sorted((out / "skin").glob("*.ply")) or sorted((out / "clouds").glob("*.ply"))
    if not files:
        raise InputError(f"{out} has neither skins nor clouds; run the take first.")
    for file in files:
        store.write_bytes(folder / file.name, file.read_bytes())
    return f"{len(files)} files from {files[0].parent.name}/"


def _names(rig: Rig, program: Program) -> dict[str, str]:
    """Names of a program by the rig's own; bones that the program has no name for keep theirs."""
    if not program.names:
        return {}
    preset: Preset = read_preset(PRESETS / f"{program.names}.json")
    rig_map: RigMap = find_map(rig)
    given: dict[str, str] = {}
    for role, chain in rig_map.bones.items():
        wanted = preset.bones.get(role, ())
        for bone, name in zip(chain, wanted if len(wanted) >= len(chain) else wanted[:1]):
            given[bone] = preset.prefixes[0] + name
    return given


def renamed(motion: Motion, names: dict[str, str]) -> Motion:
    """The motion with other names for its bones."""
    return replace(motion, rig=replace(motion.rig, names=tuple(names.get(name, name) for name in motion.rig.names), roles={}, sole_m={}))


def _by_blender(kind: str, out: Path, file: Path, motion: Motion) -> None:
    import bpy

    from ..scene import skin
    from .build import build_armature, loose_bones

    loose = loose_bones(motion)
    if loose:
        raise InputError(f"{len(loose)} bones of the motion shift against their parents (“{loose[0]}”), which {kind} cannot show; use bvh.")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    armature_object = build_armature(motion, "Body")
    if out.is_dir() and not set(bone.name for bone in read_body(out / "body.toml").skeleton.bones) - set(motion.rig.names):
        skin.add_skin(bpy.context.scene.collection, armature_object, read_body(out / "body.toml"))
    elif kind == "abc":
        raise InputError("Alembic holds meshes, and this motion has none; choose fbx, glb or usd.")
    bpy.context.scene.frame_set(bpy.context.scene.frame_start)
    write_whole(file, lambda part: EXPORTERS[kind](part))


def write_whole(file: Path, export: Callable[[str], Any]) -> None:
    """Let an exporter write beside `file` and move the result over, so that it is there in full or not at all.

    Raises:
        InputError: the exporter failed.
    """
    file = Path(file).resolve()
    part = file.with_name(f".{file.stem}.{os.getpid()}.part{file.suffix}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        export(str(part))
        if not part.is_file():
            raise InputError(f"Blender wrote nothing to {file}; choose another folder.")
        os.replace(part, file)
    except (OSError, RuntimeError, shutil.Error) as error:
        raise InputError(f"Cannot write {file}: {str(error).strip()[:200]}") from error
    finally:
        if part.exists():
            part.unlink()


def _fbx(path: str) -> None:
    import bpy

    bpy.ops.export_scene.fbx(filepath=path, object_types={"ARMATURE", "MESH"}, axis_forward="-Z", axis_up="Y", apply_unit_scale=True,
                             apply_scale_options="FBX_SCALE_UNITS", add_leaf_bones=False, primary_bone_axis="Y", secondary_bone_axis="X",
                             bake_anim=True, bake_anim_use_all_bones=True, bake_anim_use_nla_strips=False, bake_anim_use_all_actions=False,
                             bake_anim_force_startend_keying=True, bake_anim_step=1.0, bake_anim_simplify_factor=0.0)


def _glb(path: str) -> None:
    import bpy

    bpy.ops.export_scene.gltf(filepath=path, export_format="GLB", export_yup=True, export_animations=True, export_force_sampling=True,
                              export_frame_range=True, export_optimize_animation_size=False, export_rest_position_armature=True,
                              export_def_bones=False, export_apply=False)


def _usd(path: str) -> None:
    import bpy

    bpy.ops.wm.usd_export(filepath=path, export_animation=True, export_armatures=True, export_meshes=True, only_deform_bones=False)


def _abc(path: str) -> None:
    import bpy

    bpy.ops.wm.alembic_export(filepath=path, as_background_job=False, start=bpy.context.scene.frame_start, end=bpy.context.scene.frame_end)


EXPORTERS: dict[str, Callable[[str], None]] = {"fbx": _fbx, "glb": _glb, "usd": _usd, "abc": _abc}
