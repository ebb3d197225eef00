"""Where a person stands: the floor under the feet, the rest pose on it, and what carries the path over it.

A whole body rests with its soles at z = 0 of its armature, whose object stands on the floor. The bone `root` on the floor carries the
path: its location is where the base of the skeleton is, seen from above. The height belongs to the base bone, the pelvis. So the channels
are the degrees of freedom of motion.csv, but for a constant in the height.

The path is two F-curves (x and y), which can be moved to the armature object, or muted, so that the person moves in place. Edited keys
stay. The heading stays in the rotation of the pelvis, in which it is one channel with the measured sigma; exports for game engines move it
to the root bone (`core/motion/retarget/root_motion.py`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import bpy
import numpy as np

from ...core.body.shape import BodyShape
from ...core.body.skeleton import bone_frames
from ...core.foundation.errors import InputError
from ..session import get_session
from . import built, stored
from .action_curves import curves_of

ROOT = "root"
LIFT_KEY = "tricap_lift_m"  # custom property of armature data: by how much the rest pose of a standing body is raised
DOFS_KEY = "tricap_dofs"  # custom property of armature data: bone, path and index of the channel of each DOF
RIG_KEY = "tricap_control_rig"  # custom property of the body's object: its control rig
MEASURED_KEY = "tricap_measured_motion"  # custom property of the body's object: the measured action while another one plays
FLOOR_KEY = "tricap_floor_m"  # custom property of the scene: the height of its floor, where the user chose it
FLOOR = "Floor"  # the name of its object
OBJECT_PATH = "location"
FEET = ("foot.L", "foot.R")


class Path(StrEnum):
    """What carries the path over the floor."""

    BONE = "BONE"
    OBJECT = "OBJECT"
    IN_PLACE = "IN_PLACE"


PATHS = (
    (Path.BONE, "Root Bone", "The root bone travels over the floor"),
    (
        Path.OBJECT,
        "Object",
        "The armature object travels; the heading stays in the pelvis. Files for Unreal and Unity have both in their root bone",
    ),
    (Path.IN_PLACE, "In Place", "The person moves in place; the path is muted"),
)


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How a person's armature stands: `lift_m`, by how much the rest pose is raised so that its soles are at zero, and the floor's z."""

    lift_m: float = 0.0
    floor_m: float = 0.0


def standing(
    shape: BodyShape, skin_m: np.ndarray | None, values: np.ndarray, frames: np.ndarray, fps: float, floor_m: float | None
) -> Standing | None:
    """How the person stands; None for a part of a body, which has no feet, and for a model whose base is not upright.

    `skin_m` (V, 3): the skin in the rest pose, which has the soles; `values` (T, D): the motion; `floor_m`: the floor where it is known.
    """
    bones = {bone.name: b for b, bone in enumerate(shape.skeleton.bones)}
    if skin_m is None or not has_feet(shape):
        return None
    _, head_m = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dof_names)))
    lowest = float(skin_m[:, 2].min())
    ankle = float(np.mean([head_m[bones[foot], 2] for foot in FEET]))
    from ...core.motion.floor import floor_height

    found = floor_m if floor_m is not None else floor_height(shape, values, frames, fps, ankle - lowest)
    return Standing(lift_m=-lowest, floor_m=0.0 if found is None else found)


def has_feet(shape: BodyShape) -> bool:
    """Whether a body can stand: it has feet, and its base is upright."""
    return set(FEET) <= {bone.name for bone in shape.skeleton.bones} and base_height(shape) is not None


def base_height(shape: BodyShape) -> tuple[str, int, float] | None:
    """The bone, index and sign of the location channel that is the height of the skeleton's base; None if no axis of it is vertical."""
    roots = [bone for bone in shape.skeleton.bones if not bone.parent]
    if len(roots) != 1 or len(shape.skeleton.base_dofs) != 3:
        return None
    up = roots[0].R_rest[2]  # the world's z in the bone's axes
    index = int(np.argmax(np.abs(up)))
    return (roots[0].name, index, float(np.sign(up[index]))) if abs(up[index]) > 1 - 1e-9 else None


def all_bodies(scene: bpy.types.Scene) -> Iterator[bpy.types.Object]:
    """The armatures of Tricap's own bodies, parts of a body too."""
    return (thing for thing in scene.objects if thing.type == "ARMATURE" and DOFS_KEY in thing.data)


def bodies(scene: bpy.types.Scene) -> Iterator[bpy.types.Object]:
    """The armatures of Tricap's own bodies that stand on a floor."""
    armatures = (thing for thing in scene.objects if thing.type == "ARMATURE")
    return (thing for thing in armatures if stored.number(thing.data, LIFT_KEY) is not None and ROOT in thing.data.bones)


def controls_of_body(body: bpy.types.Object) -> bpy.types.Object | None:
    """The control rig that drives a body, if it has one."""
    rig = stored.data_block(body, RIG_KEY, bpy.types.Object)
    return rig if rig is not None and rig.type == "ARMATURE" and rig.name in bpy.context.scene.objects else None


def dofs_of(body: bpy.types.Object) -> dict[str, dict[str, Any]]:
    """Bone, path and index of the channel of each degree of freedom of a body, as far as it has the bone."""
    found = stored.rows(body.data, DOFS_KEY, bone=str, path=str, index=int)
    return {name: dof for name, dof in found.items() if dof["bone"] in body.data.bones and dof["index"] in range(3)}


def covered(body: bpy.types.Object) -> np.ndarray:
    """The path (T, 2) [m] of a body over the floor; the origin where it has none."""
    found = {0: np.zeros(1), 1: np.zeros(1)}
    for curve in _path_curves(body):
        values = np.empty(2 * len(curve.keyframe_points), dtype=np.float32)
        curve.keyframe_points.foreach_get("co", values)
        found[curve.array_index] = values[1::2] if len(values) else np.zeros(1)
    return np.array([[low(found[0]), low(found[1])] for low in (np.min, np.max)], dtype=float)


def path_of(scene: bpy.types.Scene) -> Path:
    """What carries the path of the scene's body."""
    curves = [curve for body in bodies(scene) for curve in _path_curves(body)]
    if any(curve.data_path == OBJECT_PATH for curve in curves):
        return Path.OBJECT
    return Path.IN_PLACE if curves and all(curve.mute for curve in curves) else Path.BONE


def carry_path(scene: bpy.types.Scene, by: Path) -> None:
    """Let the root bone or the object of the scene's bodies carry the path, or nothing."""
    for body in bodies(scene):
        root, curves = body.pose.bones[ROOT], _path_curves(body)
        if any(curve.data_path == OBJECT_PATH for curve in curves):
            body.location.xy = (0.0, 0.0)
        elif by == Path.OBJECT and curves:  # its curves take the place of where the user put the object
            body.delta_location.xy += body.location.xy
        with built.no_edit(built.actions_of(body)):
            for curve in curves:
                curve.data_path = OBJECT_PATH if by == Path.OBJECT else root.path_from_id("location")
                curve.mute = by == Path.IN_PLACE
        root.location[:2] = (0.0, 0.0)
        body.update_tag()
    scene.frame_set(scene.frame_current)
    get_session().file.changed = True


def floor_of(scene: bpy.types.Scene) -> float:
    """The height [m] of the floor on which the scene's body stands; that of the scene's own choice without one, or zero."""
    body = next(bodies(scene), None)
    return float(body.location.z if body is not None else stored.number(scene, FLOOR_KEY) or 0.0)


def stand_on(scene: bpy.types.Scene, height_m: float) -> None:
    """Put the floor to a height: the rest pose and the root of the bodies stand there, and their motion in the world stays as it is.

    Raises:
        InputError: a control rig carries the body.
    """
    for body in bodies(scene):
        rig = controls_of_body(body)
        if rig is not None:
            raise InputError(f"“{rig.name}” drives “{body.name}”; set the floor before the control rig is made, or delete that first.")
    scene[FLOOR_KEY] = height_m
    for body in bodies(scene):
        lower_m, body.location.z = height_m - body.location.z, height_m
        height = next((dof for dof in dofs_of(body).values() if dof["path"] == "location" and dof["bone"] != ROOT), None)
        if height is None:
            continue
        bone = body.pose.bones[height["bone"]]
        shift = -lower_m * float(np.sign(bone.bone.matrix_local[2][height["index"]]))
        path = bone.path_from_id("location")
        bone.location[height["index"]] += shift
        with built.no_edit(built.actions_of(body)):
            for curve in (curve for action in built.actions_of(body) for curve in curves_of(action)):
                if curve.data_path == path and curve.array_index == height["index"]:
                    for point in curve.keyframe_points:
                        point.co[1], point.handle_left[1], point.handle_right[1] = (
                            at[1] + shift for at in (point.co, point.handle_left, point.handle_right)
                        )
                    curve.update()
        body.update_tag()
    for thing in scene.objects:
        if thing.name.split(".")[0] == FLOOR:
            thing.location.z = height_m
    scene.frame_set(scene.frame_current)
    get_session().file.changed = True


def _path_curves(body: bpy.types.Object) -> list[bpy.types.FCurve]:
    """The curves of x and y of the path, in every action that the body plays."""
    paths = (OBJECT_PATH, body.pose.bones[ROOT].path_from_id("location"))
    return [curve for action in built.actions_of(body) for curve in curves_of(action) if curve.data_path in paths and curve.array_index < 2]
