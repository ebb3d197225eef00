"""A motion onto an armature of the open file: read the rig, map, transfer, write the action, and see that Blender plays what was meant."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.geometry.rotation import angle_of, transposed
from ...core.motion.retarget.contacts import FeetSettings
from ...core.motion.retarget.control_rig import controls_of
from ...core.motion.retarget.mapping import MappedMotion, MappedRig, RigMap, apply_preset, find_map, read_preset
from ...core.motion.retarget.measure import Figures, measure
from ...core.motion.retarget.retarget import Retargeted, RetargetSettings, retarget
from ...core.motion.retarget.rig import Motion, Rig
from .programs import presets
from .read import read_motion, read_rig, with_soles
from .write import Written, store_residual_motion, write_action

LOW = 0.1  # a rig whose feet are farther than this part of its height from its origin has its floor under its feet instead
SAMPLES = 9
BENT_DEG = 0.5


@dataclass(frozen=True, kw_only=True)
class Target:
    """An armature as plain values, with its mapping."""

    rig: Rig
    rig_map: RigMap
    floor_m: float

    @property
    def mapped(self) -> MappedRig:
        """The rig with its mapping."""
        return MappedRig(rig=self.rig, map=self.rig_map)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a retargeting made, in figures and sentences."""

    result: Retargeted
    written: Written
    figures: Figures
    notes: tuple[str, ...]


def map_of(rig: Rig, map_file: Path | None = None, *, controls: bool = False) -> RigMap:
    """The mapping from a file, or as found. Of a control rig: with `controls` its controls, else its deform bones.

    Raises:
        InputError: the file is no mapping of this rig, or nothing was recognised.
    """
    if map_file is not None:
        return apply_preset(rig, read_preset(map_file))
    return find_map(rig, presets(controls=controls))


def read_target(armature_object: bpy.types.Object, map_file: Path | None = None, edited: RigMap | None = None) -> Target:
    """Read an armature for retargeting, with a mapping that is found, in a file, or edited in the panel. Main thread.

    Raises:
        InputError: it is no armature that can be mapped, or the mapping names bones that are not there.
    """
    rig = read_rig(armature_object)
    rig_map = map_of(rig, map_file, controls=True)
    if edited is not None:
        rig_map = _edited(rig, rig_map, edited)
    if rig_map.control_rig is not None:
        rig = controls_of(rig, rig_map.control_rig, rig_map.bones)
    rig = with_soles(rig, armature_object, rig_map)
    low = min([float(points[:, 2].min()) for points in rig.sole_m.values()] or [float(rig.head_m[:, 2].min())])
    origin = float(armature_object.matrix_world.translation.z)
    return Target(rig=rig, rig_map=rig_map, floor_m=origin if abs(low - origin) < LOW * rig.height_m else low)


def _edited(rig: Rig, found: RigMap, edited: RigMap) -> RigMap:
    """The edited mapping; of a control rig it remains one of controls if it has no other bones."""
    names = [name for chain in (*edited.bones.values(), *edited.twist.values()) for name in chain]
    unknown = [name for name in names if name not in rig.index]
    if unknown:
        raise InputError(f"The target has no bone “{unknown[0]}”; choose another in the mapping.")
    control_rig = edited.control_rig or found.control_rig
    return replace(edited, control_rig=control_rig and control_rig.of_controls(edited.bones, edited.twist))


def transfer(source: MappedMotion, target: Target, settings: RetargetSettings, feet: FeetSettings, monitor: Monitor) -> Retargeted:
    """The computation alone; any thread."""
    return retarget(source, target.mapped, settings, feet, monitor, target.floor_m)


def apply(
    armature_object: bpy.types.Object,
    source: MappedMotion,
    target: Target,
    result: Retargeted,
    name: str,
    tolerance_deg: float = 0.0,
) -> Outcome:
    """Write the action and play some frames of it. Main thread."""
    controls = target.rig_map.control_rig
    written = write_action(armature_object, result, name, tolerance_deg=tolerance_deg, properties=controls.properties if controls else {})
    for action in filter(None, [written.action, written.raw]):
        if result.motion.residual is not None:
            store_residual_motion(action, result.motion.residual)
    figures = measure(source, MappedMotion(motion=result.travelling, map=target.rig_map), result.contacts, target.floor_m)
    notes = [*target.rig_map.missing, *target.rig_map.notes, *result.notes, *source.map.missing]
    if written.muted:
        notes.append(f"{len(written.muted)} constraints on driven bones were muted: {', '.join(written.muted[:3])} …")
    armature_object.animation_data.action = written.raw or written.action
    notes += check_played(armature_object, result)
    armature_object.animation_data.action = written.action
    return Outcome(result=result, written=written, figures=figures, notes=folded(notes))


def folded(notes: Sequence[str]) -> tuple[str, ...]:
    """The notes once each; what is said of several things ("hips: …", "shin.L: …") in one sentence."""
    things: dict[str, list[str]] = {}
    for note in dict.fromkeys(notes):
        thing, colon, said = note.partition(": ")
        things.setdefault(said if colon else note, []).append(thing if colon else "")
    return tuple(f"{', '.join(of)}: {said}" if any(of) else said for said, of in things.items())


def check_played(armature_object: bpy.types.Object, result: Retargeted) -> list[str]:
    """A sentence if Blender plays something else than what was keyed, because something else steers the bones."""
    wanted = result.motion
    some = np.unique(np.linspace(0, len(wanted.frames) - 1, SAMPLES).round().astype(int))
    whole = [i for i in some if float(wanted.frames[i]).is_integer()]
    if not whole:
        return []
    played = read_motion(armature_object, wanted.rig, [int(wanted.frames[i]) for i in whole])
    turned = np.degrees(angle_of(transposed(played.R) @ wanted.R[whole]))[:, result.driven].max(axis=0)
    moved = np.linalg.norm(played.head_m - wanted.head_m[whole], axis=2)[:, result.driven].max(axis=0)
    names = [wanted.rig.names[b] for b in np.flatnonzero(result.driven)]
    if turned.max() > BENT_DEG:
        worst = names[int(turned.argmax())]
        return [f"something else steers the rig, too: “{worst}” plays up to {turned.max():.0f}° off what was keyed"]
    if moved.max() > np.radians(BENT_DEG) * wanted.rig.height_m:
        worst = names[int(moved.argmax())]
        return [f"something else steers the rig, too: “{worst}” plays up to {1e3 * moved.max():.0f} mm off what was keyed"]
    return []


def set_range(scene: bpy.types.Scene, motion: Motion) -> None:
    """The scene's frames are the motion's, at its rate."""
    whole = max(1, int(np.ceil(motion.fps - 1e-3)))
    scene.render.fps, scene.render.fps_base = whole, whole / motion.fps
    scene.frame_start, scene.frame_end = int(np.floor(motion.frames[0])), int(np.ceil(motion.frames[-1]))


def names_of(armatures: Sequence[bpy.types.Object]) -> str:
    """For sentences."""
    return ", ".join(o.name for o in armatures) or "none"


def check_distinct(source: bpy.types.Object, target: bpy.types.Object) -> None:
    """See that a rig is not retargeted onto itself.

    Raises:
        InputError: it is.
    """
    if source == target:
        raise InputError(f"“{source.name}” is source and target at once; choose two armatures.")
