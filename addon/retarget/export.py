"""Exports motions for other programs: BVH and points by core's writers, the other formats by Blender's exporters."""

from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.foundation import bounded, store
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.images.sequence import IMAGE_ENDINGS, MOVIE_ENDINGS
from ...core.motion.formats.bvh import write_bvh
from ...core.motion.formats.c3d import Segments, write_c3d
from ...core.motion.formats.markers import Markers, metres_per, rate, write_points_csv
from ...core.motion.formats.opensim import write_opensim
from ...core.motion.formats.ply import read_ply
from ...core.motion.formats.trc import write_trc
from ...core.motion.retarget.rig import Motion
from ...core.motion.sources import is_of_points, read_motion_source, read_points
from ...core.motion.tables import read_joints
from ...core.results.folder import MADE_BY, check_complete, check_not_result
from ...core.results.listed_files import PLY, check_files, list_files
from ...core.results.outputs import check_output
from ...core.results.own_files import files_of
from ...core.results.run_json import read_run
from .programs import PROGRAMS, Program, bone_names, is_imported_by_blender, joint_names

BY_BLENDER = ("fbx", "glb", "usd", "abc")
LISTED = 6  # points in a sentence
MODEL_ENDING = ".osim"  # of the model that a .mot file moves, next to it
POINTS = {"trc": ("OpenSim", "m"), "c3d": ("Z up", "mm"), "csv": ("Z up", "m")}  # usual axes and unit of the format
WRITE_POINTS = {"trc": write_trc, "c3d": write_c3d, "csv": write_points_csv}
ENDINGS = {kind: (f".{kind}",) for kind in ("bvh", "mot", "fbx", "abc", *POINTS)} | {
    "glb": (".glb",), "usd": (".usd", ".usda", ".usdc", ".usdz")}  # fmt: skip

OTHERS = (*IMAGE_ENDINGS, *MOVIE_ENDINGS, ".toml", ".json", ".npz", ".blend")  # of what is no motion: probably a slip


def named_for(kind: str, file: Path, out: Path | None) -> Path:
    """The file to write, with the ending of the format where the name has none. Skins go into a folder of any name.

    Raises:
        InputError: the name has the ending of another format, the file is an input, or it exists and was not named with its ending.
    """
    named, ending = file, file.suffix.lower()
    if kind != "ply" and ending not in ENDINGS[kind]:
        if ending in OTHERS or any(ending in others for others in ENDINGS.values()):
            raise InputError(f"{file.name} has the ending of another format; let it end in {ENDINGS[kind][0]}, or choose that format.")
        file = file if ending else file.with_name(file.name + ENDINGS[kind][0])
    if kind in BY_BLENDER:
        bounded.check_name(file)
        if file.suffix.lower() not in ENDINGS[kind]:
            raise InputError(f"{file.name} does not end in {' or '.join(ENDINGS[kind])}; write the name with that ending.")
    check_output(file, [] if out is None else [out])
    if file.name != named.name and file.exists():
        raise InputError(f"{file.name} exists already; write the name with its ending to replace it.")
    if out is not None:
        check_not_result(file, out)
        if kind == "mot":
            check_not_result(file.with_suffix(MODEL_ENDING), out)
    return file


def export_file(out: Path, kind: str, file: Path, preset: str, monitor: Monitor, *, up: str = "", unit: str = "", of: str = "") -> str:
    """Write the motion or the points in OUT to `file`; returns a summary. For BY_BLENDER on the main thread only.

    `up`, `unit`: of OUT, for `read_motion_source`; `of`: the folder of PLY files to copy, by default skins or else clouds.

    Raises:
        InputError: OUT lacks data that the format needs, or the file cannot be written.
        Cancelled: the monitor was cancelled.
    """
    program = PROGRAMS[preset]
    monitor.step("exporting", 0, 1)
    if is_imported_by_blender(out):
        from .files import open_moving
        from .read import ended

        return ended(exporting_played(open_moving(out), kind, file, preset, monitor))
    check_complete(out, [of] if kind == "ply" and of else MADE_BY["fit"])
    if kind == "ply":
        return _copy_ply(out, file, of, monitor)
    if kind in POINTS:
        moving = read_motion_source(out, up=up, unit=unit) if kind == "c3d" and _has_segments(out) else None
        return _write_points(kind, file, points_of(out, up=up, unit=unit), program, moving)
    motion = read_motion_source(out, up=up, unit=unit)
    added = _added(read_points(out, up=up, unit=unit)) if is_of_points(out) else ""
    if kind in SKELETONS:
        return SKELETONS[kind](file, motion, program) + added
    from .by_blender import export_motion

    return export_motion(kind, out, file, program, motion) + added


def _added(points: Markers) -> str:
    """Which points have no place in some frames, where a skeleton needs one: between others it is interpolated, at the ends held."""
    frames = (~np.isfinite(points.xyz_m).all(axis=2)).sum(axis=0)
    some = [f"{name} in {n}" for name, n in zip(points.names, frames) if 0 < n < len(points.frames)]
    more = f" and {len(some) - LISTED} others" if len(some) > LISTED else ""
    return f"; frames without a place, which are filled: {', '.join(some[:LISTED])}{more}" if some else ""


def exporting_played(armature_object: Any, kind: str, file: Path, preset: str, monitor: Monitor) -> Generator[None, None, str]:
    """Write what an armature of the open file plays, with the meshes that it deforms, in steps; returns a summary. Main thread only.

    Raises:
        InputError: the armature cannot be exported in this format, or the file cannot be written.
        Cancelled: the monitor was cancelled.
    """
    from . import by_blender, playing

    program = PROGRAMS[preset]
    if kind == "ply":
        return (yield from playing.writing_skins(armature_object, file, monitor))
    motion = yield from playing.reading_played(armature_object, monitor)
    if kind in POINTS:
        return _write_points(kind, file, playing.points_of_played(armature_object, motion), program, motion)
    if kind in SKELETONS:
        return SKELETONS[kind](file, motion, program)
    return by_blender.export_played(kind, file, program, armature_object, motion)


def _write_bvh(file: Path, motion: Motion, program: Program) -> str:
    names, unit_m = bone_names(motion.rig, program), metres_per(program.unit or "m", "the preset")
    write_bvh(file, motion, unit_m=unit_m, order=program.bvh_order, names=names)
    return f"{len(motion.rig.names)} bones in {len(motion.frames)} frames"


def _write_opensim(file: Path, motion: Motion, program: Program) -> str:
    write_opensim(file, motion, names=bone_names(motion.rig, program))
    return f"{len(motion.rig.names)} bones in {len(motion.frames)} frames, and their model {file.with_suffix(MODEL_ENDING).name}"


SKELETONS = {"bvh": _write_bvh, "mot": _write_opensim}


def _has_segments(out: Path) -> bool:
    """Whether a motion has rotations of its own, not those that points suggest."""
    return (out / "body.toml").is_file() if out.is_dir() else out.suffix.lower() == ".bvh"


def points_of(out: Path, *, up: str = "", unit: str = "") -> Markers:
    """The joints of a run with their sigmas, the points of a file as they are, or the heads of a motion's bones."""
    if out.is_dir() and (out / "joints.csv").is_file():
        table = read_joints(out / "joints.csv")
        names = tuple(table.joints_m)
        xyz, sigma = (np.stack([column[name] for name in names], axis=1) for column in (table.joints_m, table.sigma_m))
        words = tuple(zip(*(table.known[name] for name in names)))
        known = words if all(all(row) for row in words) else ()
        return Markers(
            names=names,
            fps=rate(table.frames, table.time_s, out / "joints.csv"),
            frames=table.frames,
            xyz_m=xyz,
            sigma_m=sigma,
            known=known,
        )
    if is_of_points(out):
        return read_points(out, up=up, unit=unit)
    return heads_of(read_motion_source(out, up=up, unit=unit))


def heads_of(motion: Motion) -> Markers:
    """The heads of a motion's bones as points without sigmas."""
    shape = motion.head_m.shape[:2]
    return Markers(names=motion.rig.names, fps=motion.fps, frames=motion.frames, xyz_m=motion.head_m, sigma_m=np.full(shape, np.nan))


def _write_points(kind: str, file: Path, markers: Markers, program: Program, moving: Motion | None = None) -> str:
    """Write points; into C3D also the poses of the bones that are `moving`."""
    axes, unit = program.axes or POINTS[kind][0], program.unit or POINTS[kind][1]
    segments = {}
    if kind == "c3d" and moving is not None:
        given = bone_names(moving.rig, program)
        names = tuple(given.get(name, name) for name in moving.rig.names)
        segments["segments"] = Segments(names=names, frames=moving.frames, R=moving.R, origin_m=moving.head_m)
    WRITE_POINTS[kind](file, replace(markers, names=joint_names(markers.names, program)), axes=axes, unit=unit, **segments)
    return f"{len(markers.names)} points in {len(markers.frames)} frames" + (f", {len(names)} segments" if segments else "")


def _copy_ply(out: Path, folder: Path, of: str, monitor: Monitor) -> str:
    """Copy skins, clouds or tracked clouds; by default the skins, or else the clouds."""
    run = read_run(out / "run.json") if (out / "run.json").is_file() else {}
    first, end = run.get("frames", (0, np.inf))
    found = ([file for file in files_of(out / name, name) if file.suffix == ".ply"] for name in ([of] if of else ["skin", "clouds"]))
    files = [file for file in next(filter(None, found), []) if first <= int(file.stem) < end]  # not a copy of the user's own
    if not files:
        raise InputError(f"{out} has {f'no folder {of}/ with files' if of else 'neither skins nor clouds'}; run the take first.")
    by = next(stage for stage, names in MADE_BY.items() if files[0].parent.name in names)
    begun = not run and (out / "cache").is_dir()  # by a first run
    if begun or by not in run.get("stages", {by}):
        raise InputError(f"{files[0].parent} is not finished: the run that makes it was stopped, or goes on; run the take first.")
    for n, file in enumerate(files):
        monitor.step("exporting", n, len(files))
        read_ply(file)  # a damaged one is not spread
    check_files(folder, PLY)
    list_files(folder, PLY, [file.name for file in files])
    for file in files:
        store.write_bytes(folder / file.name, bounded.bytes_of(file, bounded.ARRAYS_BYTES))
    return f"{len(files)} files from {files[0].parent.name}/"
