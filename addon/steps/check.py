"""bpy.ops.tricap.check(), bpy.ops.tricap.mend_offsets()"""

from collections.abc import Callable
from pathlib import Path

import bpy

from ...core.checking.findings import Checked
from ...core.foundation.progress import Monitor
from ...core.run.check import check_take
from .. import project
from ..jobs import JobOperator
from ..session import get_session
from . import watch
from .footage import SimpleOperator

GOOD = "No problems found."


class Check(JobOperator, bpy.types.Operator):
    """Check whether the footage is synchronized, the cameras fit it, views are swapped, and the clothes have enough texture"""

    bl_idname = "tricap.check"
    bl_label = "Check Footage, Cameras and Sync"
    step = "cameras"
    if_stopped = "Nothing was changed."

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], Checked]:
        """The project with the scene's current values."""
        folder: Path = project.chosen(context.scene, "", "")[0]
        return lambda monitor: check_take(folder, monitor)

    def finish(self, context: bpy.types.Context, result: Checked) -> set[str]:
        """Store the findings for the panel."""
        props = context.scene.tricap
        props.check_said = "\n".join(str(finding) for finding in result.findings) or GOOD
        props.check_passed = not result.findings
        props.check_key = watch.refresh(context.scene).keys.get("measure", "")
        offsets = result.figures.get("offsets", {})
        late = {view: round(o["late_frames"]) for view, o in offsets.items() if o["late_frames"] is not None}  # type: ignore
        get_session().file.late_frames[props.check_key] = late
        for line in props.check_said.splitlines():
            self.report({"INFO" if props.check_passed else "WARNING"}, line)
        return {"FINISHED"}


class SetOffsets(SimpleOperator, bpy.types.Operator):
    """Set the offsets of the views to those that the check found, in whole frames"""

    bl_idname = "tricap.mend_offsets"
    bl_label = "Set Offsets"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only after a check in this session that found offsets."""
        return any(get_session().file.late_frames.get(context.scene.tricap.check_key, {}).values())

    def do(self, context: bpy.types.Context) -> str:
        """Set them."""
        late = get_session().file.late_frames[context.scene.tricap.check_key]
        for view in context.scene.tricap.views:
            view.offset_frames -= late.get(view.name, 0)
        return "Offsets: " + ", ".join(f"{view.name} {view.offset_frames}" for view in context.scene.tricap.views)


CLASSES = (Check, SetOffsets)
