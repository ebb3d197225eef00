"""Building the scene of a run: everything that was measured, in one collection, in the take's own frame numbers.

    read_contents (any thread) → write_scene (main thread) → save_blend
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ...core.errors import InputError
from ...core.motion.ply import Ply
from ...core.progress import Monitor
from . import action, armature, cameras, clips, metaballs, skin
from .cloud import CloudPoints, add_cloud
from .contents import Contents, read_contents
from .trajectories import add_trajectories

COLLECTION = "Tricap"
OUT_KEY = "tricap_out"  # custom property of the collection: the folder it was built from


@dataclass(frozen=True, kw_only=True)
class SceneReport:
    """What was built: names and counts for people, and what had to be left out and why."""

    collection: str
    counts: dict[str, int]
    warnings: tuple[str, ...]
    blend: Path | None = None

    def __str__(self) -> str:
        return ", ".join(f"{count} {what}" for what, count in self.counts.items() if count) or "nothing to show"


def build_scene(out: Path, blend: Path | None = None, monitor: Monitor | None = None) -> SceneReport:
    """Put the results in OUT into the open scene, replacing what an earlier build left, and save a copy as `blend`.

    Raises:
        InputError: OUT is no folder of results or damaged, or the file cannot be written.
        Cancelled: the monitor was cancelled; the scene is unchanged.
    """
    return write_scene(read_contents(Path(out), monitor or Monitor()), blend)


def write_scene(contents: Contents, blend: Path | None = None) -> SceneReport:
    """The second half of `build_scene`: main thread only."""
    scene = bpy.context.scene
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    remove_earlier()
    collection = bpy.data.collections.new(COLLECTION)
    collection[OUT_KEY] = str(contents.out)
    scene.collection.children.link(collection)
    set_time(scene, contents)
    warnings, counts = list(contents.warnings), {}
    counts["cameras"] = _add_cameras(scene, collection, contents, warnings)
    counts["cloud points"] = _add_cloud(collection, contents)
    if contents.trajectories is not None:
        add_trajectories(collection, contents.trajectories)
        counts["trajectories"] = contents.trajectories["xyz_m"].shape[1]
    counts |= _add_body(collection, contents, warnings)
    scene.frame_set(scene.frame_start)
    if blend is not None:
        save_blend(Path(blend))
    return SceneReport(collection=collection.name, counts=counts, warnings=tuple(warnings), blend=blend)


def remove_earlier() -> None:
    """Remove the collections that earlier builds made in this scene, with their objects and data that nobody else uses."""
    scene = bpy.context.scene
    for collection in [child for child in scene.collection.children_recursive if OUT_KEY in child]:
        objects = [o for o in collection.all_objects if len(o.users_collection) == 1]
        used = {id_ for o in objects for id_ in (o.data, o.animation_data.action if o.animation_data else None) if id_ is not None}
        used |= {background.clip for o in objects if o.type == "CAMERA" for background in o.data.background_images if background.clip}
        used |= {modifier.node_group for o in objects for modifier in o.modifiers if modifier.type == "NODES" and modifier.node_group}
        used |= {m for o in objects if hasattr(o.data, "materials") for m in o.data.materials if m}
        if scene.active_clip in used:
            scene.active_clip = None
        bpy.data.batch_remove(objects)
        bpy.data.collections.remove(collection)
        for _ in range(2):  # materials are free only once their meshes and node groups are gone
            free = {id_ for id_ in used if id_.users == 0}
            used -= free
            bpy.data.batch_remove(free)


def set_time(scene: bpy.types.Scene, contents: Contents) -> None:
    """The scene's frames are the take's frames, at the take's rate."""
    whole = max(1, math.ceil(contents.fps - 1e-6))
    scene.render.fps, scene.render.fps_base = whole, whole / contents.fps
    scene.frame_start, scene.frame_end = contents.frames


def save_blend(path: Path) -> None:
    """Save a copy of the open file as `path`, whole or not at all; the open file keeps its name.

    Raises:
        InputError: the file cannot be written.
    """
    path = path.resolve()
    if path.suffix != ".blend":
        raise InputError(f"{path.name} is no name of a Blender file; let it end in .blend.")
    part = path.with_name(f".{path.stem}.{os.getpid()}.part.blend")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(part), copy=True, relative_remap=True, compress=True)
        os.replace(part, path)
    except (OSError, RuntimeError) as error:
        raise InputError(f"Cannot write {path}: {str(error).strip()} Choose another folder or free some space.") from error
    finally:
        if part.exists():
            part.unlink()


def _add_cameras(scene: bpy.types.Scene, collection: bpy.types.Collection, contents: Contents, warnings: list[str]) -> int:
    footage = contents.footage
    if footage is None:
        return 0
    take = footage.take
    reference = footage.rig.cameras[take.reference]
    cameras.frame_render(scene, reference)
    warnings += cameras.frame_faults(footage.rig, reference)
    for view, camera, sequence in zip(take.views, footage.rig.cameras, footage.sequences):
        camera_object = cameras.add_camera(collection, camera)
        camera_object["tricap_interlaced"] = take.interlaced
        files = sequence.files()
        clip = clips.load_clip(f"Footage {view.name}", files[0], camera)
        clip.frame_start = -view.offset_frames
        clips.show_behind(camera_object.data, clip)
        warnings += clips.clip_faults(clip, camera, files, f"view {view.name}")
        if camera is reference:
            scene.camera, scene.active_clip = camera_object, clip
    return len(take.views)


def _add_cloud(collection: bpy.types.Collection, contents: Contents) -> int:
    clouds = [_cloud_points(frame, ply) for frame, ply in contents.clouds.items()]
    if clouds:
        add_cloud(collection, clouds)
    return sum(len(cloud.xyz_m) for cloud in clouds)


def _cloud_points(frame: int, ply: Ply) -> CloudPoints:
    xyz = ply.xyz_m
    column = {name: ply.vertex.get(name, np.zeros(len(xyz))) for name in ("sigma", "nx", "ny", "nz", "intensity")}
    normals = np.stack([column[name] for name in ("nx", "ny", "nz")], axis=-1)
    return CloudPoints(frame=frame, xyz_m=xyz, sigma_m=column["sigma"], normals=normals, intensity=column["intensity"])


def _add_body(collection: bpy.types.Collection, contents: Contents, warnings: list[str]) -> dict[str, int]:
    if contents.shape is None:
        return {}
    armature_object = armature.add_armature(collection, contents.shape)
    flesh = metaballs.add_metaballs(collection, armature_object, contents.shape)
    counts = {"bones": len(contents.shape.skeleton.bones), "metaball parts": len(flesh)}
    try:
        skin_object = skin.add_skin(collection, armature_object, contents.shape)
    except InputError as error:
        warnings.append(f"No polygonal skin in the scene: {error}")
    else:
        skin_object.hide_set(True)  # it lies in the metaballs' surface
        skin_object.hide_render = True
        counts["skin faces"] = len(skin_object.data.polygons)
    if contents.motion is not None:
        motion = contents.motion
        action.add_action(armature_object, contents.shape, motion.frames, motion.dof_names, motion.values, motion.sigma)
        counts["frames of motion"] = len(motion.frames)
    return counts
