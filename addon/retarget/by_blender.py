"""FBX, glTF, USD and Alembic by Blender's exporters, with options that were verified by reading the files back
(tests/addon/test_retarget_export.py).

Everything is exported from a temporary scene, so that the open file does not change. Units: an FBX file in centimetres has centimetres in
its armature and its header, because game engines handle scaled armature objects badly; USD and Alembic are scaled by their exporters; glTF
is always in metres. Axes: FBX and USD use those of the program, glTF and Alembic are always Y up.
"""

import errno
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...core.body.skin.texture import TEXTURE
from ...core.cli.streams import unheard
from ...core.foundation import store
from ...core.foundation.bounded import check_name, real_place
from ...core.foundation.errors import InputError
from ...core.motion.digits import with_digits
from ...core.motion.formats.markers import metres_per
from ...core.motion.retarget.rig import Motion
from ...core.results.folder import check_inside
from ...core.results.outputs import check_replaceable
from ..scene import skin
from ..scene.frame_rate import rate_of_gltf
from ..scene.standing import has_feet
from . import playing, programs
from .build import build_armature
from .own_textures import own_textures
from .programs import Program, bone_names

FORWARD = {"Y up": "-Z", "Z up": "Y", "OpenSim": "-X"}  # the axis of the file that is Blender's Y
UP = {"Y up": "Y", "Z up": "Z", "OpenSim": "Y"}
USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
USD_STARTS = ("PXR-USDC", "#usda", "PK\3\4")
NO_MESHES = "Alembic stores meshes, and this motion has none; choose fbx, glb or usd."
LEAST_FREE_MB, LEFT_MB = 32, 1  # of the disk: before an export, and after it; USD and Alembic do not notice that it is full
TEMPORARY = ("scenes", "objects", "armatures", "meshes", "actions", "materials", "images", "collections")


def export_motion(kind: str, out: Path, file: Path, program: Program, motion: Motion) -> str:
    """Write a motion as an armature, with the skin of its run; returns a summary.

    Raises:
        InputError: the format cannot store the motion, or the file cannot be written.
    """
    if kind == "abc" and not out.is_dir():
        raise InputError(NO_MESHES)
    made = skin.skin_of_run(out) if out.is_dir() else None
    lift_m = 0.0
    if made:
        shape, of_run = made
        lift_m = -float(of_run.vertices_m[:, 2].min()) if of_run is not None and has_feet(shape) else 0.0
        motion = raised(with_digits(motion, shape), lift_m)
    motion = programs.rooted(motion, program)
    with _plain_armature(kind, file, program, motion) as armature_object:
        if made:
            picture = out / "skin" / TEXTURE if of_run is not None else None
            skin_object = skin.add_skin(bpy.context.scene.collection, armature_object, shape, prepared=of_run, texture=picture)
            skin_object.data.transform(Matrix.Scale(1.0 / _unit_m(kind, program), 4) @ Matrix.Translation((0.0, 0.0, lift_m)))
        _write(kind, file, program, armature_object, bone_names(motion.rig, program))
    return f"{len(motion.rig.names)} bones in {len(motion.frames)} frames"


def export_played(kind: str, file: Path, program: Program, armature_object: bpy.types.Object, motion: Motion) -> str:
    """Write what an armature plays (`motion`, from `read_played`), with the meshes that it deforms or carries; returns a summary.

    Raises:
        InputError: there are no meshes for Alembic, or the file cannot be written.
    """
    skins = playing.skins_of(armature_object)
    if kind == "abc" and not skins:
        raise InputError(NO_MESHES)
    motion = programs.rooted(motion, program)
    with playing.in_first_frame(), _plain_armature(kind, file, program, motion) as plain:
        with playing.copied_skins(skins, armature_object, plain, 1.0 / _unit_m(kind, program)):
            _write(kind, file, program, plain, bone_names(motion.rig, program))
    return f"{len(motion.rig.names)} bones in {len(motion.frames)} frames"


@contextmanager
def _plain_armature(kind: str, file: Path, program: Program, motion: Motion) -> Iterator[bpy.types.Object]:
    """An armature that plays the motion in the unit of the file, in a temporary scene."""
    unit_m = _unit_m(kind, program)
    with temporary_scene() as scene:
        scene.unit_settings.scale_length = unit_m
        yield build_armature(scaled(motion, 1.0 / unit_m), file.stem)


def _unit_m(kind: str, program: Program) -> float:
    return metres_per(program.unit or "m", "the preset") if kind == "fbx" else 1.0


def raised(motion: Motion, by_m: float) -> Motion:
    """The same motion of a rig whose rest pose is higher: a whole body rests on the floor, as other programs expect."""
    rig, up = motion.rig, np.array([0.0, 0.0, by_m])
    soles = {bone: points + up for bone, points in rig.sole_m.items()}
    return replace(motion, rig=replace(rig, head_m=rig.head_m + up, tail_m=rig.tail_m + up, sole_m=soles))


def scaled(motion: Motion, factor: float) -> Motion:
    """The motion in another unit."""
    rig = replace(motion.rig, head_m=factor * motion.rig.head_m, tail_m=factor * motion.rig.tail_m, sole_m={})
    return replace(motion, rig=rig, head_m=factor * motion.head_m)


@contextmanager
def temporary_scene() -> Iterator[bpy.types.Scene]:
    """A new scene in the window. Afterwards the earlier scene is shown again, and all data made meanwhile is removed."""
    window, before = bpy.context.window, {kind: set(getattr(bpy.data, kind)) for kind in TEMPORARY}
    former = window.scene
    scene = bpy.data.scenes.new("Tricap export")
    window.scene = scene
    try:
        yield scene
    finally:
        window.scene = former
        bpy.data.batch_remove([thing for kind in TEMPORARY for thing in getattr(bpy.data, kind) if thing not in before[kind]])


def _write(kind: str, file: Path, program: Program, armature_object: bpy.types.Object, names: dict[str, str]) -> None:
    for name, new in names.items():
        armature_object.data.bones[name].name = new  # vertex groups and curves follow
    scene = bpy.context.scene
    scene.frame_set(scene.frame_start)

    def export(part: str) -> None:
        with own_textures(scene, file.name) if kind == "usd" else nullcontext():
            EXPORTERS[kind](part, program)

    write_whole(file, export)


def write_whole(file: Path, export: Callable[[str], Any]) -> None:
    """Let an exporter write to a temporary file next to `file` and rename it, so that `file` is complete or unchanged.

    Raises:
        InputError: the exporter failed, or Blender cannot be given that name.
    """
    file = real_place(file)
    check_name(file)
    part = store.part_of(file)
    try:
        store.try_writing(part)
        _check_free(part.parent, LEAST_FREE_MB)
        _check_largest(LEAST_FREE_MB << 20)
        with unheard() if bpy.app.background else nullcontext():
            export(str(part))
        _check_free(part.parent, LEFT_MB)
        if part.is_file():
            _check_largest(part.stat().st_size + 1)  # USD ends as if all were well, with a part of the file
        else:
            raise InputError(f"Blender wrote nothing to {file}; choose another folder.")
        os.replace(part, file)
    except (OSError, RuntimeError, shutil.Error) as error:
        said = str(error).strip() or "the exporter failed"
        reason = getattr(error, "strerror", None) or said.splitlines()[-1][:200]  # of a traceback, the last line
        raise InputError(f"Cannot write {file}: {reason}. Choose another name or folder, or free some space.") from error
    finally:
        if part.exists():
            part.unlink()


def _check_free(folder: Path, megabytes: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < megabytes << 20:
        raise OSError(errno.ENOSPC, f"{free >> 10} kB are left on the disk, {megabytes} MB are needed")


def _check_largest(size: int) -> None:
    """A limit of the size of files (`ulimit -f`) ends Alembic and Blender with it, and cuts USD."""
    if sys.platform != "win32":
        import resource

        largest = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        if largest != resource.RLIM_INFINITY and largest < size:
            raise OSError(errno.EFBIG, f"no file may be larger than {largest >> 10} kB here, and {-(-size >> 20)} MB are needed")


def _fbx(path: str, program: Program) -> None:
    axes = program.axes or "Y up"
    bpy.ops.export_scene.fbx(
        filepath=path,
        object_types={"ARMATURE", "MESH"},
        axis_forward=FORWARD[axes],
        axis_up=UP[axes],
        apply_unit_scale=True,
        apply_scale_options="FBX_SCALE_UNITS",
        add_leaf_bones=False,
        primary_bone_axis="Y",
        secondary_bone_axis="X",
        bake_anim=True,
        bake_anim_use_all_bones=True,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_force_startend_keying=True,
        bake_anim_step=1.0,
        bake_anim_simplify_factor=0.0,
        path_mode="COPY",
        embed_textures=True,
    )


def _glb(path: str, program: Program) -> None:
    with rate_of_gltf(bpy.context.scene):
        bpy.ops.export_scene.gltf(
            filepath=path,
            export_format="GLB",
            use_active_scene=True,
            export_yup=True,
            export_animations=True,
            export_animation_mode="ACTIVE_ACTIONS",
            export_nla_strips_merged_animation_name="Motion",
            export_force_sampling=True,
            export_frame_range=True,
            export_optimize_animation_size=False,
            export_rest_position_armature=True,
            export_def_bones=False,
            export_apply=False,
        )


def _usd(path: str, program: Program) -> None:
    axes = program.axes or "Z up"
    unit = {"cm": "CENTIMETERS"}.get(program.unit, "METERS")
    textures = Path(path).parent / "textures"
    check_inside(textures, textures.parent)
    with tempfile.TemporaryDirectory(prefix=".", suffix=".part", dir=textures.parent) as folder:  # Blender keeps or follows what is there
        file = Path(folder) / Path(path).name
        bpy.ops.wm.usd_export(
            filepath=str(file),
            export_animation=True,
            export_armatures=True,
            export_meshes=True,
            only_deform_bones=False,
            convert_orientation=axes != "Z up",
            export_global_forward_selection=FORWARD[axes].replace("-", "NEGATIVE_"),
            export_global_up_selection=UP[axes],
            convert_scene_units=unit,
        )
        pictures = list((Path(folder) / textures.name).glob("*"))
        for picture in pictures:
            _check_earlier(textures / picture.name)
        for picture in pictures:
            textures.mkdir(exist_ok=True)
            os.replace(picture, textures / picture.name)
        os.replace(file, path)


def _check_earlier(picture: Path) -> None:
    """Check that a picture with a name that is given to one of an exported file (`own_textures`) is of an earlier export into that file.

    Raises:
        InputError: it is the user's.
    """
    exported = picture.parent.parent / picture.name.rpartition("_")[0]
    if exported.suffix.lower() not in USD_ENDINGS or not picture.exists() or picture.is_symlink():
        return
    try:
        check_replaceable(exported, *USD_STARTS)
        earlier = exported.exists()
    except InputError:
        earlier = False
    if not earlier:
        raise InputError(f"{picture} would be overwritten, and is not of an earlier export; rename it, or choose another name.")


def _abc(path: str, program: Program) -> None:
    scene = bpy.context.scene
    bpy.ops.wm.alembic_export(
        filepath=path,
        as_background_job=False,
        start=scene.frame_start,
        end=scene.frame_end,
        global_scale=1.0 / metres_per(program.unit or "m", "the preset"),
    )


EXPORTERS: dict[str, Callable[[str, Program], None]] = {"fbx": _fbx, "glb": _glb, "usd": _usd, "abc": _abc}
