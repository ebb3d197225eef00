"""Rigs and motions from files: .blend, glTF, VRM and FBX through Blender's importers, the rest through core's readers."""

import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import bpy

from ...core.cli.streams import unheard
from ...core.foundation import bounded
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.motion.formats.bvh import read_bvh
from ...core.motion.formats.fbx import check_fbx
from ...core.motion.formats.gltf import check_gltf, sampled_fps
from ...core.motion.retarget.mapping import MappedMotion, find_map
from ...core.motion.retarget.rest_pose import with_person_like_rest
from ...core.motion.retarget.rig import Motion
from ...core.motion.retarget.roles import read_humanoid
from ...core.motion.sources import read_motion_source
from ...core.results.folder import check_complete
from ..scene.armature import ROLES_KEY, SNAPS_KEY
from ..scene.frame_rate import rate_of_gltf, set_rate
from .build import build_armature
from .programs import is_imported_by_blender
from .read import action_frames, read_motion, read_rig, with_residual_motion

FAULTS = ("AttributeError", "TypeError", "KeyError", "IndexError", "NameError", "AssertionError", "ZeroDivisionError")  # of an importer
RIG_FILES = (".blend", ".glb", ".gltf", ".vrm", ".fbx", ".bvh")


def open_rig(path: Path) -> None:
    """Open or import a file into an empty scene: afterwards it is the open file.

    Raises:
        InputError: there is no such file, its format is unknown, or Blender cannot read it.
    """
    path = bounded.real_path(path)
    if path.is_dir():
        raise InputError(f"{path} is a folder; choose a file.")
    if not path.exists():
        raise InputError(f"There is no file {path}; check its name.")
    _check(path)
    kind = path.suffix.lower()
    if kind not in RIG_FILES:
        raise InputError(f"{path.name} is not a rig in a known format; choose one of {', '.join(RIG_FILES)}.")
    if kind == ".blend":
        with _tamed() as devices:
            _try(lambda: bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False), path)
        if devices:
            raise InputError(f"{path} names {devices[0]}, which is a device, a pipe or a socket, not a file; remove it from the file.")
        return
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    if kind not in (".glb", ".gltf", ".vrm"):
        import_rig(path)
        return
    if (fps := sampled_fps(path)) is not None:  # at another rate, keys would lie between frames
        set_rate(bpy.context.scene, fps)
    with rate_of_gltf(bpy.context.scene):
        import_rig(path)


@contextmanager
def _tamed() -> Iterator[list[str]]:
    """Files that are opened meanwhile write no caches and read from no devices or pipes, of which the names are given; then nothing is left
    of the file. Fluids, which write wherever a file says, are switched off before they are evaluated; other simulations stay in memory."""
    devices = list[str]()

    @bpy.app.handlers.persistent
    def switch_off(*_: object) -> None:
        devices[:] = [name for name in bpy.utils.blend_paths(absolute=True) if _is_device(Path(name))]
        if devices:
            bpy.data.batch_remove(bpy.data.objects)
        for modifier in (m for o in bpy.data.objects for m in o.modifiers):
            if modifier.type == "FLUID":
                modifier.show_viewport = modifier.show_render = False
        for cache in _point_caches():
            cache.use_disk_cache = cache.use_external = False

    bpy.app.handlers.load_post.append(switch_off)
    try:
        yield devices
    finally:
        if switch_off in bpy.app.handlers.load_post:
            bpy.app.handlers.load_post.remove(switch_off)


def _is_device(path: Path) -> bool:
    try:
        return path.exists() and not (path.is_file() or path.is_dir())
    except (OSError, ValueError):  # no name of a file
        return False


def _point_caches() -> Iterator[bpy.types.PointCache]:
    for thing in bpy.data.objects:
        yield from (system.point_cache for system in thing.particle_systems)
        for modifier in thing.modifiers:
            if modifier.type in ("CLOTH", "SOFT_BODY"):
                yield modifier.point_cache
            elif modifier.type == "DYNAMIC_PAINT" and modifier.canvas_settings:
                yield from (surface.point_cache for surface in modifier.canvas_settings.canvas_surfaces)
    yield from (scene.rigidbody_world.point_cache for scene in bpy.data.scenes if scene.rigidbody_world)


def open_motion(path: Path, monitor: Monitor, *, up: str = "", unit: str = "") -> Motion:
    """The motion in a run's folder or a file. A file that Blender imports replaces the open one. `up`, `unit`: see `read_motion_source`.

    Raises:
        InputError: it cannot be read, or does not have exactly one motion.
    """
    bounded.check_name(path)
    if not is_imported_by_blender(path):
        if path.is_dir():
            check_complete(path, ("body.toml", "motion.csv"))
        return read_motion_source(path, up=up, unit=unit)
    source = open_moving(path)
    return with_residual_motion(source, read_motion(source, read_rig(source), action_frames(source), monitor))


def open_moving(path: Path) -> bpy.types.Object:
    """Open a file, and return its one armature with an action or NLA strips. Of an imported file the scene plays the action's frames.

    Raises:
        InputError: it cannot be read, or has no such armature or several.
    """
    open_rig(path)
    armatures = [o for o in bpy.data.objects if o.type == "ARMATURE" and SNAPS_KEY not in o]  # those of a body count, not their controls
    moving = [o for o in armatures if (data := o.animation_data) and (data.action or data.nla_tracks)]
    if len(moving) != 1:
        raise InputError(f"{path.name} has {len(moving)} armatures with an action; it must have exactly one.")
    if path.suffix.lower() != ".blend":
        scene, frames = bpy.context.scene, action_frames(moving[0])
        scene.frame_start, scene.frame_end = frames.start, frames.stop - 1
    return moving[0]


def import_rig(path: Path) -> list[bpy.types.Object]:
    """Import a file into the open scene; returns the imported armatures.

    Raises:
        InputError: Blender cannot read it.
    """
    before = set(bpy.data.objects)
    kind = path.suffix.lower()
    humanoid: dict[str, str] = {}
    if kind in (".glb", ".gltf", ".vrm"):
        check_gltf(path)
        humanoid = read_humanoid(path)
    if kind == ".vrm":
        with tempfile.TemporaryDirectory() as folder:
            shutil.copy(path, Path(folder) / f"{path.stem}.glb")
            _try(lambda: bpy.ops.import_scene.gltf(filepath=str(Path(folder) / f"{path.stem}.glb")), path)
    elif kind in (".glb", ".gltf"):
        _try(lambda: bpy.ops.import_scene.gltf(filepath=str(path)), path)
    elif kind == ".fbx":
        check_fbx(path)
        _try(lambda: bpy.ops.import_scene.fbx(filepath=str(path)), path)
    else:
        _rig_of_bvh(path)
    armatures = [o for o in bpy.data.objects if o not in before and o.type == "ARMATURE"]
    for armature_object in armatures:
        roles = {role: name for role, name in humanoid.items() if name in armature_object.data.bones}
        if roles:
            armature_object.data[ROLES_KEY] = roles
    return armatures


def _rig_of_bvh(path: Path) -> None:
    """A BVH file's skeleton as an armature at rest, by our own reader: in metres; a zero pose that no person takes is replaced."""
    motion = read_bvh(path)
    motion = with_person_like_rest(MappedMotion(motion=motion, map=find_map(motion.rig)))[0].motion
    armature_object = build_armature(replace(motion, frames=motion.frames[:1], R=motion.R[:1], head_m=motion.head_m[:1]), path.stem)
    action = armature_object.animation_data.action
    armature_object.animation_data_clear()
    bpy.data.actions.remove(action)
    for bone in armature_object.pose.bones:
        bone.matrix_basis.identity()


def _check(path: Path) -> None:
    """Check that an importer may open a file.

    Raises:
        InputError: it is a pipe or a device, too large, or cannot be opened.
    """
    try:
        bounded.check_file(path, bounded.ARRAYS_BYTES)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}; choose another file.") from error


def _try(load: Callable[[], object], path: Path) -> None:
    """Run an importer; any error that it raises becomes an InputError about the file."""
    _check(path)
    try:
        with unheard() if bpy.app.background else nullcontext():  # importers print tracebacks of their own
            load()
    except Exception as error:  # noqa: BLE001  importers raise anything, from struct.error to RuntimeError with a traceback as text
        raise InputError(f"Blender cannot read {path} ({_reason(error)}); it is damaged or in another format; export it again.") from error


def _reason(error: Exception) -> str:
    """What an importer complains of. Its text may be a traceback, which Blender cuts, and then ends with the place in our code."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    reasons = [line for line in lines if re.match(r"[\w.]*(Error|Exception)\b", line) and not line.endswith(":")]
    if not reasons and "Traceback" in str(error):
        return "its importer fails"
    if reasons and reasons[-1].startswith(FAULTS):
        return "its importer fails"
    return (reasons or lines or [type(error).__name__])[-1][:200]


def the_armature(name: str, what: str) -> bpy.types.Object:
    """The one armature of the open file, or the one called `name`.

    Raises:
        InputError: there is none, or there are several and none was named.
    """
    armatures = [o for o in bpy.data.objects if o.type == "ARMATURE" and o.users_scene]
    if name:
        found = next((o for o in armatures if o.name == name), None)
        if found is None:
            names = ", ".join(o.name for o in armatures) or "none"
            raise InputError(f"{what} has no armature “{name}”; it has: {names}.")
        return found
    if not armatures:
        raise InputError(f"{what} has no armature; choose a file with a rig.")
    if len(armatures) > 1:
        raise InputError(f"{what} has {len(armatures)} armatures ({', '.join(o.name for o in armatures)}); choose one with --armature.")
    return armatures[0]
