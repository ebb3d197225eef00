"""bpy.ops.tricap.build_scene(out="…", blend="…")"""

from collections.abc import Callable
from pathlib import Path

import bpy

from ...core.progress import Monitor
from .. import folders
from ..jobs import JobOperator
from ..scene.build import SceneReport, write_scene
from ..scene.contents import Contents, read_contents

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


class BuildScene(JobOperator, bpy.types.Operator):
    """Put the results of a run into this scene: cameras with footage, cloud, trajectories, armature, action and skin"""

    bl_idname = "tricap.build_scene"
    bl_label = "Build Scene"
    bl_options = {"UNDO"}

    out: bpy.props.StringProperty(name="Contents", subtype="DIR_PATH", options=RELATIVE,  # type: ignore[valid-type]
                                  description="Folder of a run; empty: the panel's output folder")
    blend: bpy.props.StringProperty(name="Save As", subtype="FILE_PATH", options=RELATIVE,  # type: ignore[valid-type]
                                    description="Also save a copy of the file under this name; empty: do not save")

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], Contents]:
        """Which folder is meant."""
        out = folders.output_folder(self.out, context.scene)
        return lambda monitor: read_contents(out, monitor)

    def finish(self, context: bpy.types.Context, result: Contents) -> set[str]:
        """Build the scene from what was read."""
        report = write_scene(result, Path(bpy.path.abspath(self.blend)) if self.blend else None)
        tell(self, report)
        return {"FINISHED"}


def tell(operator: bpy.types.Operator, report: SceneReport) -> None:
    """Show what was built, and what is missing."""
    for warning in report.warnings:
        operator.report({"WARNING"}, warning)
    operator.report({"INFO"}, f"The scene has {report}.")
