"""The mapping's editor: bpy.ops.tricap.retarget_find_map(), .retarget_load_map(filepath="…"), .retarget_save_map(filepath="…"),
.retarget_add_line(), .retarget_remove_line()"""

from pathlib import Path

import bpy

from ...core.foundation.errors import InputError
from ...core.motion.retarget.mapping import write_map
from ...core.motion.retarget.roles import ROLES
from ..panels import TellingOperator
from . import apply, properties
from .operators import armature_of
from .read import read_rig


def show_map(operator: bpy.types.Operator, context: bpy.types.Context, file: Path | None) -> str:
    """Fill the editor with the target's mapping, recognised or from a file.

    Raises:
        InputError: there is no target, or the file is no mapping for it.
    """
    props = context.scene.tricap_retarget
    target = armature_of("", props.target, "target")
    rig_map = apply.map_of(read_rig(target), file, controls=True)
    properties.fill_rows(props, rig_map, target)
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
        return show_map(self, context, Path(bpy.path.abspath(self.filepath)))


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
        write_map(Path(bpy.path.abspath(self.filepath)), rig_map, Path(self.filepath).stem)
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


CLASSES = (FindMap, LoadMap, SaveMap, AddLine, RemoveLine)
