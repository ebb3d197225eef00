"""The stage that calibrates: from a folder with the images of a waved reference bar to a rig with its report.

BARDIR has a folder of images or a movie per camera; their names are the names of the cameras. Only the length of the bar is required.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..geometry.rig import Rig
from ..images.interlace import FieldLayout, field_layout
from ..images.picture import read_image
from ..images.sequence import IMAGE_ENDINGS, ImageSequence, LaterPart
from ..results.listed_files import PICTURES, check_files
from ..results.outputs import check_replaceable
from . import report, verdict
from .bar_lenses import calibrate_bar
from .bars import BarObservations
from .boards.board import Lens
from .boards.calibration import calibrate_boards
from .boards.footage import BoardFootage, numbered
from .boards.observations import BoardObservations
from .clocks import Clocks, at_common_instants
from .quality import Quality, assess
from .report import pictures
from .self_calibration import Calibration
from .targets import BarTrack, Targets, find_targets, moved_targets, track_bar
from .together import BarAndBoard, calibrate_together
from .view_files import open_views
from .world_frame import WorldChoice, frame_of_bar

Note = Callable[[str, int, int], None]  # view, images searched, images with both targets
MIN_POSITIONS = 12
MIN_PATH = 0.02  # of the image width: a bar that moves less is static
MIN_STATIC = 4  # positions that show whether the bar moves
LONGEST_BAR_M = 20.0
SHORTEST_BAR_M = 0.005
UNDETERMINED = (
    "The image points do not determine the cameras; check that no camera was moved or turned while recording, that the sequences start "
    "at the same instant, and that no view is mirrored."
)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BarFootage:
    """The opened sequences of a waved bar, one per camera."""

    folder: Path
    names: tuple[str, ...]
    sequences: tuple[ImageSequence, ...]
    interlaced: str = "none"  # or "odd", "even", "both"
    masks: tuple[np.ndarray | None, ...] = ()  # of each view (h, w), False where no target can be; empty: none
    first_field: str = "odd"  # of "both"
    clocks: Clocks | None = None  # of films at different rates

    @property
    def field_layout(self) -> FieldLayout:
        """Which rows of which image show a frame: an image, or one of its two fields where both are measured."""
        return field_layout(self.interlaced, self.first_field)

    def count(self, view: int) -> int:
        """Number of frames of a view: its own, or those that all views have."""
        images = self.sequences[view].count if self.clocks is not None else min(s.count for s in self.sequences)
        return images * self.field_layout.per_image


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MeasuredBar:
    """The tracks of the two targets, one per view, and the observations made from them."""

    tracks: tuple[BarTrack, ...]
    observations: BarObservations


Start = tuple[int, ...] | Clocks  # the images of the views that were taken at once, or the clocks of films at different rates
Starts = Callable[[tuple[str, ...], tuple[ImageSequence, ...]], Start]  # finds it


def open_bar(
    folder: Path, interlaced: str = "none", mask: Path | None = None, first_field: str = "odd", starts: Starts | None = None
) -> BarFootage:
    """Open the sequences in BARDIR: one folder of images, or one movie, per camera.

    With `interlaced` "both" each image shows the bar at two instants; the `first_field` is the earlier one.

    `mask` is an image, black where no target can be, or a folder of such images named like the cameras that need one.

    Raises:
        InputError: the folder is missing, has fewer than two views, or views of different length; a mask belongs to no camera.
    """
    folder = Path(folder)
    names, sequences = open_views(folder, "bar")
    sequences, clocks = _started(names, sequences, starts)
    counts = {name: s.count for name, s in zip(names, sequences)}
    if clocks is None and len(set(counts.values())) > 1:
        lengths = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise InputError(
            f"The views in {folder} have different numbers of frames ({lengths}); "
            "trim them to the same instants, or let `tricap calibrate --synchronise` find them by their sound."
        )
    masks = () if mask is None else _masks(Path(mask), names)
    return BarFootage(
        folder=folder, names=names, sequences=sequences, interlaced=interlaced, masks=masks, first_field=first_field, clocks=clocks
    )


def _started(
    names: tuple[str, ...], sequences: tuple[ImageSequence, ...], starts: Starts | None
) -> tuple[tuple[ImageSequence, ...], Clocks | None]:
    """What all sequences have in common if images of theirs were taken at once; or all of them, with the clocks of different rates."""
    found = None if starts is None else starts(names, sequences)
    if isinstance(found, Clocks):
        found.check_overlap(names, [s.count for s in sequences])
    if found is None or isinstance(found, Clocks):
        return sequences, found
    count = min(s.count - first for s, first in zip(sequences, found))
    return tuple(LaterPart(s, first, count) for s, first in zip(sequences, found)), None


def open_boards(folder: Path, starts: Starts | None = None, together: bool = True) -> BoardFootage:
    """Open the sequences of a board in BOARDDIR: one folder of images, or one movie, per camera; images of the same number belong together,
    or those that `starts` finds, if they were taken `together`.

    Raises:
        InputError: the folder is missing, has fewer than two views, or movies of different length that were taken together.
    """
    names, sequences = open_views(Path(folder), "board", gaps=True)
    sequences, clocks = _started(names, sequences, starts if together else None)
    return numbered(Path(folder), names, sequences, together, clocks)


def _masks(path: Path, names: tuple[str, ...]) -> tuple[np.ndarray | None, ...]:
    if not path.is_dir():
        shown = read_image(path) > 0
        return (shown,) * len(names)
    found = {file.stem: file for file in sorted(path.iterdir()) if file.suffix.lower() in IMAGE_ENDINGS}
    unknown = [name for name in found if name not in names]
    if unknown or not found:
        what = f"the mask {found[unknown[0]].name}, and there is no camera of that name" if unknown else "no image"
        raise InputError(f"{path} has {what}; give the masks the names of the cameras: {', '.join(names)}.")
    return tuple(read_image(found[name]) > 0 if name in found else None for name in names)


def measure_bar(
    footage: BarFootage, length_m: float, monitor: Monitor, note: Note | None = None, diameter_m: float | None = None
) -> MeasuredBar:
    """Find, measure and track the targets of the bar in all images; `note` is called with the number of images of a view with two targets.

    With the diameter of the targets, pairs of spots that are too small for their distance, such as reflections, are not used.

    Raises:
        InputError: the length or the diameter is impossible, images cannot be read, or the bar is not visible often enough.
    """
    if not (math.isfinite(length_m) and SHORTEST_BAR_M <= length_m < LONGEST_BAR_M):
        raise InputError(
            f"The bar's length is given as {length_m:g} m; give the distance between the middles of its two targets in metres, such as 0.6 "
            f"({SHORTEST_BAR_M:g} to {LONGEST_BAR_M:g})."
        )
    if diameter_m is not None and not 0 < diameter_m < length_m:
        raise InputError(f"The targets' diameter is given as {diameter_m:g} m; it must lie between 0 and the bar's length, {length_m:g} m.")
    tracks, sizes = [], []
    for view in range(len(footage.names)):
        track, size = _measure_view(footage, view, monitor, note, (diameter_m or 0.0) / length_m)
        _check_view(footage, view, track, size[0])
        tracks.append(track)
        sizes.append(size)
    frames, xy = _at_once(footage, tracks)
    observations = BarObservations(
        names=footage.names, size_px=np.array(sizes, dtype=np.float64), xy_px=xy, length_m=length_m, frames=frames, labelled=False
    )
    _check_positions(footage, observations)
    return MeasuredBar(tracks=tuple(tracks), observations=observations)


def _at_once(footage: BarFootage, tracks: Sequence[BarTrack]) -> tuple[np.ndarray, np.ndarray]:
    """The frames (N,), and the ends (N, C, 2, 2) of the bar in them."""
    numbers = [np.arange(len(t.xy_px)) for t in tracks]
    if footage.clocks is None:
        return numbers[0], np.stack([t.xy_px for t in tracks], axis=1)
    return at_common_instants(footage.clocks.of_fields(footage.field_layout.per_image), numbers, [t.xy_px for t in tracks])


def _measure_view(footage: BarFootage, view: int, monitor: Monitor, note: Note | None, diameter: float) -> tuple[BarTrack, tuple[int, int]]:
    """The bar's track in one view, and the size of its images; `diameter` of the targets as a part of the bar's length, 0: unknown."""
    name, sequence = footage.names[view], footage.sequences[view]
    mask = footage.masks[view] if footage.masks else None
    found: list[Targets] = []
    size, whole = (0, 0), 0
    count = footage.count(view)
    for n in range(count):
        monitor.step(f"targets {name}", n, count)
        image, rows = sequence.read(footage.field_layout.image(n)), footage.field_layout.rows(n)
        if n and image.shape[::-1] != size:
            raise InputError(f"The images of view {name} have different sizes, from frame {n} on; use one sequence of one camera.")
        size = (image.shape[1], image.shape[0])
        if mask is not None and mask.shape != image.shape:
            raise InputError(
                f"The mask of view {name} has {mask.shape[1]}×{mask.shape[0]} pixels, its images {size[0]}×{size[1]}; give a folder with a "
                "mask for each camera, as large as its images."
            )
        targets = find_targets(rows.rows(image), None if mask is None else rows.rows(mask))
        found.append(_in_frame(targets, rows.to_frame(targets.xy_px)))
        whole += int(moved_targets(found[-2:]) >= 2)
        if note is not None:
            note(name, len(found), whole)
    monitor.step(f"targets {name}", count, count)
    return track_bar(found, float(size[0]), diameter / np.sqrt(footage.field_layout.first.step)), size


def _in_frame(targets: Targets, xy_px: np.ndarray) -> Targets:
    return Targets(xy_px=xy_px, sigma_px=targets.sigma_px, area_px=targets.area_px, contrast=targets.contrast, status=targets.status)


def _check_view(footage: BarFootage, view: int, track: BarTrack, width_px: int) -> None:
    """Raise InputError if a view does not show a bar that is waved."""
    name = footage.names[view]
    complete = np.isfinite(track.xy_px).all(axis=(1, 2))
    if not track.spots.any():
        raise InputError(f"No bright target is visible in any image of view {name} in {footage.folder}; light it from next to the camera.")
    if complete.sum() < 2:
        raise InputError(
            f"View {name} in {footage.folder} never shows both targets of the bar; wave it where both are visible to "
            "this camera, or leave the camera out."
        )
    path_px = np.ptp(track.xy_px[complete], axis=0).max()
    if complete.sum() >= MIN_STATIC and (track.static or path_px < MIN_PATH * width_px):
        raise InputError(
            f"The bar does not move in view {name} in {footage.folder} (only {path_px:.1f} px), "
            "or only lamps and reflections are visible there; wave it through the whole volume, in all directions."
        )


def _check_positions(footage: BarFootage, observations: BarObservations) -> None:
    shared = int((observations.complete.sum(axis=1) >= 2).sum())
    if shared < MIN_POSITIONS:
        raise InputError(
            f"In only {shared} bar positions in {footage.folder} both ends are visible to two cameras; at least {MIN_POSITIONS} are needed "
            "and 100 or more are good: wave the bar for longer, through the whole volume."
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CalibratedRig:
    """The cameras and their quality."""

    rig: Rig
    calibration: Calibration
    quality: Quality
    verdict: verdict.Verdict

    @property
    def bar(self) -> tuple[np.ndarray, np.ndarray]:
        """Frames (T,) in which the bar or the board was measured, and its points (T, K, 3) [m] in the world."""
        known = self.calibration.observations.measured(self.calibration.used)
        return self.calibration.observations.frames[known], self.calibration.network.points_m[known]


def calibrate_rig(
    observations: BarObservations | BoardObservations | BarAndBoard,
    monitor: Monitor,
    *,
    focal_px: float | None = None,
    lens: Lens = Lens.AUTO,
    world: WorldChoice | None = None,
) -> CalibratedRig:
    """Calibrate from the observations of the bar, the board or both, judge the result, and put it into the world's frame.

    Raises:
        InputError: the data do not determine the rig or the world's frame; the message names what is missing.
    """
    world = world or WorldChoice()
    for seen in (observations.bars, observations.boards) if isinstance(observations, BarAndBoard) else (observations,):
        verdict.refuse_same_footage(seen)
    try:
        calibration = _adjusted(observations, monitor, focal_px, lens)
        verdict.refuse_if_useless(calibration)
        calibration = in_world(calibration, world)
        quality = assess(calibration, monitor)
    except np.linalg.LinAlgError as error:
        raise InputError(UNDETERMINED) from error
    verdict.refuse_if_undetermined(calibration, quality)
    judged = verdict.judge(calibration, quality)
    metadata = {
        "unit": "m",
        "sigma0_px": calibration.sigma0_px,
        **calibration.described,
        "positions": verdict.positions_used(calibration),
        "predicted_error_m": quality.predicted.rms_m,
        "held_out_length_rms_m": quality.held_out.rms_m,
        "verdict": judged.sentence,
        **({} if judged.light is verdict.Light.GREEN else {"light": judged.light.value}),
        "floor": world.on_floor,
    }
    cameras = calibration.network.cameras(calibration.observations.names, calibration.observations.size_px)
    rig = Rig(cameras=cameras, metadata=metadata, sigmas=report.camera_sigmas(calibration))
    return CalibratedRig(rig=rig, calibration=calibration, quality=quality, verdict=judged)


def _adjusted(
    observations: BarObservations | BoardObservations | BarAndBoard, monitor: Monitor, focal_px: float | None, lens: Lens
) -> Calibration:
    if isinstance(observations, BarAndBoard):
        return calibrate_together(observations, monitor, focal_px, lens)
    if isinstance(observations, BarObservations):
        return calibrate_bar(observations, monitor, focal_px, lens)
    return calibrate_boards(observations, monitor, focal_px, lens)


def in_world(calibration: Calibration, world: WorldChoice) -> Calibration:
    """The calibration in the world's frame. Its covariance does not change: the unknowns of the cameras are in their own frames.

    Raises:
        InputError: what the frame is defined by is not visible, or does not determine it.
    """
    observations, network = calibration.observations, calibration.network
    cameras = network.cameras(observations.names, observations.size_px)
    known = observations.measured(calibration.used)
    frame = frame_of_bar(world, cameras, observations.frames[known], network.points_m[known])
    moved = network.transformed(frame.R, frame.shift_m)
    moved = moved.with_cameras([frame.camera(c) for c in cameras])
    if calibration.other is None:
        return replace(calibration, network=moved)
    other = calibration.other.moved(frame)
    return replace(calibration, network=moved, other=other, unknowns=replace(calibration.unknowns, block=other.block))


PAGE, FIGURES = "calibration.txt", "calibration.json"


def check_report(folder: Path) -> None:
    """Check that a folder has no images, page or figures but those of an earlier report.

    Raises:
        InputError: it has.
    """
    check_replaceable(folder / FIGURES, report.START)
    if not (folder / FIGURES).exists():
        check_replaceable(folder / PAGE)
        check_files(folder, PICTURES)


def write_report(folder: Path, result: CalibratedRig) -> list[Path]:
    """Write calibration.txt, calibration.json and the pictures; their paths.

    Raises:
        InputError: the folder has other images, or cannot be written to.
    """
    calibration, quality, judged = result.calibration, result.quality, result.verdict
    folder = Path(folder)
    check_report(folder)
    paths = [folder / PAGE, folder / FIGURES]
    store.write_text(paths[0], report.page(calibration, quality, judged))
    store.write_json(paths[1], report.figures(calibration, quality, judged))
    for name, picture in pictures(calibration, quality).items():
        ok, data = cv2.imencode(".png", picture)
        if ok:
            store.write_bytes(folder / name, data.tobytes())
            paths.append(folder / name)
    return paths
