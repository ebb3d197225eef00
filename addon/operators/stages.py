"""bpy.ops.tricap.measure(take="…", out="…"), bpy.ops.tricap.track(…), bpy.ops.tricap.fit(…)"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ...core.fitting.inputs.take_inputs import check_body
from ...core.foundation.progress import Monitor
from ...core.run import pipeline, take_run
from .. import project
from ..jobs import JobOperator
from .build_scene import RELATIVE

STEP_WORDS = {
    "surface": "surface",
    "seeds": "surface",
    "matching": "surface",
    "tracks": "tracks",
    "filters": "tracks",
    **dict.fromkeys(("thin", "background", "fit", "adjust", "refine", "sigmas", "skin", "silhouettes", "report"), "body"),
    **dict.fromkeys(("reading", "preparing"), "rig"),
}  # the first word of what a stage says of itself -> its step


class StageOperator(JobOperator):
    """Mix-in: one stage of the run, and those before it as far as they are not done."""

    stages: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def step_at(cls, stage: str) -> str:
        """Measuring comes first wherever it is not done."""
        return STEP_WORDS.get(stage.split()[0] if stage else "", cls.step)

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], take_run.Run]:
        """Folders and settings as they are now; the project's take.toml is written."""
        take, out, overrides = project.chosen(context.scene, self.take, self.out)  # type: ignore[attr-defined]
        return lambda monitor: run_stages(take, out, overrides, self.stages, monitor)

    def finish(self, context: bpy.types.Context, result: take_run.Run) -> set[str]:
        """Report the run."""
        report_run(self, context, result)
        return {"FINISHED"}


def report_run(operator: Any, context: bpy.types.Context, run: take_run.Run) -> None:
    """Show a run's warnings and its summary, and keep the summary for the panel."""
    context.scene.tricap.last = str(run)
    for sentence in run.record["warnings"]:
        operator.report({"WARNING"}, sentence)
    operator.report({"INFO"}, str(run))


def run_stages(take: Path, out: Path, overrides: Mapping[str, Mapping[str, Any]], names: tuple[str, ...], monitor: Monitor) -> take_run.Run:
    """The computation, free of bpy. What is checkpointed is not computed again."""
    with take_run.open_run(take, out, overrides) as run:
        if "fit" in names:
            check_body(run.footage, run.settings["fitting"])
        for name in names:
            getattr(pipeline, name)(run, monitor)
    return run


class Measure(StageOperator, bpy.types.Operator):
    """Measure the surface of the body in every frame; what was measured before with the same input is kept"""

    bl_idname = "tricap.measure"
    bl_label = "Measure Surface"
    bl_options = {"UNDO"}
    step, stages = "surface", ("measure",)

    take: bpy.props.StringProperty(
        name="Take",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with take.toml; empty: this file's project",
    )
    out: bpy.props.StringProperty(
        name="Output",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder for the results; empty: the project's",
    )


class Track(StageOperator, bpy.types.Operator):
    """Follow the surface's points from frame to frame; the surface is measured first where that is needed"""

    bl_idname = "tricap.track"
    bl_label = "Follow Points"
    bl_options = {"UNDO"}
    step, stages = "tracks", ("measure", "track")

    take: bpy.props.StringProperty(
        name="Take",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with take.toml; empty: this file's project",
    )
    out: bpy.props.StringProperty(
        name="Output",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder for the results; empty: the project's",
    )


class Fit(StageOperator, bpy.types.Operator):
    """Fit the body to surface and tracks, and write the report; both are made first where that is needed"""

    bl_idname = "tricap.fit"
    bl_label = "Fit Body"
    bl_options = {"UNDO"}
    step, stages = "body", ("measure", "track", "fit", "report")

    take: bpy.props.StringProperty(
        name="Take",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with take.toml; empty: this file's project",
    )
    out: bpy.props.StringProperty(
        name="Output",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder for the results; empty: the project's",
    )
