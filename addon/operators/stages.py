"""bpy.ops.tricap.measure(take="…", out="…"), bpy.ops.tricap.track(…), bpy.ops.tricap.fit(…)"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import bpy

from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.results.run_json import notes_of
from .. import project
from ..jobs import JobOperator
from .build_scene import RELATIVE, show_so_far

if TYPE_CHECKING:
    from ...core.run.take_run import Run
    from ..scene.contents import Contents

TRACKS = "trajectories.npz"  # in a folder of results that has surface and tracks
STEP_OF_TASK = MappingProxyType({"measure": "surface", "track": "tracks", "fit": "body", "report": "body", "build": "rig"})


class StageOperator(JobOperator):
    """Mix-in: one stage of the run, and earlier ones that are not done."""

    stages: ClassVar[tuple[str, ...]] = ()
    steps = STEP_OF_TASK
    so_far: Any = ()  # Contents: what was measured before a fit that failed

    def snapshot(self, context: bpy.types.Context) -> "Callable[[Monitor], tuple[Run, Contents | None]]":
        """Folders and settings as they are now; writes the project's take.toml."""
        take, out, overrides = project.chosen(context.scene, self.take, self.out)  # type: ignore[attr-defined]
        stages, shown = self.stages, project.bound(context.scene) and not self.out  # type: ignore[attr-defined]
        self.so_far = so_far = []

        def compute(monitor: Monitor) -> "tuple[Run, Contents | None]":
            with read_if_it_fails(out, so_far if shown else [], monitor):
                return run_and_read(take, out, overrides, stages, shown, monitor)

        return compute

    def after_error(self, context: bpy.types.Context) -> None:
        """Show what was measured all the same."""
        for contents in self.so_far:
            show_so_far(self, context, contents)

    def finish(self, context: bpy.types.Context, result: "tuple[Run, Contents | None]") -> set[str]:
        """Show what was measured in the viewport, and report the run."""
        run, contents = result
        if contents is not None:
            show_so_far(self, context, contents)
        report_run(self, context, run)
        return {"FINISHED"}


@contextmanager
def read_if_it_fails(out: Path, so_far: "list[Contents]", monitor: Monitor) -> Iterator[None]:
    """Where the body cannot be fitted, add the surface and the tracks in OUT to `so_far`; the error goes on."""
    try:
        yield
    except InputError:
        from ..scene.contents import read_contents

        if (out / TRACKS).is_file():
            with suppress(InputError):
                so_far.append(read_contents(out, monitor))
        raise


def run_and_read(
    take: Path, out: Path, overrides: Mapping[str, Mapping[str, Any]], names: tuple[str, ...], shown: bool, monitor: Monitor
) -> "tuple[Run, Contents | None]":
    """The computation, without bpy: the stages, and if they are `shown`, what they measured."""
    from ..scene.contents import read_contents

    run = run_stages(take, out, overrides, names, monitor)
    return run, read_contents(out, monitor) if shown and "fit" not in names else None


def report_run(operator: Any, context: bpy.types.Context, run: "Run") -> None:
    """Show a run's warnings and its summary, and store the summary for the panel."""
    context.scene.tricap.last = str(run)
    for sentence in notes_of(run.record):
        operator.report({"INFO"}, sentence)
    for sentence in [*run.notes, *run.record["warnings"]]:
        operator.report({"WARNING"}, sentence)
    operator.report({"INFO"}, str(run))


def run_stages(take: Path, out: Path, overrides: Mapping[str, Mapping[str, Any]], names: tuple[str, ...], monitor: Monitor) -> "Run":
    """The computation, without bpy. Frames that have a checkpoint are not computed again."""
    from ...core.run.engine import of_this_machine
    from ...core.run.pipeline import do_stages
    from ...core.run.take_run import open_run

    with open_run(take, out, overrides) as run:
        run.engine = of_this_machine()
        do_stages(run, names, monitor)
    return run


class Measure(StageOperator, bpy.types.Operator):
    """Measure the surface of the person in every frame. Frames that were measured with the same inputs are reused"""

    bl_idname = "tricap.measure"
    bl_label = "Measure Surface"
    bl_options = {"UNDO"}
    step, stages = "surface", ("measure",)

    take: bpy.props.StringProperty(
        name="Take",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with take.toml. Empty: the project of this file",
    )
    out: bpy.props.StringProperty(
        name="Output",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder for the results. Empty: the project's",
    )


class Track(StageOperator, bpy.types.Operator):
    """Track points of the surface from frame to frame. The surface is measured first if needed"""

    bl_idname = "tricap.track"
    bl_label = "Track Points"
    bl_options = {"UNDO"}
    step, stages = "tracks", ("measure", "track")

    take: bpy.props.StringProperty(
        name="Take",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with take.toml. Empty: the project of this file",
    )
    out: bpy.props.StringProperty(
        name="Output",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder for the results. Empty: the project's",
    )


class Fit(StageOperator, bpy.types.Operator):
    """Fit the body to surface and tracks, and write the report. Surface and tracks are computed first if needed"""

    bl_idname = "tricap.fit"
    bl_label = "Fit Body"
    bl_options = {"UNDO"}
    step, stages = "body", ("measure", "track", "fit", "report")

    take: bpy.props.StringProperty(
        name="Take",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with take.toml. Empty: the project of this file",
    )
    out: bpy.props.StringProperty(
        name="Output",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder for the results. Empty: the project's",
    )
