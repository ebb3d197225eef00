"""bpy.ops.tricap.find_joints_with_network(filepath="…/pose.onnx"): the joints in every image, by a pose network of the user's own."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.take.footage import open_take
from ...core.take.take import read_take
from .. import folders, project
from ..jobs import JobOperator

if TYPE_CHECKING:
    from ...core.run.network_joints import NetworkJoints


class FindJointsWithNetwork(JobOperator, bpy.types.Operator):
    """Find the joints in every image with a pose network of your own (RTMPose, ViTPose, HRNet or MediaPipe as .onnx). Clicks go first"""

    bl_idname = "tricap.find_joints_with_network"
    bl_label = "Find Joints with a Network"
    step = "clicks"
    if_stopped = "Nothing was changed."

    filepath: bpy.props.StringProperty(name="Network", subtype="FILE_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    chosen = False  # in the file browser: the window must not wait
    filter_glob: bpy.props.StringProperty(default="*.onnx", options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the file."""
        if self.filepath:
            return super().invoke(context, event)
        self.chosen = True
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Compute here and now, or after the file browser on a thread."""
        return super().invoke(context, None) if self.chosen else super().execute(context)

    def snapshot(self, context: bpy.types.Context) -> "Callable[[Monitor], NetworkJoints]":
        """The project with the scene's current values, and the network's file."""
        from ...core.run.network_joints import joints_by_file

        if not self.filepath:
            raise InputError("Choose the network's .onnx file.")
        if not project.bound(context.scene):
            raise InputError("Add the footage first; then the joints can be found in it.")
        network: Path = folders.absolute(self.filepath)
        folder: Path = project.chosen(context.scene, "", "")[0]
        return lambda monitor: joints_by_file(open_take(read_take(folder)), network, monitor)

    def finish(self, context: bpy.types.Context, result: "NetworkJoints") -> set[str]:
        """Write them into the project as [[keypoints]]."""
        from ...core.run.network_joints import write_network_joints

        folder = project.write(context.scene)
        write_network_joints(folder, result)
        project.remember(context.scene, folder)
        images = result.numbers.shape[1]
        found = ", ".join(f"{view} {count / images:.0f}" for view, count in zip(result.views, result.found))
        self.report({"INFO"}, f"Points found in an image: {found} of {len(result.names)}. The fit uses them where there are no clicks.")
        return {"FINISHED"}


CLASSES = (FindJointsWithNetwork,)
