"""Interlaced video: an image has two fields, exposed one after the other: one in its even rows and one in its odd rows.

Matching works on the rows of one field; every coordinate that leaves this package is in FULL-FRAME pixels. Field row r is frame row 2 r or
2 r + 1 (D'Apuzzo et al. 1999, §2.1, use the odd lines only).

`field_pictures` writes images of single fields for programs that show footage frame by frame, with the missing rows interpolated. They are
written once; a file next to them records the footage that they were made from.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import overload

import cv2
import numpy as np

from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from .sequence import ImageSequence

INTERLACE = ("none", "odd", "even")
BOTH = "both"  # fields, as two frames of an image


@dataclass(frozen=True, slots=True)
class RowGrid:
    """Which rows of the frame an image holds: frame row = step · row + offset. Columns are those of the frame."""

    step: int = 1
    offset: int = 0

    def rows(self, frame: np.ndarray) -> np.ndarray:
        """The rows (h', w) of a full frame (h, w), contiguous."""
        return np.ascontiguousarray(frame[self.offset :: self.step])

    def to_frame(self, xy: np.ndarray) -> np.ndarray:
        """Full-frame pixels (…, 2) of coordinates (…, 2) in the rows' image."""
        return np.asarray(xy, dtype=np.float64) * (1.0, self.step) + (0.0, self.offset)

    def from_frame(self, xy: np.ndarray) -> np.ndarray:
        """Coordinates (…, 2) in the rows' image of full-frame pixels (…, 2)."""
        return (np.asarray(xy, dtype=np.float64) - (0.0, self.offset)) / (1.0, self.step)

    def whole(self, frame: np.ndarray) -> np.ndarray:
        """The frame (h, w) with the rows of the other field replaced by interpolation."""
        if self.step == 1:
            return frame
        filled = frame.copy()
        other = np.arange(1 - self.offset, len(frame), 2)
        above, below = np.clip(other - 1, self.offset, None), other + 1
        below = np.where(below < len(frame), below, above)
        filled[other] = 0.5 * (frame[above] + frame[below])
        return filled

    def covariance_to_frame(self, covariance: np.ndarray) -> np.ndarray:
        """Covariances (…, 2, 2), in full-frame pixels, of coordinates in the rows' image."""
        scale = np.array([1.0, self.step])
        return covariance * scale[:, None] * scale[None, :]


@dataclass(frozen=True, slots=True)
class FieldLayout:
    """Which image, and which of its rows, show frame n of a recording: one frame per image, or two where both fields are measured."""

    first: RowGrid = RowGrid()
    second: RowGrid | None = None

    @property
    def per_image(self) -> int:
        """Frames per image, 1 or 2."""
        return 1 if self.second is None else 2

    def rows(self, frame: int) -> RowGrid:
        """The rows that show it."""
        return self.first if self.second is None or frame % 2 == 0 else self.second

    def image(self, frame: int) -> int:
        """Number of the image that shows it."""
        return frame // self.per_image


def field_layout(interlaced: str, first_field: str = "odd") -> FieldLayout:
    """The layout of footage of which all rows ("none"), one field, or "both" are measured; `first_field` of both was exposed first."""
    if interlaced != BOTH:
        return FieldLayout(row_grid(interlaced))
    odd, even = row_grid("odd"), row_grid("even")
    return FieldLayout(odd, even) if first_field == "odd" else FieldLayout(even, odd)


def row_grid(interlaced: str) -> RowGrid:
    """The grid of the rows that are measured: "odd" has the 1st, 3rd, … line (rows 0, 2, …), "even" the others, "none" all."""
    return {"none": RowGrid(1, 0), "odd": RowGrid(2, 0), "even": RowGrid(2, 1)}[interlaced]


@overload
def frame_time_s(frame: float, fps: float) -> float: ...
@overload
def frame_time_s(frame: np.ndarray, fps: float) -> np.ndarray: ...
def frame_time_s(frame: float | np.ndarray, fps: float) -> float | np.ndarray:
    """When a frame of a recording (or each of several) was taken, in seconds after its frame 0; `fps` frames per second, fields counted."""
    return frame / fps


MADE_FROM = "made_from.json"
UNFINISHED = {"count": 0}  # in it, while the pictures are written


def field_pictures(sequence: ImageSequence, fields: FieldLayout, folder: Path, monitor: Monitor | None = None) -> tuple[Path, ...]:
    """FOLDER/000000.png …, an image of every field of a sequence, written unless they exist.

    Raises:
        InputError: an image cannot be read, the folder or its parent is a link, the folder has other pictures, or it cannot be written to.
        Cancelled: the monitor was cancelled; the next call writes all images.
    """
    paths = tuple(folder / f"{n:06d}.png" for n in range(fields.per_image * sequence.count))
    source, record = _identity(sequence, fields), folder / MADE_FROM
    if record.is_file() and store.read_json(record) == source and all(path.is_file() for path in paths):
        return paths
    link = next((path for path in (folder, folder.parent) if path.is_symlink()), None)
    if link is not None:
        raise InputError(f"{link} is a link, through which pictures of the fields would be written elsewhere; remove the link.")
    other = None if record.is_file() else next(folder.glob("*.png"), None)
    if other is not None:
        raise InputError(f"{other} is not a picture of a field that Tricap wrote; move it, or choose another folder for the results.")
    try:
        store.write_json(record, UNFINISHED)  # also makes the folder; whoever is killed now leaves it marked as ours
        for n, path in enumerate(paths):
            if monitor is not None:
                monitor.step("fields", n, len(paths))
            picture = fields.rows(n).whole(sequence.read(fields.image(n)))
            store.write_bytes(path, cv2.imencode(".png", np.clip(np.rint(picture), 0, 255).astype(np.uint8))[1].tobytes())
        store.write_json(record, source)
    except OSError as error:
        raise InputError(f"Cannot write pictures of the fields into {folder}: {error.strerror or error}. Choose another folder.") from error
    return paths


def _identity(sequence: ImageSequence, fields: FieldLayout) -> dict[str, object]:
    """What identifies the images: names, sizes and dates of the footage, and which field is first."""
    files = [[str(path), path.stat().st_size, path.stat().st_mtime_ns] for path in sequence.files()]
    return {"files": files, "count": sequence.count, "first_row": fields.first.offset}
