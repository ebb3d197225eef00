"""bpy.ops.tricap.run(take="…", out="…", build=True)"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ...core.foundation.progress import Monitor
from ...core.run import pipeline, take_run
from .. import project
from ..scene.contents import Contents, read_contents
from .build_scene import RELATIVE, put_into_scene
from .stages import StageOperator, report_run


class Run(StageOperator, bpy.types.Operator):
    """Do everything that is missing, from the first image to the rig; what is done already is kept, a stopped run goes on where it was"""

    bl_idname = "tricap.run"
    bl_label = "Run"
    bl_options = {"UNDO"}
    step, stages = "surface", ("measure", "track", "fit", "report")

    take: bpy.props.StringProperty(
        name="Take",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with take.toml; empty: the panel's",
    )
    out: bpy.props.StringProperty(
        name="Output",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder for the results; empty: the panel's",
    )
    build: bpy.props.BoolProperty(
        name="Build Scene",
        default=True,  # type: ignore[valid-type]
        description="Put the results into this scene afterwards",
    )

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], tuple[take_run.Run, Contents | None]]:
        """Folders and settings as they are now."""
        take, out, overrides = project.chosen(context.scene, self.take, self.out)
        build = self.build
        return lambda monitor: measure(take, out, overrides, build, monitor)

    def finish(self, context: bpy.types.Context, result: tuple[take_run.Run, Contents | None]) -> set[str]:
        """Build the scene and report the run."""
        run, contents = result
        if contents is not None:
            put_into_scene(self, context, contents)
        report_run(self, context, run)
        return {"FINISHED"}


def measure(
    take: Path, out: Path, overrides: dict[str, dict[str, Any]], build: bool, monitor: Monitor
) -> tuple[take_run.Run, Contents | None]:
    """The computation, free of bpy: all that is not done yet, and its results read back for the scene."""
    with take_run.open_run(take, out, overrides) as run:
        if not pipeline.is_complete(run):
            pipeline.all_stages(run, monitor)
    return run, read_contents(out, monitor) if build else None
