"""bpy.ops.tricap.retarget(), .retarget_preview(), .retarget_end_preview()"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.motion.retarget.contacts import FeetSettings
from ...core.motion.retarget.mapping import MappedMotion, MappedRig
from ...core.motion.retarget.retarget import Retargeted, RetargetSettings, begun_at_rest
from ...core.motion.retarget.rig import Motion, resampled
from ...core.motion.sources import read_motion_source
from .. import folders
from ..jobs import JobOperator
from ..panels import TellingOperator
from ..properties import snapshot
from . import apply, preview, properties, saved_maps
from .read import action_frames, read_motion, read_rig, with_residual_motion
from .write import push_to_strip

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


@dataclass(frozen=True, kw_only=True)
class Computed:
    """The result of the worker thread."""

    source: MappedMotion
    result: Retargeted


class Retarget(JobOperator, bpy.types.Operator):
    """Put the motion of an armature or a file onto the target, as a new action. The source does not change"""

    bl_idname = "tricap.retarget"
    bl_label = "Retarget"
    bl_options = {"UNDO"}

    source: bpy.props.StringProperty(name="Source", description="Armature with the motion; empty: the one in the panel")  # type: ignore[valid-type]
    file: bpy.props.StringProperty(
        name="Motion",
        subtype="FILE_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="A motion file instead of an armature: a folder with results, BVH, TRC, C3D or CSV; empty: the one in the panel",
    )
    target: bpy.props.StringProperty(name="Target", description="Armature that gets the motion; empty: the one in the panel")  # type: ignore[valid-type]
    map: bpy.props.StringProperty(
        name="Mapping",
        subtype="FILE_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Mapping of the target (JSON); empty: the one in the panel, or automatic",
    )

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], Computed]:
        """Read both rigs and, from an armature, its motion."""
        props = context.scene.tricap_retarget
        settings, feet = snapshot(props.settings, RetargetSettings), snapshot(props.feet, FeetSettings)
        self._target = armature_of(self.target, properties.target_of(context.scene), "target")
        moving = None if self.file else armature_of(self.source, props.source, "source", needed=not props.file)
        if moving is not None:
            apply.check_distinct(moving, self._target)
        edited = properties.edited_map(props, self._target) if not self.map else None
        self._edited = edited
        self._unused_mapping = properties.foreign_mapping_note(props, self._target) if not self.map else ""
        self._mapped_target = apply.read_target(self._target, folders.absolute(self.map) if self.map else None, edited)
        target, scene = self._mapped_target, context.scene
        fps, start = scene.render.fps / scene.render.fps_base, scene.frame_start
        if moving is not None:
            self._name = f"{moving.name} on {self._target.name}"
            motion = with_residual_motion(moving, read_motion(moving, read_rig(moving), action_frames(moving)))
            return lambda monitor: compute(lambda: motion, target, settings, feet, monitor)
        path, file_axes = folders.absolute(self.file or props.file), properties.axes_of_file(props)
        self._name = path.stem
        return lambda monitor: compute(
            lambda: resampled(read_motion_source(path, **file_axes), fps, start), target, settings, feet, monitor
        )

    def finish(self, context: bpy.types.Context, result: Computed) -> set[str]:
        """Write the action and report how good it is."""
        props = context.scene.tricap_retarget
        preview.remove_preview(self._target)
        beside = begun_at_rest(result.result, result.source) if props.place == "SIDE" else result.result
        outcome = apply.apply(self._target, result.source, self._mapped_target, beside, self._name, props.tolerance_deg)
        if self._edited is not None:
            saved_maps.keep(read_rig(self._target), self._edited, self._target.name)
        if props.strip:
            push_to_strip(self._target, outcome.written.action)
        notes = [*filter(None, [self._unused_mapping]), *outcome.notes]
        props.last_export, props.export = "", self._target
        props.target = props.target or self._target
        props.last = "\n".join([str(outcome.figures), *notes])
        for note in notes:
            self.report({"INFO"}, note)
        self.report({"INFO"}, f"{self._target.name}: {outcome.figures}")
        return {"FINISHED"}


def compute(read: Callable[[], Motion], target: apply.Target, settings: RetargetSettings, feet: FeetSettings, monitor: Monitor) -> Computed:
    """The computation, without bpy."""
    motion = read()
    source = MappedMotion(motion=motion, map=apply.map_of(motion.rig))
    return Computed(source=source, result=apply.transfer(source, target, settings, feet, monitor))


def armature_of(name: str, chosen: bpy.types.Object | None, which: str, *, needed: bool = True) -> Any:
    """The armature object called `name`, or the chosen one.

    Raises:
        InputError: there is none.
    """
    found = bpy.data.objects.get(name) if name else chosen
    if found is None and (needed or name):
        raise InputError(f"There is no armature “{name}” to be the {which}." if name else f"Choose an armature as the {which}.")
    return found


class Preview(TellingOperator, bpy.types.Operator):
    """Let the target follow the source live, by constraints; only Retarget plants the feet"""

    bl_idname = "tricap.retarget_preview"
    bl_label = "Preview"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Add the constraints."""
        props = context.scene.tricap_retarget
        source, target = armature_of("", props.source, "source"), armature_of("", properties.target_of(context.scene), "target")
        apply.check_distinct(source, target)
        props.target = target
        rig, mapped = read_rig(source), apply.read_target(target, edited=properties.edited_map(props, target))
        count = preview.add_preview(source, MappedRig(rig=rig, map=apply.map_of(rig)), target, mapped.mapped)
        return f"{count} bones of {target.name} follow {source.name}."


class EndPreview(bpy.types.Operator):
    """Remove the constraints of the preview"""

    bl_idname = "tricap.retarget_end_preview"
    bl_label = "End Preview"
    bl_options = {"UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove them."""
        target = context.scene.tricap_retarget.target
        if target is None or not preview.remove_preview(target):
            self.report({"WARNING"}, "There is no preview on the target.")
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (Retarget, Preview, EndPreview)
