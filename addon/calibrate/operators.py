"""bpy.ops.tricap.calibrate(bar="…", length_m=0.6), bpy.ops.tricap.import_rig(…), bpy.ops.tricap.export_rig(…)"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import numpy as np
from bpy_extras.io_utils import ExportHelper, ImportHelper

from ...core.calibration.boards.board import Board, BoardKind, Lens, write_board
from ...core.calibration.rig_files import FORMATS, lens_note, read_any, write_as
from ...core.calibration.world_frame import WorldChoice
from ...core.foundation.errors import InputError
from ...core.foundation.progress import Monitor
from ...core.geometry.rig import write_rig
from ...core.images.sequence import LaterPart
from ...core.take.bar_file import write_bar
from .. import folders, project
from ..jobs import JobOperator
from ..panels import TellingOperator
from ..session import get_session
from ..steps.cameras import use_rig
from .cameras import build_cameras, rig_of_scene

if TYPE_CHECKING:
    from ...core.calibration.bars import BarObservations
    from ...core.calibration.boards.footage import BoardFootage
    from ...core.calibration.calibrate import BarFootage, CalibratedRig, MeasuredBar, Starts
    from ...core.calibration.together import BarAndBoard

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Done:
    """The result of the computation."""

    folder: Path
    files: dict[str, list[Path]]  # of each view
    # of a wand, one frame an image as the clips show them, of both fields the first:
    tracks: dict[str, np.ndarray]  # its targets (T, 2, 2) by view
    bar: tuple[np.ndarray, np.ndarray] | None  # frames (T,) and ends (T, 2, 3) [m]
    result: "CalibratedRig"
    written: Path
    firsts: dict[str, int]  # of views that were started one by one: the image that the others' first one belongs to


class Calibrate(JobOperator, bpy.types.Operator):
    """Find the wand or board in the footage, calibrate the cameras and add them to the scene"""

    bl_idname = "tricap.calibrate"
    bl_label = "Calibrate Cameras"
    bl_options = {"UNDO"}
    step = "cameras"
    if_stopped = "No camera was changed."

    bar: bpy.props.StringProperty(
        name="Target Footage",
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
        description="File for the cameras. Empty: rig.toml next to the target footage",
    )

    def snapshot(self, context: bpy.types.Context) -> Callable[[Monitor], Done]:
        """Folder, target and options as they are now."""
        from ...core.calibration import calibrate
        from ...core.calibration.boards.footage import measure_boards
        from ...core.synchronising.bar_and_board import common_start
        from ..movie_sound import movie_sound

        props = context.scene.tricap_calibrate
        if not (self.bar or props.bar):
            raise InputError("Choose the target footage first: the folder that contains a folder of images, or a movie, for each camera.")
        folder = folders.absolute(self.bar or props.bar)
        out = folders.to_write(self.out) if self.out else folder.parent / "rig.toml"
        folders.check_writable(out.parent)
        length, diameter = (typed(value) for value in (self.length_m or props.length_m, props.diameter_m))
        mask = folders.absolute(props.mask) if props.mask else None
        interlaced, first_field = props.interlaced, props.first_field
        focal, lens = props.focal_px if props.focal_px > 0 else None, Lens(props.lens)
        like = rig_of_scene(context.scene) if props.like_scene else None
        world = WorldChoice(floor_frames=frame_numbers(props.floor), level_frames=frame_numbers(props.level), like=like)
        target, rates, by_sound = props.target, props.rates.strip() or f"{props.started_fps:g}", props.started_fps > 0
        beside = _board_beside(props) if target == "WAND" and props.board_footage else None
        board = None if target == "WAND" else board_of(props, target)
        get_session().file.bar_counts.clear()

        def starts(there: Path, monitor: Monitor) -> "Starts | None":
            if not by_sound and "=" not in rates:
                return None
            return lambda names, views: common_start(there, names, views, rates, monitor, movie_sound, by_sound)[0]

        def from_wand(monitor: Monitor) -> Done:
            footage = calibrate.open_bar(folder, interlaced, mask, first_field, starts(folder, monitor))
            shown = beside and beside.opened(footage.names, starts(beside.folder, monitor))
            measured = calibrate.measure_bar(footage, length, monitor, partial(note_count, target), diameter or None)
            observations = measured.observations if not (beside and shown) else beside.measured(measured.observations, shown, monitor)
            result = calibrate.calibrate_rig(observations, monitor, focal_px=focal, lens=lens, world=world)
            return compute_wand(footage, measured, result, out)

        def from_board(monitor: Monitor) -> Done:
            assert board is not None
            footage = calibrate.open_boards(folder, starts(folder, monitor))
            observations = measure_boards(footage, board, monitor, partial(note_count, target))
            result = calibrate.calibrate_rig(observations, monitor, focal_px=focal, lens=lens, world=world)
            write(result, out)
            return Done(folder=folder, files=files_of(footage), tracks={}, bar=None, result=result, written=out, firsts=firsts_of(footage))

        return from_wand if board is None else from_board

    def finish(self, context: bpy.types.Context, result: Done) -> set[str]:
        """Build the cameras and report the verdict."""
        views = [view.name for view in context.scene.tricap.views] if project.bound(context.scene) else []
        missing = [name for name in views if name not in result.files]
        if views and not missing:
            use_rig(context.scene, result.result.rig, result.bar)
        build_cameras(context.scene, result.result.rig, result.files, result.tracks, result.bar, result.firsts)
        verdict, props = result.result.verdict, context.scene.tricap_calibrate
        props.light, props.verdict, props.advice, props.rig = verdict.light, verdict.sentence, verdict.advice, str(result.written)
        self.report({"WARNING" if verdict.light == "red" else "INFO"}, verdict.sentence)
        if missing:
            self.report(
                {"WARNING"},
                f"The cameras of the project were not replaced, because {result.folder} has no footage named like view "
                f"{missing[0]}. Rename the view or the footage, then import {result.written}.",
            )
        return {"FINISHED"}


@dataclass(frozen=True, kw_only=True)
class BoardBeside:
    """A board that the same cameras filmed besides the wand."""

    folder: Path
    board: Board
    lenses_only: bool

    def opened(self, names: tuple[str, ...], starts: "Starts | None") -> "BoardFootage":
        """Its footage.

        Raises:
            InputError: it is missing, or of other cameras than the wand's.
        """
        from ...core.calibration.calibrate import open_boards
        from ...core.calibration.together import check_names

        footage = open_boards(self.folder, starts, together=not self.lenses_only)
        check_names(names, footage.names)
        return footage

    def measured(self, bars: "BarObservations", footage: "BoardFootage", monitor: Monitor) -> "BarAndBoard":
        """The observations of both."""
        from ...core.calibration.boards.footage import measure_boards
        from ...core.calibration.together import BarAndBoard

        boards = measure_boards(footage, self.board, monitor, partial(note_count, self.board.kind.value))
        return BarAndBoard(bars=bars, boards=boards, lenses_only=self.lenses_only)


def _board_beside(props: bpy.types.PropertyGroup) -> BoardBeside:
    return BoardBeside(folder=folders.absolute(props.board_footage), board=board_of(props, props.board_kind), lenses_only=props.lenses_only)


def note_count(target: str, view: str, images: int, whole: int) -> None:
    """`whole` of the first `images` images of a view show the target; the panel shows it while the job runs."""
    get_session().file.bar_counts[view, target] = images, whole


def frame_numbers(text: str) -> tuple[int, ...]:
    """The frames in a text such as "0, 40, 80".

    Raises:
        InputError: it is something else.
    """
    try:
        return tuple(int(part) for part in text.replace(",", " ").split())
    except ValueError as error:
        raise InputError(f"“{text}” is not a list of frames. Write frame numbers, such as 0, 40, 80.") from error


def typed(value: float) -> float:
    """What was typed: the shortest decimal that Blender, in single precision, stores as this value."""
    return float(f"{value:.7g}")


def board_of(props: bpy.types.PropertyGroup, kind: str) -> Board:
    """The board of a kind that the panel describes.

    Raises:
        InputError: it is impossible.
    """
    across, down = props.squares
    return Board(
        kind=BoardKind(kind),
        squares=(across, down),
        square_m=typed(props.square_m),
        dictionary=props.dictionary,
        marker_m=typed(props.marker_m) if kind == BoardKind.CHARUCO else 0.0,
    )


def files_of(footage: "BarFootage | BoardFootage") -> dict[str, list[Path]]:
    """The files of each view."""
    return {name: list(s.files()) for name, s in zip(footage.names, footage.sequences)}


def firsts_of(footage: "BarFootage | BoardFootage") -> dict[str, int]:
    """The number of the first image of each view that is used."""
    return {name: s.first if isinstance(s, LaterPart) else 0 for name, s in zip(footage.names, footage.sequences)}


def write(result: "CalibratedRig", out: Path) -> None:
    """Write rig.toml and its report."""
    from ...core.calibration.calibrate import write_report

    write_report(out.parent / f"{out.stem}_report", result)
    write_rig(out, result.rig)


def compute_wand(footage: "BarFootage", measured: "MeasuredBar", result: "CalibratedRig", out: Path) -> Done:
    """Write rig.toml with the wand next to it; what the scene shows, one frame an image."""
    write(result, out)
    (frames, ends), per = result.bar, footage.field_layout.per_image
    write_bar(out, result.rig, frames, ends)
    first = frames % per == 0
    return Done(
        folder=footage.folder,
        files=files_of(footage),
        tracks={name: track.xy_px[::per] for name, track in zip(footage.names, measured.tracks)},
        bar=(frames[first] // per, ends[first]),
        result=result,
        written=out,
        firsts=firsts_of(footage),
    )


class PrintBoard(TellingOperator, ExportHelper, bpy.types.Operator):
    """Save the board for a printer, in its true size, as PDF or PNG. Print it without scaling, and glue it to a flat plate"""

    bl_idname = "tricap.print_board"
    bl_label = "Save Board for Printing"

    filename_ext = ".pdf"
    check_extension = None

    def do(self, context: bpy.types.Context) -> str:
        """Write the file."""
        props = context.scene.tricap_calibrate
        if props.target == "WAND":
            raise InputError("Choose ChArUco or Checkerboard first; a wand is not printed.")
        board, path = board_of(props, props.target), folders.to_write(self.filepath)
        write_board(path, board)
        return f"A {board.kind.value} of {board.label} in {path}. Print it without scaling."


class ImportRig(TellingOperator, ImportHelper, bpy.types.Operator):
    """Add cameras from a calibration file: Tricap, Anipose, Pose2Sim, caliscope, OpenCV, EasyMocap, COLMAP, OpenPTV or Agisoft"""

    bl_idname = "tricap.import_rig"
    bl_label = "Import Cameras"
    bl_options = {"UNDO"}

    def do(self, context: bpy.types.Context) -> str:
        """Read the file and build its cameras."""
        rig = read_any(folders.absolute(self.filepath))
        build_cameras(context.scene, rig, {}, {})
        return " ".join([f"{len(rig.cameras)} cameras from {self.filepath}.", *rig.remarks])


class ExportRig(TellingOperator, ExportHelper, bpy.types.Operator):
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

    def do(self, context: bpy.types.Context) -> str:
        """Read the scene and write the file."""
        rig, path = rig_of_scene(context.scene), folders.to_write(self.filepath)
        said = f"{len(rig.cameras)} cameras in {path}."
        if self.layout_name == "tricap":
            write_rig(path, rig)
            return said
        write_as(path, rig, self.layout_name)
        return f"{said} {lens_note(path, rig, self.layout_name)}".strip()


CLASSES = (Calibrate, PrintBoard, ImportRig, ExportRig)
