"""Reads armatures and their actions as plain values, in world space. Main thread only.

Motion is read by playing the scene once, with constraints, drivers and layers; everything else is done on arrays.
"""

from collections.abc import Generator, Iterable, Sequence
from dataclasses import replace
from typing import TypeVar, cast

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.motion.plausible import check_span
from ...core.motion.retarget.mapping import RigMap
from ...core.motion.retarget.residual_motion import from_text
from ...core.motion.retarget.rig import Motion, Rig
from ...core.motion.retarget.roles import role_of
from ...core.motion.retarget.transfer import standing_turn
from ..scene import layers, stored
from ..scene.action_curves import curves_of, keys_digest
from ..scene.armature import ROLES_KEY

A = TypeVar("A")
UNIFORM = 1e-3  # relative tolerance between the scales along the axes
RESIDUAL_KEY = "tricap_unshown"  # custom property of an action: its residual motion, and a digest of the keys that it belongs to


def read_rig(armature_object: bpy.types.Object) -> Rig:
    """The rest pose of an armature object in the world, parents first.

    Raises:
        InputError: it is not an armature, has no bones, or is scaled unevenly.
    """
    if armature_object is None or armature_object.type != "ARMATURE":
        raise InputError(f"{getattr(armature_object, 'name', 'Nothing')} is not an armature; choose an armature.")
    bones = in_order(armature_object)
    if not bones:
        raise InputError(f"The armature “{armature_object.name}” has no bones; choose another.")
    world = world_matrix(armature_object)
    scale_of(armature_object)
    rest = np.array([bone.matrix_local for bone in bones])
    index = {bone.name: i for i, bone in enumerate(bones)}
    return Rig(
        names=tuple(index),
        parents=np.array([index[b.parent.name] if b.parent else -1 for b in bones]),
        R_rest=orthonormal(world[:3, :3] @ rest[:, :3, :3]),
        head_m=_moved(world, [b.head_local for b in bones]),
        tail_m=_moved(world, [b.tail_local for b in bones]),
        connected=np.array([b.use_connect for b in bones]),
        inherits_rotation=np.array([b.use_inherit_rotation for b in bones]),
        roles=humanoid_roles(armature_object),
        sole_m={},
    )


def in_order(armature_object: bpy.types.Object) -> list[bpy.types.Bone]:
    """All bones, parents before children."""
    ordered: list[bpy.types.Bone] = []
    front = [bone for bone in armature_object.data.bones if bone.parent is None]
    while front:
        bone = front.pop(0)
        ordered.append(bone)
        front = [*bone.children, *front]
    return ordered


def world_matrix(armature_object: bpy.types.Object) -> np.ndarray:
    """Object to world (4, 4)."""
    return np.array(armature_object.matrix_world)


def scale_of(armature_object: bpy.types.Object) -> float:
    """The object's scale.

    Raises:
        InputError: it differs along the axes, is zero, or is negative.
    """
    M = world_matrix(armature_object)[:3, :3]
    lengths = np.linalg.norm(M, axis=0)
    if not np.isfinite(M).all() or lengths.min() < 1e-9:
        raise InputError(f"The armature “{armature_object.name}” is scaled to nothing; give it a size.")
    sheared = np.abs(M.T @ M / lengths.mean() ** 2 - np.eye(3)).max() > 2 * UNIFORM
    if sheared or np.linalg.det(M) < 0:
        raise InputError(f"The armature “{armature_object.name}” is scaled unevenly or mirrored; apply its scale (Ctrl A).")
    return float(lengths.mean())


def _moved(world: np.ndarray, points: Sequence[object]) -> np.ndarray:
    return np.array(points, dtype=float).reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]


def orthonormal(M: np.ndarray) -> np.ndarray:
    """The rotations (…, 3, 3) nearest to matrices without shear: their columns' directions."""
    U, _, V = np.linalg.svd(M)
    return U @ V


def humanoid_roles(armature_object: bpy.types.Object) -> dict[str, str]:
    """The bone of each part, as stored by Tricap's import or its own armatures, or by the VRM add-on."""
    roles = stored.table(armature_object.data, ROLES_KEY)
    if roles:
        return {role: name for role, name in roles.items() if isinstance(name, str) and name in armature_object.data.bones}
    extension = getattr(armature_object.data, "vrm_addon_extension", None)
    found: dict[str, str] = {}
    for table in (_vrm1(extension), _vrm0(extension)):  # the table of the other version is empty
        found |= {role: name for role, name in table.items() if name in armature_object.data.bones and role not in found}
    return found


def _vrm1(extension: object) -> dict[str, str]:
    """Bones by role from the VRM add-on's table of VRM 1: one attribute for each human bone."""
    bones = getattr(getattr(getattr(extension, "vrm1", None), "humanoid", None), "human_bones", None)
    return {role: getattr(getattr(getattr(bones, attribute, None), "node", None), "bone_name", "") for role, attribute in VRM.items()}


def _vrm0(extension: object) -> dict[str, str]:
    """Bones by role from the VRM add-on's table of VRM 0: a list of human bones by their names in the file."""
    rows = getattr(getattr(getattr(extension, "vrm0", None), "humanoid", None), "human_bones", None) or ()
    named = {role_of(row.bone): row.node.bone_name for row in rows}
    return {role: name for role, name in named.items() if role}


VRM = {"hips": "hips", "head": "head"} | {
    f"{role}.{side}": f"{word}_{part}"
    for side, word in (("L", "left"), ("R", "right"))
    for role, part in (
        ("clavicle", "shoulder"),
        ("upper_arm", "upper_arm"),
        ("forearm", "lower_arm"),
        ("hand", "hand"),
        ("thigh", "upper_leg"),
        ("shin", "lower_leg"),
        ("foot", "foot"),
        ("toe", "toes"),
    )
}


def read_pose(armature_object: bpy.types.Object, rig: Rig, frame: int) -> Motion:
    """The pose of an armature as it stands now, also if it has no keys yet, as a motion of one frame.

    Raises:
        InputError: Blender does not move the armature.
    """
    check_plays(armature_object)
    world = world_matrix(armature_object)
    matrices = np.array([armature_object.pose.bones[name].matrix for name in rig.names])
    R, head_m = orthonormal(world[:3, :3] @ matrices[:, :3, :3]), _moved(world, [*matrices[:, :3, 3]])
    return Motion(rig=rig, fps=1.0, frames=np.array([frame]), R=R[None], head_m=head_m[None])


def check_plays(thing: bpy.types.Object) -> None:
    """Check that Blender moves an object in the scene that is shown: what is switched off stays in an old pose.

    Raises:
        InputError: it does not.
    """
    if all(evaluated.original != thing for evaluated in bpy.context.evaluated_depsgraph_get().ids):
        why = "it is in another scene, its collection is excluded or hidden, or it is disabled in viewports"
        raise InputError(f"Blender does not play “{thing.name}”: {why}. Switch it on in the Outliner.")


def with_soles(rig: Rig, armature_object: bpy.types.Object, rig_map: RigMap) -> Rig:
    """The rig with the sole points of its feet, from the skins that it deforms: the points that would touch a floor at various tilts."""
    wanted = [name for side in "LR" for part in ("foot", "toe") for name in rig_map.bones.get(f"{part}.{side}", ())]
    instead = rig_map.control_rig.skin if rig_map.control_rig is not None else {}
    meant = {instead.get(name, name): name for name in wanted}
    points: dict[str, list[np.ndarray]] = {}
    for skin in [o for o in bpy.data.objects if o.type == "MESH" and not layers.is_ellipsoids(o)]:
        if armature_object not in (modifier.object for modifier in skin.modifiers if modifier.type == "ARMATURE"):
            continue
        groups = {group.index: meant[group.name] for group in skin.vertex_groups if group.name in meant}
        if not groups:
            continue
        place = np.empty(3 * len(skin.data.vertices))
        skin.data.vertices.foreach_get("co", place)
        place = _moved(world_matrix(skin), place.reshape(-1, 3))
        for name, vertices in _by_dominant_group(skin, groups).items():
            points.setdefault(name, []).append(place[vertices])
    turn = standing_turn(rig, rig_map)
    soles = {name: sole_points(np.concatenate(parts) @ turn.T) @ turn for name, parts in points.items()}
    return Rig(**{f: getattr(rig, f) for f in rig.__dataclass_fields__ if f != "sole_m"}, sole_m=soles)


def _by_dominant_group(skin: bpy.types.Object, groups: dict[int, str]) -> dict[str, list[int]]:
    """Vertices by the group that has more than half of their weight."""
    found: dict[str, list[int]] = {}
    for vertex in skin.data.vertices:
        weights = {g.group: g.weight for g in vertex.groups}
        strongest = max(weights, key=lambda group: weights[group], default=-1)
        if strongest in groups and weights[strongest] > 0.5 * sum(weights.values()):
            found.setdefault(groups[strongest], []).append(vertex.index)
    return found


def sole_points(points: np.ndarray) -> np.ndarray:
    """The points (K, 3) of a cloud that a plane touches from below, at tilts of up to 75° in all directions."""
    tilt, heading = np.meshgrid(np.radians([0, 15, 30, 45, 60, 75]), np.radians(np.arange(0, 360, 30)))
    down = -np.stack([np.sin(tilt) * np.cos(heading), np.sin(tilt) * np.sin(heading), np.cos(tilt)], axis=-1).reshape(-1, 3)
    return points[np.unique(np.argmax(down @ points.T, axis=1))]


def ended(steps: Generator[None, None, A]) -> A:
    """Take all steps at once; the result at their end."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return cast(A, end.value)


def read_motion(armature_object: bpy.types.Object, rig: Rig, frames: Sequence[int], monitor: Monitor | None = None) -> Motion:
    """The motion of an armature as it plays in its scene, constraints and all. The scene's current frame is restored."""
    return ended(reading_motion(armature_object, rig, frames, monitor))


def reading_motion(
    armature_object: bpy.types.Object, rig: Rig, frames: Sequence[int], monitor: Monitor | None = None
) -> Generator[None, None, Motion]:
    """`read_motion` with a step for each frame, so that the window can be drawn meanwhile.

    Raises:
        InputError: Blender does not move the armature, or a bone has no place in some frame.
    """
    check_plays(armature_object)
    scene = bpy.context.scene
    now, names, monitor = scene.frame_current, rig.names, monitor or Monitor()
    pose = np.empty((len(frames), len(names), 4, 4))
    world = np.empty((len(frames), 4, 4))
    try:
        for i, frame in enumerate(frames):
            monitor.step("reading the motion", i, len(frames))
            scene.frame_set(int(frame))
            bones = armature_object.pose.bones
            pose[i] = [bones[name].matrix for name in names]
            world[i] = armature_object.matrix_world
            yield
    finally:
        scene.frame_set(now)
    placed = world[:, None] @ pose
    known = np.isfinite(placed).all(axis=(1, 2, 3))
    if not known.all():
        bad = f"“{armature_object.name}” has bones at no place in frame {frames[int(np.argmin(known))]}"
        raise InputError(f"{bad}: a key, a constraint or a driver gives no number there. Repair it.")
    return Motion(
        rig=rig,
        fps=scene.render.fps / scene.render.fps_base,
        frames=np.asarray(frames, dtype=float),
        R=orthonormal(placed[..., :3, :3]),
        head_m=placed[..., :3, 3],
    )


def action_frames(armature_object: bpy.types.Object) -> range:
    """The whole frames of an armature's action.

    Raises:
        InputError: it has none, or has some keys in very many frames.
    """
    data = armature_object.animation_data
    if data is None or (data.action is None and not data.nla_tracks):
        raise InputError(f"The armature “{armature_object.name}” has no action; choose one with an action.")
    if data.action is None:
        first, last = float(bpy.context.scene.frame_start), float(bpy.context.scene.frame_end)
        actions = [strip.action for track in data.nla_tracks for strip in track.strips if strip.action is not None]
    else:
        (first, last), actions = data.action.frame_range, [data.action]
    what = f"The action of “{armature_object.name}” reaches"
    check_span(first, last, frames_with_keys(actions), what, bones=len(armature_object.data.bones))
    return range(int(np.ceil(first - 1e-4)), int(np.floor(last + 1e-4)) + 1)


def frames_with_keys(actions: Iterable[bpy.types.Action]) -> int:
    """In how many frames any curve has a key: thousands of curves may have theirs in the same two."""
    frames = set[float]()
    for curve in (curve for action in actions for curve in curves_of(action)):
        places = np.empty(2 * len(curve.keyframe_points), dtype=np.float32)
        curve.keyframe_points.foreach_get("co", places)
        frames.update(np.round(places[::2][np.isfinite(places[::2])]).tolist())
    return len(frames)


def with_residual_motion(armature_object: bpy.types.Object, motion: Motion) -> Motion:
    """The motion of an armature, with the residual motion stored in its action, or with a note why that is not used.

    Raises:
        InputError: the stored residual motion is damaged.
    """
    action = action_with_residual(armature_object)
    if action is None:
        return motion
    residual = stored.table(action, RESIDUAL_KEY)
    if keys_digest(action) != residual["keys"]:
        note = (
            f"“{action.name}” was edited since it was retargeted: the detail of its source that its rig cannot show is lost. "
            "Edit in an NLA layer above it to keep that detail"
        )
        return replace(motion, notes=(*motion.notes, note))
    return replace(motion, residual=from_text(residual["motion"]).at(motion.frames))


def action_with_residual(armature_object: bpy.types.Object) -> bpy.types.Action | None:
    """The action with residual motion that the armature plays, if it plays exactly one, unscaled and unshifted."""
    data = armature_object.animation_data
    strips = [strip for track in data.nla_tracks if not track.mute for strip in track.strips if not strip.mute]
    own_time = [s.action for s in strips if s.action and s.scale == 1.0 and s.repeat == 1.0 and s.frame_start == s.action_frame_start]
    found = [action for action in (data.action, *own_time) if action is not None and _has_residual(action)]
    return found[0] if len(found) == 1 else None


def _has_residual(action: bpy.types.Action) -> bool:
    residual = stored.table(action, RESIDUAL_KEY)
    return all(isinstance(residual.get(name), str) for name in ("motion", "keys"))
