"""What an armature plays, for export: its edited action, its NLA layers, constraints and drivers, as a plain motion with skins.

Only the bones that deform are exported, each below its nearest ancestor that deforms, and the one bone on which all of them stand (the
root, which carries the path). Control bones are not. Meshes are copied as they are bound in the rest pose; a mesh whose parent is a bone
is bound to this bone alone.
"""

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.motion.formats.markers import Markers
from ...core.motion.formats.ply import write_mesh
from ...core.motion.plausible import check_span
from ...core.motion.retarget.rig import Motion, Rig
from ...core.results.listed_files import PLY, check_files, list_files
from ..scene import layers, stored
from ..scene.armature import JOINTS_KEY
from .read import action_frames, check_plays, frames_with_keys, read_rig, reading_motion

RIGID = "Tricap rigid"  # the modifier of the copy of a mesh whose parent is a bone


def played_frames(scene: bpy.types.Scene) -> range:
    """The frames that Blender plays."""
    if scene.use_preview_range:
        return range(scene.frame_preview_start, scene.frame_preview_end + 1)
    return range(scene.frame_start, scene.frame_end + 1)


def exported_frames(scene: bpy.types.Scene) -> range:
    """The frames that Blender plays.

    Raises:
        InputError: there are none, or far more than there are keys in the file.
    """
    frames = played_frames(scene)
    if not frames:
        raise InputError(f"The scene ends in frame {scene.frame_end}, before it begins; correct its frame range.")
    bones = max((len(o.data.bones) for o in scene.objects if o.type == "ARMATURE"), default=0)
    check_span(frames[0], frames[-1], frames_with_keys(bpy.data.actions), "The scene plays", bones=bones)
    return frames


def keyed_frames(armature_object: bpy.types.Object) -> range:
    """The frames that Blender plays and in which an armature has keys.

    Raises:
        InputError: there are none.
    """
    played, keyed = played_frames(bpy.context.scene), action_frames(armature_object)
    both = range(max(played.start, keyed.start), min(played.stop, keyed.stop))
    if not both:
        scene = f"the scene plays frames {played.start} to {played.stop - 1}"
        raise InputError(
            f"“{armature_object.name}” has keys in frames {keyed.start} to {keyed.stop - 1}, and {scene}; correct its frame range."
        )
    return both


def reading_played(armature_object: bpy.types.Object, monitor: Monitor | None = None) -> Generator[None, None, Motion]:
    """The motion of the exported bones in every frame that Blender plays, with a step for each. Main thread only.

    Raises:
        InputError: it is not an armature, has no bones, or is scaled unevenly.
        Cancelled: the monitor was cancelled.
    """
    scene = bpy.context.scene
    if armature_object.name not in scene.objects:
        raise InputError(f"The armature “{armature_object.name}” is not in this scene; choose another.")
    frames = exported_frames(scene)
    with in_first_frame():
        rig = exported_rig(armature_object)
    return (yield from reading_motion(armature_object, rig, frames, monitor))


@contextmanager
def in_first_frame() -> Iterator[None]:
    """While the rest pose is read: an armature object may move, too, and its rest pose is where it stands first."""
    scene = bpy.context.scene
    now = scene.frame_current
    scene.frame_set(played_frames(scene).start)
    try:
        yield
    finally:
        scene.frame_set(now)


def exported_rig(armature_object: bpy.types.Object) -> Rig:
    """The bones to export (see above); all bones of an armature of which none deforms.

    Raises:
        InputError: see `read_rig`.
    """
    rig, bones = read_rig(armature_object), armature_object.data.bones
    kept = [b for b, name in enumerate(rig.names) if bones[name].use_deform] or list(range(len(rig.names)))
    roots = {rig.ancestors(b)[-1] for b in kept}
    kept = sorted({*kept, *roots}) if len(roots) == 1 else kept
    row = {b: i for i, b in enumerate(kept)}
    parents = [next((row[a] for a in rig.ancestors(b)[1:] if a in row), -1) for b in kept]
    names = tuple(rig.names[b] for b in kept)
    return replace(
        rig,
        names=names,
        parents=np.array(parents),
        R_rest=rig.R_rest[kept],
        head_m=rig.head_m[kept],
        tail_m=rig.tail_m[kept],
        connected=np.zeros(len(kept), dtype=bool),
        inherits_rotation=np.ones(len(kept), dtype=bool),
        roles={role: name for role, name in rig.roles.items() if name in names},
    )


def points_of_played(armature_object: bpy.types.Object, motion: Motion) -> Markers:
    """The joints of Tricap's own body, or the heads of another armature's bones; without sigmas, which only a measurement has."""
    names, places = list(motion.rig.names), [motion.head_m]
    ends = stored.rows(armature_object.data, JOINTS_KEY, bone=str, at_tail=int)
    joints = {joint: (end["bone"], bool(end["at_tail"])) for joint, end in ends.items()}
    if joints and all(bone in motion.rig.index for bone, _ in joints.values()):
        length = np.linalg.norm(motion.rig.tail_m - motion.rig.head_m, axis=1)
        tail_m = motion.head_m + length[:, None] * motion.R[..., 1]
        names = list(joints)
        places = [(tail_m if at_tail else motion.head_m)[:, [motion.rig.index[bone]]] for bone, at_tail in joints.values()]
    xyz_m = np.concatenate(places, axis=1)
    return Markers(names=tuple(names), fps=motion.fps, frames=motion.frames, xyz_m=xyz_m, sigma_m=np.full(xyz_m.shape[:2], np.nan))


def skins_of(armature_object: bpy.types.Object) -> list[bpy.types.Object]:
    """The meshes that the armature deforms or carries: those that are visible or rendered, or all if none is."""
    bound = [o for o in bpy.context.scene.objects if o.type == "MESH" and (_deforming(o, armature_object) or _carrier(o, armature_object))]
    meshes = [o for o in bound if not layers.is_ellipsoids(o)]
    return [o for o in meshes if o.visible_get() or not o.hide_render] or meshes


def _deforming(mesh: bpy.types.Object, armature_object: bpy.types.Object) -> list[bpy.types.Modifier]:
    return [modifier for modifier in mesh.modifiers if modifier.type == "ARMATURE" and modifier.object == armature_object]


def _carrier(mesh: bpy.types.Object, armature_object: bpy.types.Object) -> str:
    """The bone that is the parent of a mesh, "" for none."""
    carried = mesh.parent == armature_object and mesh.parent_type == "BONE" and not _deforming(mesh, armature_object)
    return str(mesh.parent_bone) if carried else ""


@contextmanager
def copied_skins(skins: list[bpy.types.Object], source: bpy.types.Object, plain: bpy.types.Object, scale: float) -> Iterator[None]:
    """Copies of meshes in the open scene, in the rest pose of `source` times `scale`, deformed by the armature `plain` instead.

    Meanwhile the copies have the names of their originals.
    """
    named = [(thing, thing.name) for mesh in skins for thing in (mesh, mesh.data) if thing.library is None]  # linked names are apart
    try:
        for mesh in skins:
            copied = _copied_skin(mesh, source, plain, scale)
            for original, copy in ((mesh, copied), (mesh.data, copied.data)):
                name = original.name
                if original.library is None:
                    original.name = f"{name} (original)"
                copy.name = name
        yield
    finally:
        for copied in [o for o in plain.children if o.type == "MESH"]:
            copied.name, copied.data.name = "copy", "copy"
        for thing, name in named:
            thing.name = name


def _copied_skin(mesh: bpy.types.Object, source: bpy.types.Object, plain: bpy.types.Object, scale: float) -> bpy.types.Object:
    bone = _carrier(mesh, source)
    place = _rest_matrix(mesh, source, bone) if bone else mesh.matrix_world.copy()
    copied = mesh.copy()
    copied.data = mesh.data.copy()
    bpy.context.scene.collection.objects.link(copied)
    copied.animation_data_clear()
    copied.data.transform(Matrix.Scale(scale, 4) @ place, shape_keys=True)
    if place.determinant() < 0:
        copied.data.flip_normals()
    copied.parent, copied.parent_type, copied.matrix_parent_inverse, copied.matrix_basis = plain, "OBJECT", Matrix(), Matrix()
    copied.hide_render = copied.hide_viewport = False
    for modifier in _deforming(copied, source):
        modifier.object = plain
    if bone:
        _bind_whole(copied, plain, _exported(source, plain, bone))
    return copied


def _rest_matrix(mesh: bpy.types.Object, source: bpy.types.Object, bone: str) -> Matrix:
    """Where a mesh that hangs on a bone is while the armature rests: children of a bone sit at its tail."""
    rest = source.data.bones[bone]
    return (
        source.matrix_world @ rest.matrix_local @ Matrix.Translation((0, rest.length, 0)) @ mesh.matrix_parent_inverse @ mesh.matrix_basis
    )


def _exported(source: bpy.types.Object, plain: bpy.types.Object, bone: str) -> str:
    """The bone itself or its nearest ancestor among the exported ones."""
    line = [source.data.bones[bone], *source.data.bones[bone].parent_recursive]
    return next((each.name for each in line if each.name in plain.data.bones), plain.data.bones[0].name)


def _bind_whole(mesh: bpy.types.Object, armature_object: bpy.types.Object, bone: str) -> None:
    mesh.vertex_groups.clear()
    mesh.vertex_groups.new(name=bone).add(range(len(mesh.data.vertices)), 1.0, "REPLACE")
    mesh.modifiers.new(RIGID, "ARMATURE").object = armature_object


def writing_skins(armature_object: bpy.types.Object, folder: Path, monitor: Monitor | None = None) -> Generator[None, None, str]:
    """Write the meshes as they are deformed in every frame that Blender plays, one PLY file and step for each frame; returns a summary.

    Raises:
        InputError: there are no meshes, Blender does not move one of them, the folder has other PLY files, or a file cannot be written.
        Cancelled: the monitor was cancelled; the files written so far stay.
    """
    scene, skins, monitor = bpy.context.scene, skins_of(armature_object), monitor or Monitor()
    if not skins:
        raise InputError(f"The armature “{armature_object.name}” deforms no mesh; bind one to it, or choose another format.")
    for thing in (armature_object, *skins):
        check_plays(thing)
    frames, now = exported_frames(scene), scene.frame_current
    check_files(folder, PLY)
    list_files(folder, PLY, [f"{frame:04d}.ply" for frame in frames])
    try:
        for i, frame in enumerate(frames):
            monitor.step("writing skins", i, len(frames))
            scene.frame_set(frame)
            vertices_m, faces = _evaluated(skins)
            write_mesh(folder / f"{frame:04d}.ply", vertices_m, faces)
            yield
    finally:
        scene.frame_set(now)
    return f"{len(frames)} files with {len(vertices_m)} points each"


def _evaluated(meshes: list[bpy.types.Object]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] in the world and triangles (F, 3) of meshes as they are now."""
    graph, places, faces, before = bpy.context.evaluated_depsgraph_get(), [], [], 0
    for mesh in meshes:
        now = mesh.evaluated_get(graph)
        data = now.to_mesh()
        co, triangles = np.empty(3 * len(data.vertices), dtype=np.float32), np.empty(3 * len(data.loop_triangles), dtype=np.int32)
        data.vertices.foreach_get("co", co)
        data.loop_triangles.foreach_get("vertices", triangles)
        world = np.array(mesh.matrix_world)
        places.append(co.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
        faces.append(triangles.reshape(-1, 3) + before)
        before += len(data.vertices)
        now.to_mesh_clear()
    return np.concatenate(places), np.concatenate(faces)
