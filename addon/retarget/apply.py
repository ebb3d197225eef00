"""Puts a motion onto an armature of the open file: read the rig, map, transfer, write the action, and check what Blender plays."""

from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.geometry.rotation import angle_of, transposed
from ...core.motion.retarget.contacts import FeetSettings
from ...core.motion.retarget.mapping import MappedMotion, MappedRig, RigMap, apply_preset, find_map, read_preset
from ...core.motion.retarget.measure import Figures, measure
from ...core.motion.retarget.retarget import Retargeted, RetargetSettings, retarget
from ...core.motion.retarget.rig import Motion, Rig, controls_of
from ...core.motion.retarget.transfer import lowest_m, stood_up
from ..scene.frame_rate import set_rate
from . import saved_maps
from .programs import presets
from .read import read_motion, read_rig, with_soles
from .write import Written, store_residual_motion, write_action

FLOOR_AT_ORIGIN = 0.1  # fraction of a rig's height, by which its feet may miss the floor at its origin
CHECKED_FRAMES = 9  # of the action, spread evenly
TOLERANCE_DEG = 0.5  # between the pose that was keyed and the one that Blender plays


@dataclass(frozen=True, kw_only=True)
class Target:
    """An armature as plain values, with its mapping."""

    rig: Rig
    rig_map: RigMap
    floor_m: float  # height of the floor under the rig as it stands

    @property
    def mapped(self) -> MappedRig:
        """The rig with its mapping."""
        return MappedRig(rig=self.rig, map=self.rig_map)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The outcome of a retargeting, in figures and sentences."""

    result: Retargeted
    written: Written
    figures: Figures
    notes: tuple[str, ...]


def map_of(rig: Rig, map_file: Path | None = None, *, controls: bool = False, called: str = "this rig") -> RigMap:
    """The mapping from a file, or as found. Of a control rig: with `controls` its controls, else its deform bones. `called`: in errors.

    Raises:
        InputError: the file is not a mapping of this rig, or no part was recognised.
    """
    if map_file is not None:
        return apply_preset(rig, read_preset(map_file))
    return find_map(rig, presets(controls=controls), called=called)


def read_target(armature_object: bpy.types.Object, map_file: Path | None = None, edited: RigMap | None = None) -> Target:
    """Read an armature for retargeting, with the mapping edited in the panel, from a file, or recognised. Main thread.

    Raises:
        InputError: the armature cannot be mapped, or the mapping names bones that it does not have.
    """
    if armature_object.library is not None:
        raise InputError(
            f"“{armature_object.name}” is linked from {Path(armature_object.library.filepath).name} and cannot be animated here; "
            "make a library override of it (Object > Library Override > Make)."
        )
    rig = read_rig(armature_object)
    known = saved_maps.found_again(rig) if map_file is None and edited is None else None
    rig_map = known or map_of(rig, map_file, controls=True, called=f"the armature “{armature_object.name}”")
    if edited is not None:
        rig_map = _edited(rig, rig_map, edited)
    if rig_map.control_rig is not None:
        rig = controls_of(rig, rig_map.control_rig, rig_map.bones)
    rig = with_soles(rig, armature_object, rig_map)
    return Target(rig=rig, rig_map=rig_map, floor_m=_floor_m(rig, rig_map, float(armature_object.matrix_world.translation.z)))


def _floor_m(rig: Rig, rig_map: RigMap, origin_m: float) -> float:
    """The height of the floor under a rig as it stands, whose origin is at this height: that of the origin, if the feet are there, or else
    that of the feet. A rig that has the scene's origin within its body was not put on its feet: it is to stand on the scene's floor."""
    if stood_up(rig, rig_map) is not rig:
        return 0.0
    low, near = lowest_m(rig), FLOOR_AT_ORIGIN * rig.height_m
    within = abs(origin_m) < near and low < origin_m < low + rig.height_m
    return origin_m if within or abs(low - origin_m) < near else low


def _edited(rig: Rig, found: RigMap, edited: RigMap) -> RigMap:
    """The edited mapping; of a control rig it remains one of controls if it has no other bones."""
    names = [name for chain in (*edited.bones.values(), *edited.twist.values()) for name in chain]
    unknown = [name for name in names if name not in rig.index]
    if unknown:
        raise InputError(f"The target has no bone “{unknown[0]}”; choose another one in the mapping.")
    control_rig = edited.control_rig or found.control_rig
    return replace(edited, control_rig=control_rig and control_rig.of_controls(edited.bones, edited.twist))


def transfer(source: MappedMotion, target: Target, settings: RetargetSettings, feet: FeetSettings, monitor: Monitor) -> Retargeted:
    """The computation alone, for any thread."""
    return retarget(source, target.mapped, settings, feet, monitor, target.floor_m)


def apply(
    armature_object: bpy.types.Object,
    source: MappedMotion,
    target: Target,
    result: Retargeted,
    name: str,
    tolerance_deg: float = 0.0,
) -> Outcome:
    """Write the action and check some frames of it. Main thread."""
    controls = target.rig_map.control_rig
    written = write_action(armature_object, result, name, tolerance_deg=tolerance_deg, properties=controls.properties if controls else {})
    for action in filter(None, [written.action, written.raw]):
        if result.motion.residual is not None:
            store_residual_motion(action, result.motion.residual)
    figures = measure(source, MappedMotion(motion=result.travelling, map=target.rig_map), result.contacts, target.floor_m)
    notes = [*target.rig_map.missing_notes, *target.rig_map.notes, *result.notes]
    notes += [f"{note} in the source" for note in source.map.missing_notes]
    if written.muted:
        notes.append(f"{len(written.muted)} constraints on driven bones were muted: {', '.join(written.muted[:3])} …")
    armature_object.animation_data.action = written.raw or written.action
    notes += check_played(armature_object, result)
    armature_object.animation_data.action = written.action
    return Outcome(result=result, written=written, figures=figures, notes=tuple(dict.fromkeys(notes)))


def check_played(armature_object: bpy.types.Object, result: Retargeted) -> list[str]:
    """A note if Blender does not play what was keyed, because something else drives the bones, too."""
    wanted = result.motion
    some = np.unique(np.linspace(0, len(wanted.frames) - 1, CHECKED_FRAMES).round().astype(int))
    whole = [i for i in some if float(wanted.frames[i]).is_integer()]
    if not whole:
        return []
    played = read_motion(armature_object, wanted.rig, [int(wanted.frames[i]) for i in whole])
    turned = np.degrees(angle_of(transposed(played.R) @ wanted.R[whole]))[:, result.driven].max(axis=0)
    moved = np.linalg.norm(played.head_m - wanted.head_m[whole], axis=2)[:, result.driven].max(axis=0)
    names = [wanted.rig.names[b] for b in np.flatnonzero(result.driven)]
    if turned.max() > TOLERANCE_DEG:
        worst = names[int(turned.argmax())]
        return [f"something else drives the rig, too: “{worst}” is up to {turned.max():.0f}° off its keys"]
    if moved.max() > np.radians(TOLERANCE_DEG) * wanted.rig.height_m:
        worst = names[int(moved.argmax())]
        return [f"something else drives the rig, too: “{worst}” is up to {1e3 * moved.max():.0f} mm off its keys"]
    return []


def set_range(scene: bpy.types.Scene, motion: Motion) -> None:
    """Give the scene the motion's frames and frame rate."""
    set_rate(scene, motion.fps)
    scene.frame_start, scene.frame_end = int(np.floor(motion.frames[0])), int(np.ceil(motion.frames[-1]))


def check_distinct(source: bpy.types.Object, target: bpy.types.Object) -> None:
    """Refuse to retarget a rig onto itself.

    Raises:
        InputError: source and target are the same.
    """
    if source == target:
        raise InputError(f"“{source.name}” is both source and target; choose two different armatures.")
