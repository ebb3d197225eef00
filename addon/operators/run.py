"""bpy.ops.tricap.run(take="…", out="…", build=True)"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ...core import pipeline
from ...core.progress import Monitor
from .. import folders, properties
from ..jobs import JobOperator
from ..scene.contents import Contents, read_contents
from .build_scene import RELATIVE, put_into_scene


class Run(JobOperator, bpy.types.Operator):
    """Measure the take from the first image to the body's motion; a run that was stopped goes on where it was"""

    bl_idname = "tricap.run"
    bl_label = "Run"
    bl_options = {"UNDO"}

    take: bpy.props.StringProperty(name="Take", subtype="DIR_PATH", options=RELATIVE,  # type: ignore[valid-type]
                                   description="Folder with take.toml; empty: the panel's")
    out: bpy.props.StringProperty(name="Output", subtype="DIR_PATH", options=RELATIVE,  # type: ignore[valid-type]
                                  description="Folder for the results; empty: the panel's")
    build: bpy.props.BoolProperty(name="Build Scene", default=True,  # type: ignore[valid-type]
                                  description="Put the results into this scene afterwards")

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], tuple[Any, Contents | None]]:
        """Folders and settings as they are now."""
        take = folders.take_folder(self.take, context.scene)
        out = folders.output_folder(self.out, context.scene, str(take))
        folders.check_writable(out)
        overrides, build = properties.overrides(context.scene), self.build
        return lambda monitor: measure(take, out, overrides, build, monitor)

    def finish(self, context: bpy.types.Context, result: tuple[Any, Contents | None]) -> set[str]:
        """Tell what was found and build the scene."""
        report, results = result
        context.scene.tricap.last = str(report)
        if results is not None:
            put_into_scene(self, context, results)
        self.report({"INFO"}, str(report))
        return {"FINISHED"}


def measure(take: Path, out: Path, overrides: dict[str, dict[str, Any]], build: bool, monitor: Monitor) -> tuple[Any, Contents | None]:
    """The computation, free of bpy: the whole run, and its results read back for the scene."""
    report = pipeline.run(take, out, overrides, monitor)
    return report, read_contents(out, monitor) if build else None
