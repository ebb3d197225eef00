"""bpy.ops.tricap.run(take="…", out="…", build=True), bpy.ops.tricap.load_sample(), bpy.ops.tricap.cancel()"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import bpy

from ...core.foundation.bounded import real_path
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from .. import folders, project
from ..jobs import JobOperator
from ..session import get_session
from .build_scene import RELATIVE, frame_in_views, put_into_scene
from .stages import StageOperator, read_if_it_fails, report_run

if TYPE_CHECKING:
    from ...core.run.take_run import Run as TakeRun
    from ..scene.contents import Contents

EXTENSION = __package__.rpartition(".addon")[0]
SAMPLE = Path(__file__).resolve().parent.parent / "sample.zip"


class Run(StageOperator, bpy.types.Operator):
    """Run all steps that are not done yet, from the footage to the rig. A stopped run resumes where it stopped"""

    bl_idname = "tricap.run"
    bl_label = "Run Remaining Steps"
    bl_options = {"UNDO"}
    step, stages = "surface", ("measure", "track", "fit", "report")

    take: bpy.props.StringProperty(
        name="Take",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder with take.toml. Empty: the one in the panel",
    )
    out: bpy.props.StringProperty(
        name="Output",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder for the results. Empty: the one in the panel",
    )
    build: bpy.props.BoolProperty(
        name="Build Scene",
        default=True,  # type: ignore[valid-type]
        description="Build the results in this scene afterwards",
    )

    def snapshot(self, context: bpy.types.Context) -> "Callable[[Monitor], tuple[TakeRun, Contents | None]]":
        """Folders and settings as they are now."""
        take, out, overrides = project.chosen(context.scene, self.take, self.out)
        build, shown = self.build, project.bound(context.scene) and not self.out and not self.take
        self.so_far = so_far = []

        def compute(monitor: Monitor) -> "tuple[TakeRun, Contents | None]":
            with read_if_it_fails(out, so_far if shown else [], monitor):
                return measure(take, out, overrides, build, monitor)

        return compute

    def finish(self, context: bpy.types.Context, result: "tuple[TakeRun, Contents | None]") -> set[str]:
        """Build the scene and report the run."""
        run, contents = result
        if contents is not None:
            put_into_scene(self, context, contents)
        report_run(self, context, run)
        return {"FINISHED"}


def measure(
    take: Path, out: Path, overrides: dict[str, dict[str, Any]], build: bool, monitor: Monitor, *, restart: bool = False
) -> "tuple[TakeRun, Contents | None]":
    """The computation, without bpy: all stages that are not done, or all if `restart`, and their results read for the scene."""
    from ...core.run import pipeline
    from ...core.run.engine import of_this_machine
    from ...core.run.take_run import open_run
    from ..scene.contents import read_contents

    with open_run(take, out, overrides, restart=restart) as run:
        if not pipeline.is_complete(run):
            run.engine = of_this_machine()
            pipeline.all_stages(run, monitor)
    monitor.begin("build")
    return run, read_contents(out, monitor) if build else None


class SampleOperator(JobOperator):
    """Mix-in: open the sample, computed `again` or as it is."""

    again: ClassVar[bool] = False

    def snapshot(self, context: bpy.types.Context) -> "Callable[[Monitor], tuple[Path, TakeRun, Contents | None]]":
        """The folder of the recording: next to the .blend, or in the extension's user folder if the file was never saved."""
        base = Path(bpy.data.filepath).parent if bpy.data.filepath else Path(bpy.utils.extension_path_user(EXTENSION, path="", create=True))
        take = base / project.SAMPLE_NAME
        if project.bound(context.scene) and project.folder_of(context.scene) != real_path(take):
            raise InputError("This file already has footage. Open an empty one (File > New > General) and press Load Sample there.")
        folders.check_writable(base)
        return lambda monitor: open_sample(take, self.again, monitor)

    def finish(self, context: bpy.types.Context, result: "tuple[Path, TakeRun, Contents | None]") -> set[str]:
        """Open the sample as the scene's project, and build the scene."""
        take, run, contents = result
        project.open_take(context.scene, take)
        context.scene.tricap.out = folders.for_user(take / project.RESULTS)
        if contents is not None:
            put_into_scene(self, context, contents)
            add_follower(self, context)
        report_run(self, context, run)
        return {"FINISHED"}


def add_follower(operator: bpy.types.Operator, context: bpy.types.Context) -> None:
    """Beside the sample's body, the first time, a robot that moves like it."""
    from ..retarget.robot import NAME, add_robot, follow
    from ..scene import armature

    if NAME in bpy.data.objects:
        return
    body, target = bpy.data.objects[armature.NAME], add_robot(context)
    follow(target, body)
    context.scene.tricap_retarget.target = target
    frame_in_views(operator, context, body, target)


class LoadSample(SampleOperator, bpy.types.Operator):
    """Open a finished project: a person who walks, filmed by three cameras, measured and fitted. The recording is synthetic"""

    bl_idname = "tricap.load_sample"
    bl_label = "Load Sample"
    bl_options = {"UNDO"}


class ComputeSample(SampleOperator, bpy.types.Operator):
    """Measure the footage of the sample, track it, and fit the body, from the beginning. Takes about a minute"""

    bl_idname = "tricap.compute_sample"
    bl_label = "Compute It Again"
    bl_options = {"UNDO"}
    again = True

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only with the sample open."""
        return project.is_sample(context.scene)


def open_sample(take: Path, again: bool, monitor: Monitor) -> "tuple[Path, TakeRun, Contents | None]":
    """The computation, without bpy. A sample that is there stays, with its changes; what is not valid of its results is computed, or all
    of it `again`."""
    from ...core.run.take_run import open_run
    from ...core.synthetic.arm import is_arm_take
    from ...core.synthetic.sample import unpack
    from ..scene.contents import read_contents

    out = take / project.RESULTS
    if not is_arm_take(take):
        unpack(SAMPLE, take)
    with open_run(take, out) as run:
        fitted = "fit" in run.record["stages"]
    if fitted and not again:
        monitor.begin("build")
        return take, run, read_contents(out, monitor)
    computed, contents = measure(take, out, {}, True, monitor, restart=fitted)
    computed.notes[:0] = run.notes
    return take, computed, contents


class Cancel(bpy.types.Operator):
    """Stop the running job. Finished frames are kept"""

    bl_idname = "tricap.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only while a job runs."""
        return get_session().job is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Ask the job to stop; the operator that watches it then ends."""
        job = get_session().job
        if job is not None:
            job.monitor.cancel()
        return {"FINISHED"}
