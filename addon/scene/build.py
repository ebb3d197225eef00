"""Builds the scene of a run: all its results, in one collection, in the take's frame numbers.

read_contents (any thread) → write_scene (main thread) → save_blend
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...core.body.fields import potential_named
from ...core.body.skin.texture import TEXTURE
from ...core.cli.streams import unheard
from ...core.foundation import store
from ...core.foundation.bounded import real_path, real_place
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.motion.formats.ply import Ply
from ...core.results import blend_file
from ...core.results.folder import FIELDS
from ...core.results.outputs import check_replaceable
from ...core.run.stages import STAGES
from ...core.take.footage import Footage
from . import action, armature, built, cameras, clips, excluded, footage_plane, layers, metaballs, skin, standing, stored, surroundings
from .cloud import CloudPoints, add_cloud, pixel_size_m
from .contents import Contents, read_contents
from .earlier import Earlier
from .frame_rate import set_rate
from .looking import look_at
from .options import DEFAULTS, KEYS_KEY, OUT_KEY, PART_KEY, PLACES_KEY, POINTS_KEY, SceneOptions
from .rest_pose import REST_POSE_KEY, with_rest_pose
from .trajectories import add_arrows, add_bends, add_removed, add_trajectories, sparser, trail_radius_m

COLLECTION = "Tricap"
MOST_STRAY = 1  # images by which the footage may be shown at another moment without a word
SEGMENTS_KEY = "tricap_segments"  # of cloud and trajectories: the bones' names, in the order of the attribute's numbers
DOUBTFUL = "Doubtful"  # the first word of the timeline's markers of doubtful stretches


@dataclass(frozen=True, kw_only=True)
class SceneReport:
    """What was built: names and counts, and warnings about missing parts."""

    collection: str
    counts: dict[str, int]
    warnings: tuple[str, ...]
    blend: Path | None = None

    def __str__(self) -> str:
        return ", ".join(f"{count} {what}" for what, count in self.counts.items() if count) or "nothing"


def build_scene(out: Path, blend: Path | None = None, monitor: Monitor | None = None, options: SceneOptions = DEFAULTS) -> SceneReport:
    """Put the results in OUT into the open scene in place of those of an earlier build, and save a copy as `blend`.

    Raises:
        InputError: OUT is no folder of results or damaged, or the file cannot be written.
        Cancelled: the monitor was cancelled; the scene is unchanged.
    """
    monitor = monitor or Monitor()
    return write_scene(read_contents(Path(out), monitor, skins=options.exact_skin), blend, options, monitor)


def write_scene(
    contents: Contents,
    blend: Path | None = None,
    options: SceneOptions = DEFAULTS,
    monitor: Monitor | None = None,
    replaced: Callable[[Sequence[bpy.types.Action]], None] | None = None,
) -> SceneReport:
    """The second half of `build_scene`: main thread only. Everything that can fail comes before the removal of an earlier build.

    `replaced` is called when that is done, before the file is saved, with the edited actions of the earlier build, which stay.
    """
    if options.exact_skin and blend is None:
        raise InputError("The exact skin is saved next to the Blender file; give the Blender file a name.")
    if options.exact_skin and blend is not None:
        check_replaceable(skin.cache_of(blend), skin.PC2_START)
    scene = bpy.context.scene
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    surface = _implicit_surface(contents, options, monitor) if options.implicit else None
    opened = _opened_clips(scene, contents)
    warnings, earlier = [*contents.warnings], Earlier.set_aside(scene)
    collection = bpy.data.collections.new(COLLECTION)
    collection[OUT_KEY] = str(contents.out)
    collection[KEYS_KEY] = {stage: e["key"] for stage, e in contents.run.get("stages", {}).items() if e.get("key") and stage in STAGES}
    if blend is not None:
        collection[PLACES_KEY] = _places(contents, real_place(blend).parent)
    scene.collection.children.link(collection)
    set_time(scene, contents)
    counts: dict[str, int] = {}
    counts["cameras"] = _add_cameras(scene, _part(collection, "Cameras"), contents, opened, warnings)
    measured = _part(collection, "Measured")
    measured.hide_render = measured[POINTS_KEY] = True
    counts["cloud points"] = _add_cloud(measured, contents, options, warnings)
    if contents.trajectories is not None:
        counts["trajectories"] = _add_trajectories(measured, contents, contents.trajectories, options, warnings)
    body = _part(collection, "Body")
    counts |= _add_body(body, contents, warnings, options, blend)
    if surface is not None:
        skin.add_implicit(measured, *surface, potential_named(options.field))
    wanted = options.arrows or options.implicit or contents.raw is not None
    if counts.get("bones") and not wanted:  # cloud and trails would lie over the skin
        excluded.show(scene, POINTS_KEY, False)
    if options.studio:
        _add_studio(scene, collection, body, contents)
    mark_doubtful(scene, contents.doubtful)
    if contents.bar is not None:
        counts["positions of the bar"] = _add_bar(_part(collection, "Bar"), contents.frames[0], *contents.bar)
    built.mark(collection)
    earlier.remove(scene, collection)
    if replaced is not None:
        replaced(earlier.edited)
    scene.frame_set(scene.frame_start)
    if bpy.app.background and (armature_object := next(standing.all_bodies(scene), None)) is not None:
        look_at(armature_object)
    if blend is not None and (kept := save_blend(Path(blend))):
        warnings.append(kept)
    return SceneReport(collection=collection.name, counts=counts, warnings=tuple(warnings), blend=blend)


def _part(collection: bpy.types.Collection, name: str) -> bpy.types.Collection:
    """A new collection in that of the scene."""
    part = bpy.data.collections.new(name)
    part[PART_KEY] = True
    collection.children.link(part)
    return part


def _add_studio(scene: bpy.types.Scene, collection: bpy.types.Collection, body: bpy.types.Collection, contents: Contents) -> None:
    """Lights, a floor where it is known or a person stands, and a bright background in a scene without one."""
    surroundings.add_lights(_part(collection, "Lights"))
    standing_body = next((o for o in body.all_objects if standing.LIFT_KEY in (o.data or ())), None)
    if standing_body is not None:
        surroundings.add_floor(_part(collection, "Floor"), standing_body.location.z, standing.covered(standing_body))
    elif _has_floor(contents):
        surroundings.add_floor(_part(collection, "Floor"))
    surroundings.add_background(scene)


def _places(contents: Contents, folder: Path) -> dict[str, str]:
    """The folders of the results and of the take relative to a folder; without those on another drive."""
    places = {}
    for name, place in (("out", contents.out), ("take", Path(contents.run.get("take", contents.out)))):
        with suppress(ValueError):
            places[name] = os.path.relpath(real_path(place), folder)
    return places


def set_time(scene: bpy.types.Scene, contents: Contents) -> None:
    """Give the scene the take's frames and frame rate."""
    set_rate(scene, contents.fps)
    scene.frame_start, scene.frame_end = contents.frames


def mark_doubtful(scene: bpy.types.Scene, stretches: Sequence[tuple[int, int, str]]) -> None:
    """A marker in the timeline at the first frame of every doubtful stretch, with its frames and the reason; earlier ones are removed."""
    for marker in [marker for marker in scene.timeline_markers if marker.name.startswith(DOUBTFUL)]:
        scene.timeline_markers.remove(marker)
    for first, last, reason in stretches:
        frames = str(first) if first == last else f"{first}–{last}"
        scene.timeline_markers.new(f"{DOUBTFUL} {frames}: {reason}", frame=first)


def save_blend(path: Path) -> str:
    """Save a copy of the open file as `path`, completely or not at all; the open file keeps its name. An earlier file becomes .blend1;
    only the body.blend of a run is replaced, unless it may have edits: then it gets another name. Returns the sentence that says so, or "".

    Raises:
        InputError: the file cannot be written.
    """
    path = real_place(path)
    if path.suffix != ".blend":
        raise InputError(f"{path.name} is not the name of a Blender file; let it end in .blend.")
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the Blender file another name.")
    part, kept, of_run = store.part_of(path), "", path.name == blend_file.BLEND and (path.parent / "run.json").exists()
    try:
        store.try_writing(part)
        with _relative_caches(path), unheard() if bpy.app.background else nullcontext():  # it tells the name of the partial file
            bpy.ops.wm.save_as_mainfile(filepath=str(part), copy=True, relative_remap=True, compress=True)
        if of_run:
            kept = blend_file.keep_edited(path.parent)
            blend_file.note_written(path.parent, part)
        elif path.exists():
            os.replace(path, path.with_suffix(".blend1"))  # as Blender itself does
        os.replace(part, path)
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error).strip()
        raise InputError(f"Cannot write {path}: {reason}. Choose another folder or free some space.") from error
    finally:
        if part.exists():
            part.unlink()
    return kept


@contextmanager
def _relative_caches(path: Path) -> Iterator[None]:
    """While the file is saved, mesh caches in its folder have relative paths, so that both can be moved together."""
    modifiers = [m for o in bpy.data.objects for m in o.modifiers if m.type == "MESH_CACHE"]
    absolute = [(m, m.filepath) for m in modifiers if not m.filepath.startswith("//") and Path(m.filepath).parent == path.parent]
    for modifier, file in absolute:
        modifier.filepath = "//" + Path(file).name
    try:
        yield
    finally:
        for modifier, file in absolute:
            modifier.filepath = file


def _has_floor(contents: Contents) -> bool:
    """Whether the world frame of the calibration lies on the floor."""
    return contents.footage is not None and contents.footage.rig.metadata.get("floor") is True


Opened = list[tuple[bpy.types.MovieClip, list[Path]]]


def _opened_clips(scene: bpy.types.Scene, contents: Contents) -> Opened:
    """The clip of each view and its files."""
    opened: Opened = []
    footage = contents.footage
    try:
        for view, camera, sequence in zip(footage.take.views, footage.rig.cameras, footage.sequences) if footage else ():
            beside_take, in_out = (folder / FIELDS / view.name for folder in (footage.take.folder, contents.out))
            files = clips.shown_files(sequence, footage.take.field_layout, beside_take if beside_take.is_dir() else in_out)
            opened.append((clips.clip_of_view(scene, view.name, files[0], camera), files))
    except InputError:
        bpy.data.batch_remove([clip for clip, _ in opened if clip.users == 0])
        raise
    return opened


def _add_cameras(scene: bpy.types.Scene, collection: bpy.types.Collection, contents: Contents, opened: Opened, warnings: list[str]) -> int:
    footage = contents.footage
    if footage is None:
        return 0
    take = footage.take
    reference = footage.rig.cameras[take.reference]
    cameras.frame_render(scene, reference)
    warnings += cameras.frame_faults(footage.rig, reference)
    for k, (view, camera, (clip, files)) in enumerate(zip(take.views, footage.rig.cameras, opened)):
        camera_object = cameras.add_camera(collection, camera)
        camera_object["tricap_interlaced"] = take.interlaced
        if clip.name.startswith(name := f"Footage {view.name}"):
            clip.name = name  # until now the clip of an earlier build had it
        clip.frame_start = _first_frame(footage, k)
        if footage.clocks and (off := footage.strays_frames(k, clip.frame_start)) > MOST_STRAY * take.field_layout.per_image:
            warnings.append(
                f"View {view.name} has its own images per second or time stamps. Blender shows its footage at the rate of the take, up to "
                f"{off:.0f} frames from its moment."
            )
        clips.show_behind(camera_object.data, clip)
        warnings += clips.clip_faults(clip, camera, files, f"view {view.name}")
        footage_plane.add_screen(collection, camera_object, camera, clip, files)
        if camera is reference:
            scene.camera, scene.active_clip = camera_object, clip
    return len(take.views)


def _first_frame(footage: Footage, view: int) -> int:
    """The scene's frame that shows the first image of a view."""
    per = footage.take.field_layout.per_image
    if footage.clocks:
        return per * round(footage.clocks[view].time_s(0) * footage.take.fps / per)
    return -per * footage.take.views[view].offset_frames


def _add_bar(collection: bpy.types.Collection, first: int, frames: np.ndarray, ends_m: np.ndarray) -> int:
    """The waved bar of the calibration recording, starting in the scene's first frame; not rendered."""
    surroundings.add_bar(collection, frames - frames[0] + first, ends_m).hide_render = True
    return len(frames)


def _add_cloud(collection: bpy.types.Collection, contents: Contents, options: SceneOptions, warnings: list[str]) -> int:
    whole = sum(len(ply.xyz_m) for ply in contents.clouds.values())
    every = -(-whole // options.most_points) or 1
    if every > 1:
        where = contents.out / "clouds"
        warnings.append(f"The scene shows one in {every} of {whole} cloud points to stay responsive; {where} has all.")
    shown = [_cloud_points(frame, ply, every, contents) for frame, ply in contents.clouds.items()]
    if shown:
        _name_segments(add_cloud(collection, shown, options.colour, _pixel_m(contents)), contents)
    return sum(len(cloud.xyz_m) for cloud in shown)


def _pixel_m(contents: Contents) -> float:
    """How large the pixels of the scene's camera are at the person; 0 without footage or cloud."""
    clouds = [ply.xyz_m for ply in contents.clouds.values() if len(ply.xyz_m)]
    if contents.footage is None or not clouds:
        return 0.0
    return pixel_size_m(contents.footage.rig.cameras[contents.footage.take.reference], clouds[len(clouds) // 2])


def _cloud_points(frame: int, ply: Ply, every: int, contents: Contents) -> CloudPoints:
    xyz, prepared = ply.xyz_m[::every], contents.prepared
    names = ("sigma", "nx", "ny", "nz", "intensity")
    column = {name: ply.vertex[name][::every] if name in ply.vertex else np.zeros(len(xyz)) for name in names}
    normals = np.stack([column[name] for name in ("nx", "ny", "nz")], axis=-1)
    return CloudPoints(
        frame=frame,
        xyz_m=xyz,
        sigma_m=column["sigma"],
        normals=normals,
        intensity=column["intensity"],
        velocity_m_s=prepared.velocity_m_s[frame][::every],
        segment=prepared.segment[frame][::every],
    )


def _add_trajectories(
    collection: bpy.types.Collection, contents: Contents, arrays: Mapping[str, np.ndarray], options: SceneOptions, warnings: list[str]
) -> int:
    assert contents.prepared.track_segment is not None
    shown, every = sparser({**arrays, "segment": contents.prepared.track_segment}, options.most_points)
    if every > 1:
        warnings.append(f"The scene shows one in {every} of {arrays['xyz_m'].shape[1]} trajectories to stay responsive.")
    radius_m = trail_radius_m(_pixel_m(contents))
    _name_segments(add_trajectories(collection, shown, radius_m=radius_m), contents)
    if options.arrows:
        add_arrows(collection, shown, radius_m)
        add_bends(collection, shown, radius_m)
    if contents.raw is not None:
        add_removed(collection, contents.raw, options.most_points, radius_m)
    return int(shown["xyz_m"].shape[1])


def _name_segments(thing: bpy.types.Object, contents: Contents) -> None:
    """Store the names of the bones that the attribute `segment` numbers with an object."""
    if contents.prepared.bones:
        thing[SEGMENTS_KEY] = list(contents.prepared.bones)


def _implicit_surface(
    contents: Contents, options: SceneOptions, monitor: Monitor | None
) -> tuple[tuple[np.ndarray, np.ndarray], int] | None:
    """The implicit surface in the chosen or the middle frame, and that frame; None where it has no pose.

    Raises:
        InputError: the field is unknown, or this Blender was built without OpenVDB.
    """
    shape, motion, potential = contents.shape, contents.motion, potential_named(options.field)
    if shape is None:
        return None
    dof_values, frame = np.zeros(len(shape.skeleton.dof_names)), contents.frames[0]
    if motion is not None:
        row = len(motion.frames) // 2 if options.frame is None else int(np.argmin(np.abs(motion.frames - options.frame)))
        dof_values, frame = motion.values[row], int(motion.frames[row])
    return (skin.implicit_surface(shape, dof_values, monitor, potential), frame) if np.isfinite(dof_values).all() else None


def _add_body(
    collection: bpy.types.Collection, contents: Contents, warnings: list[str], options: SceneOptions, blend: Path | None
) -> dict[str, int]:
    shape, motion = contents.shape, contents.motion
    if shape is None:
        return {}
    n = len(shape.skeleton.dof_names)
    values, sigma = (motion.values, motion.sigma) if motion is not None else (np.zeros((0, n)), np.zeros((0, n)))
    measured_shape = shape
    shape, values, sigma = with_rest_pose(shape, values, sigma, options.rest_pose)
    chosen = stored.number(bpy.context.scene, standing.FLOOR_KEY)
    known_floor = float(chosen) if chosen is not None else 0.0 if _has_floor(contents) else None
    frames = motion.frames if motion is not None else np.zeros(0)
    rest_skin = contents.prepared.skin
    stand = standing.standing(shape, rest_skin.vertices_m if rest_skin else None, values, frames, contents.fps, known_floor)
    armature_object = armature.add_armature(collection, shape, stand)
    armature_object.data[REST_POSE_KEY] = options.rest_pose
    flesh = metaballs.add_metaballs(metaballs.add_collection(collection), armature_object, shape)
    counts = {"bones": len(armature.rig_bones(shape)), "metaball parts": len(flesh)}
    if len(shape.metaballs.weight):
        layers.add_ellipsoids(collection, armature_object, shape, stand.lift_m if stand is not None else 0.0)
    try:
        like = contents.prepared.skin
        prepared = like and skin.in_rest_pose(like, measured_shape, shape)
        texture = contents.out / "skin" / TEXTURE if prepared is not None else None
        shown = skin_object = skin.add_skin(collection, armature_object, shape, options.detail, contents.skin_settings, prepared, texture)
        if stand is not None:
            skin_object.data.transform(Matrix.Translation((0.0, 0.0, stand.lift_m)))
        if contents.skins is not None and blend is not None:
            shown = skin.add_exact_skin(collection, measured_shape, contents.skins, skin.cache_of(blend))
            counts["exact skin faces"] = len(shown.data.polygons)
    except InputError as error:
        warnings.append(f"No polygonal skin in the scene: {error}")
    else:
        for other in {*flesh, skin_object} - {shown}:  # they coincide with the surface that is shown
            other.hide_render = True
        skin_object.hide_set(skin_object is not shown)
        shown[layers.LAYER_KEY] = layers.SKIN
        excluded.show(bpy.context.scene, metaballs.COLLECTION_KEY, False)
        counts["skin faces"] = len(skin_object.data.polygons)
    if motion is not None:
        places = action.place_sigmas(shape, contents.joints, motion.frames) if contents.joints is not None else None
        action.add_action(armature_object, shape, motion.frames, motion.dof_names, values, sigma, stand, places)
        counts["frames of motion"] = len(motion.frames)
        if options.simplify_deg > 0:
            action.add_simplified(armature_object, shape, motion.frames, motion.dof_names, values, options.simplify_deg, stand)
    return counts
