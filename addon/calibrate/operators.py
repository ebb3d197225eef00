"""bpy.ops.tricap.calibrate(bar="…", length_m=0.6), bpy.ops.tricap.import_rig(…), bpy.ops.tricap.export_rig(…)"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.io_utils import ExportHelper, ImportHelper

from ...core.calibration.calibrate import BarFootage, CalibratedRig, MeasuredBar, calibrate_rig, measure_bar, open_bar, write_report
from ...core.calibration.rig_files import FORMATS, read_any, write_as
from ...core.calibration.world_frame import WorldChoice
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.geometry.rig import write_rig
from ...core.take.bar_file import write_bar
from .. import folders, project
from ..jobs import JobOperator
from ..session import get_session
from ..steps.cameras import use_rig
from .cameras import build_cameras, rig_of_scene

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Done:
    """The result of the computation."""

    footage: BarFootage
    measured: MeasuredBar
    result: CalibratedRig
    written: Path

    @property
    def tracks(self) -> dict[str, np.ndarray]:
        """The targets (T, 2, 2) by view, one frame an image as the clips show them: of both fields the first."""
        per = self.footage.field_layout.per_image
        return {name: track.xy_px[::per] for name, track in zip(self.footage.names, self.measured.tracks)}

    @property
    def bar(self) -> tuple[np.ndarray, np.ndarray]:
        """Frames (T,) and ends (T, 2, 3) [m] of the bar, one frame an image likewise."""
        (frames, ends), per = self.result.bar, self.footage.field_layout.per_image
        first = frames % per == 0
        return frames[first] // per, ends[first]


class Calibrate(JobOperator, bpy.types.Operator):
    """Find the targets of the wand in the footage, calibrate the cameras and add them to the scene"""

    bl_idname = "tricap.calibrate"
    bl_label = "Calibrate Cameras"
    bl_options = {"UNDO"}
    step = "cameras"
    if_stopped = "No camera was changed."

    bar: bpy.props.StringProperty(
        name="Wand Footage",
        subtype="DIR_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="Folder that contains a folder of images, or a movie, for each camera. Empty: the one in the panel",
    )
    length_m: bpy.props.FloatProperty(
        name="Wand Length",
        min=0.0,
        unit="LENGTH",
        precision=4,  # type: ignore[valid-type]
        description="Distance between the centres of the targets. 0: the length in the panel",
    )
    out: bpy.props.StringProperty(
        name="Rig",
        subtype="FILE_PATH",
        options=RELATIVE,  # type: ignore[valid-type]
        description="File for the cameras. Empty: rig.toml next to the wand footage",
    )

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], Done]:
        """Folder, length and options as they are now."""
        props = context.scene.tricap_calibrate
        if not (self.bar or props.bar):
            raise InputError("Choose the wand footage first: the folder that contains a folder of images, or a movie, for each camera.")
        folder = folders.absolute(self.bar or props.bar)
        out = folders.absolute(self.out) if self.out else folder.parent / "rig.toml"
        folders.check_writable(out.parent)
        # What was typed is the shortest decimal that Blender, in single precision, stores as this value.
        length, diameter = (float(f"{value:.7g}") for value in (self.length_m or props.length_m, props.diameter_m))
        mask = folders.absolute(props.mask) if props.mask else None
        interlaced, first_field = props.interlaced, props.first_field
        focal = props.focal_px if props.focal_px > 0 else None
        like = rig_of_scene(context.scene) if props.like_scene else None
        world = WorldChoice(floor_frames=frame_numbers(props.floor), level_frames=frame_numbers(props.level), like=like)
        get_session().file.bar_counts.clear()

        def read_and_calibrate(monitor: Monitor) -> Done:
            footage = open_bar(folder, interlaced, mask, first_field)
            return compute(footage, measure_bar(footage, length, monitor, note_count, diameter or None), focal, world, out, monitor)

        return read_and_calibrate

    def finish(self, context: bpy.types.Context, result: Done) -> set[str]:
        """Build the cameras and report the verdict."""
        views = [view.name for view in context.scene.tricap.views] if project.bound(context.scene) else []
        missing = [name for name in views if name not in result.footage.names]
        if views and not missing:
            use_rig(context.scene, result.result.rig, result.bar)
        files = {name: list(s.files()) for name, s in zip(result.footage.names, result.footage.sequences)}
        build_cameras(context.scene, result.result.rig, files, result.tracks, result.bar)
        verdict, props = result.result.verdict, context.scene.tricap_calibrate
        props.light, props.verdict, props.advice, props.rig = verdict.light, verdict.sentence, verdict.advice, str(result.written)
        self.report({"WARNING" if verdict.light == "red" else "INFO"}, verdict.sentence)
        if missing:
            self.report(
                {"WARNING"},
                f"The cameras of the project were not replaced, because {result.footage.folder} has no footage named like view "
                f"{missing[0]}. Rename the view or the footage, then import {result.written}.",
            )
        return {"FINISHED"}


def note_count(view: str, images: int, whole: int) -> None:
    """`whole` of the first `images` images of a view show both targets; the panel shows it while the job runs."""
    get_session().file.bar_counts[view] = images, whole


def frame_numbers(text: str) -> tuple[int, ...]:
    """The frames in a text such as "0, 40, 80".

    Raises:
        InputError: it is something else.
    """
    try:
        return tuple(int(part) for part in text.replace(",", " ").split())
    except ValueError as error:
        raise InputError(f"“{text}” is not a list of frames. Write frame numbers, such as 0, 40, 80.") from error


def compute(footage: BarFootage, measured: MeasuredBar, focal_px: float | None, world: WorldChoice, out: Path, monitor: Monitor) -> Done:
    """The computation, without bpy: from the measured wand to rig.toml, with its report."""
    result = calibrate_rig(measured.observations, monitor, focal_px=focal_px, world=world)
    write_report(out.parent / f"{out.stem}_report", result)
    write_rig(out, result.rig)
    write_bar(out, result.rig, *result.bar)
    return Done(footage=footage, measured=measured, result=result, written=out)


class ImportRig(ImportHelper, bpy.types.Operator):
    """Add cameras from a calibration file: Tricap, Anipose, Pose2Sim, caliscope, OpenCV, EasyMocap, COLMAP, OpenPTV or Agisoft"""

    bl_idname = "tricap.import_rig"
    bl_label = "Import Cameras"
    bl_options = {"UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Read the file and build its cameras."""
        try:
            rig = read_any(folders.absolute(self.filepath))
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        build_cameras(context.scene, rig, {}, {})
        self.report({"INFO"}, f"{len(rig.cameras)} cameras from {self.filepath}.")
        return {"FINISHED"}


class ExportRig(ExportHelper, bpy.types.Operator):
    """Export the scene's cameras, with the lens distortion of their background clips, as a calibration file"""

    bl_idname = "tricap.export_rig"
    bl_label = "Export Cameras"

    filename_ext = ".toml"
    check_extension = None
    layout_name: bpy.props.EnumProperty(
        name="Format",
        default="tricap",  # type: ignore[valid-type]
        items=[(name, name, "") for name in ("tricap", *sorted(FORMATS))],
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Read the scene and write the file."""
        try:
            rig, path = rig_of_scene(context.scene), folders.absolute(self.filepath)
            if self.layout_name == "tricap":
                write_rig(path, rig)
            else:
                write_as(path, rig, self.layout_name)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{len(rig.cameras)} cameras in {path}.")
        return {"FINISHED"}


CLASSES = (Calibrate, ImportRig, ExportRig)
