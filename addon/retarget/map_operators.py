"""The mapping's editor: bpy.ops.tricap.retarget_find_map(), .retarget_load_map(filepath="…"), .retarget_save_map(filepath="…"),
.retarget_add_line(), .retarget_remove_line(), .retarget_align_pose()"""

from dataclasses import replace
from pathlib import Path

import bpy

from ...core.foundation.errors import InputError
from ...core.motion.retarget.mapping import MappedMotion, write_map
from ...core.motion.retarget.rest_pose import with_person_like_rest
from ...core.motion.retarget.roles import ROLES
from ...core.motion.retarget.transfer import offsets_of_pose
from .. import folders
from ..panels import TellingOperator
from . import apply, properties, saved_maps
from .operators import armature_of
from .read import action_frames, read_motion, read_pose, read_rig


def show_map(operator: bpy.types.Operator, context: bpy.types.Context, file: Path | None) -> str:
    """Fill the editor with the target's mapping: from a file, recognised, or, while it is empty, that of the last time.

    Raises:
        InputError: there is no target, or the file is no mapping for it.
    """
    props = context.scene.tricap_retarget
    target = props.target = armature_of("", properties.target_of(context.scene), "target")
    rig, begins = read_rig(target), not props.rows or props.rows_of != target
    known = saved_maps.found_again(rig) if file is None and begins else None
    rig_map = known or apply.map_of(rig, file, controls=True)
    source = apply.map_of(read_rig(props.source)) if props.source is not None else None
    properties.fill_rows(props, rig_map, target, source)
    for line in (*rig_map.missing_notes, *rig_map.notes):
        operator.report({"INFO"}, line)
    return ""


class FindMap(TellingOperator, bpy.types.Operator):
    """Recognise the target's bones by their names and the shape of the rig, and show the mapping for editing"""

    bl_idname = "tricap.retarget_find_map"
    bl_label = "Recognise"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Fill the editor."""
        return show_map(self, context, None)


class LoadMap(TellingOperator, bpy.types.Operator):
    """Load the target's mapping from a file, and show it for editing"""

    bl_idname = "tricap.retarget_load_map"
    bl_label = "Load Mapping"
    bl_options = {"UNDO"}

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(default="*.json", options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Open the file browser."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: bpy.types.Context) -> str:
        """Fill the editor."""
        return show_map(self, context, folders.absolute(self.filepath))


class SaveMap(TellingOperator, bpy.types.Operator):
    """Save the mapping to a file, to edit, share or reuse it"""

    bl_idname = "tricap.retarget_save_map"
    bl_label = "Save Mapping"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Open the file browser."""
        self.filepath = self.filepath or "mapping.json"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: bpy.types.Context) -> str:
        """Write it."""
        props = context.scene.tricap_retarget
        rig_map = properties.edited_map(props, props.rows_of)
        if rig_map is None:
            raise InputError("There is no mapping to save; press Recognise first.")
        file = folders.to_write(self.filepath)
        write_map(file, rig_map, file.stem)
        return ""


class AddLine(bpy.types.Operator):
    """Add a line to the mapping, for the next part of the body without one"""

    bl_idname = "tricap.retarget_add_line"
    bl_label = "Add Line"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with a target."""
        return context.scene.tricap_retarget.target is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add a line and select it."""
        props = context.scene.tricap_retarget
        if props.rows_of != props.target:
            props.rows.clear()
            props.missing = props.steering = ""
            props.rows_of = props.target
        taken = {row.role for row in props.rows}
        props.rows.add().role = next((role for role in ROLES if role not in taken), ROLES[0])
        props.row = len(props.rows) - 1
        return {"FINISHED"}


class RemoveLine(bpy.types.Operator):
    """Remove the selected line from the mapping: the part then follows its parent"""

    bl_idname = "tricap.retarget_remove_line"
    bl_label = "Remove Line"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with a selected line."""
        props = context.scene.tricap_retarget
        return 0 <= props.row < len(props.rows)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove the line and select the one before."""
        props = context.scene.tricap_retarget
        props.rows.remove(props.row)
        props.row = max(0, min(props.row, len(props.rows) - 1))
        return {"FINISHED"}


class AlignPose(TellingOperator, bpy.types.Operator):
    """Pose the target by hand like the source in this frame, then press: the differences become rotation offsets of the mapping"""

    bl_idname = "tricap.retarget_align_pose"
    bl_label = "Align to Pose"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with an armature as the source, and a target."""
        props = context.scene.tricap_retarget
        return props.source is not None and props.target is not None

    def do(self, context: bpy.types.Context) -> str:
        """Fill in the offsets."""
        props, frame = context.scene.tricap_retarget, context.scene.frame_current
        source, target = armature_of("", props.source, "source"), armature_of("", props.target, "target")
        apply.check_distinct(source, target)
        mapped = apply.read_target(target, edited=properties.edited_map(props, target))
        posed = MappedMotion(motion=read_pose(target, mapped.rig, frame), map=mapped.rig_map)
        rig = read_rig(source)
        frames = sorted({frame, *action_frames(source)})
        moving, _ = with_person_like_rest(MappedMotion(motion=read_motion(source, rig, frames), map=apply.map_of(rig)))
        offsets = offsets_of_pose(moving, frames.index(frame), posed)
        properties.fill_rows(props, replace(mapped.rig_map, offsets_deg=offsets), target, moving.map)
        return f"{len(offsets)} parts of {target.name} have a rotation offset now."


CLASSES = (FindMap, LoadMap, SaveMap, AddLine, RemoveLine, AlignPose)
