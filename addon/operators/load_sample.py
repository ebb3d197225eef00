"""bpy.ops.tricap.load_sample()"""

from collections.abc import Callable
from pathlib import Path

import bpy

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.run import take_run
from ...core.synthetic.arm import ArmTakeSettings, is_arm_take, make_arm_take
from .. import folders, project
from ..jobs import JobOperator
from ..scene.contents import Contents
from .build_scene import put_into_scene
from .run import measure
from .stages import report_run

NAME = "tricap_sample"
EXTENSION = __package__.rpartition(".addon")[0]
SAMPLE = ArmTakeSettings(frames=12, fps=15.0, width_px=512, interlaced="none")


class LoadSample(JobOperator, bpy.types.Operator):
    """Make a small sample recording of a moving arm on this computer, measure it, and build the scene; about half a minute"""

    bl_idname = "tricap.load_sample"
    bl_label = "Load Sample and Run"
    bl_options = {"UNDO"}

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], tuple[Path, take_run.Run, Contents | None]]:
        """Where the recording and its results go: beside the .blend, or among the extension's own files while there is none."""
        base = Path(bpy.data.filepath).parent if bpy.data.filepath else Path(bpy.utils.extension_path_user(EXTENSION, path="", create=True))
        take = base / NAME
        if project.bound(context.scene) and project.folder_of(context.scene) != take.resolve():
            raise InputError("This file has footage of its own; make an empty one (File > New > General) and press this there.")
        folders.check_writable(base)
        return lambda monitor: make_and_measure(take, monitor)

    def finish(self, context: bpy.types.Context, result: tuple[Path, take_run.Run, Contents | None]) -> set[str]:
        """The sample becomes the scene's project; build the scene."""
        take, run, contents = result
        project.open_take(context.scene, take)
        context.scene.tricap.out = folders.for_user(take / project.RESULTS)
        if contents is not None:
            put_into_scene(self, context, contents)
        report_run(self, context, run)
        return {"FINISHED"}


def make_and_measure(take: Path, monitor: Monitor) -> tuple[Path, take_run.Run, Contents | None]:
    """The computation, free of bpy. A sample that is there already, with whatever was changed in it, is measured as it is."""
    if not is_arm_take(take):
        make_arm_take(take, SAMPLE, monitor)
    return take, *measure(take, take / project.RESULTS, {}, True, monitor)
