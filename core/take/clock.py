"""When each image of a view was exposed, on the take's clock: the views may start at different moments and run at different rates.

    T_n = start − offset_frames / fps + (1 + drift) τ_n ,   τ_n = n / fps, or the time stamp of image n minus that of image 0        (1)

Frame t of the take is at the instant t / (fps of the take). A view shows it by the image that was exposed nearest to that instant, and the
measured images are interpolated over the rest (`images.retime`). A rolling shutter exposes the row at height y, 0 … 1, at

    T_n + readout (y − ½)                                                                                                       (2)
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..foundation import bounded
from ..foundation.arrays import frozen
from ..foundation.errors import InputError, shown
from .sources import inside, is_number

if TYPE_CHECKING:
    from ..images.sequence import ImageSequence
    from .take import Take, View

KEYS = ("fps", "start", "drift_ppm", "timestamps", "readout")  # of [[views]]
LONGEST_S = 1e6  # between the starts of two views
MOST_DRIFT_PPM = 1e4
LONGEST_READOUT_S = 1.0
VIEW_COLUMNS = ("view", "cam_id", "camera", "cam")  # of a file with the time stamps of several views
TIME_COLUMNS = ("time_s", "frame_time", "timestamp", "time")
ORDER_COLUMN = "frame_index"
LEAST_DELAY = 0.01  # images: less is not interpolated


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Clock:
    """The moments of a view's images in seconds on the take's clock.  (1)

    `times_s` (n,), strictly increasing, are those of its images; None: every `period_s` from `start_s` on.
    """

    start_s: float
    period_s: float
    times_s: np.ndarray | None = None
    readout_s: float = 0.0  # of a rolling shutter, from the first row to the last; negative where the last row is the first

    def __post_init__(self) -> None:
        if self.times_s is not None:
            object.__setattr__(self, "times_s", frozen(self.times_s, (None,)))

    def time_s(self, number: float) -> float:
        """When an image was exposed, also between images, and beyond the first and the last at the mean rate."""
        if self.times_s is None:
            return self.start_s + number * self.period_s
        last = len(self.times_s) - 1
        inside = min(max(number, 0), last)
        return float(np.interp(inside, np.arange(last + 1), self.times_s)) + (number - inside) * self.period_s

    def nearest(self, instant_s: float) -> int:
        """The number of the image exposed nearest to an instant; beyond the recording, a number that it does not have."""
        if self.times_s is None:
            return round((instant_s - self.start_s) / self.period_s)
        last = len(self.times_s) - 1
        first_s, last_s = float(self.times_s[0]), float(self.times_s[-1])
        if not first_s <= instant_s <= last_s:
            end, end_s = (0, first_s) if instant_s < first_s else (last, last_s)
            return end + round((instant_s - end_s) / self.period_s)
        return round(float(np.interp(instant_s, self.times_s, np.arange(last + 1))))

    def delay_images(self, number: int, instant_s: float) -> float:
        """By how many of its intervals the image `number` was exposed after an instant, 0 if that does not matter."""
        late = self.time_s(number) - instant_s
        delay = late / abs(self.time_s(number) - self.time_s(number - 1 if late > 0 else number + 1))
        return round(delay, 4) if abs(delay) >= LEAST_DELAY else 0.0

    def row_delays(self, rows: int) -> np.ndarray:
        """By how many of its intervals each of the rows of an image was exposed after its middle one (rows,).  (2)"""
        return self.readout_s / self.period_s * ((np.arange(rows) + 0.5) / rows - 0.5)

    def digest(self) -> tuple[float | bytes, ...]:
        """The content, as values with a `repr`."""
        times = b"" if self.times_s is None else self.times_s.tobytes()
        return (self.start_s, self.period_s, times, *((self.readout_s,) if self.readout_s else ()))


def view_clock(entry: Mapping[str, Any], label: str) -> dict[str, Any]:
    """The keys of a view's table that set its clock, checked.

    Raises:
        InputError: a value is impossible.
    """
    fps, start, drift = entry.get("fps"), entry.get("start", 0.0), entry.get("drift_ppm", 0.0)
    if fps is not None and not (is_number(fps) and 0.1 <= fps <= 10_000):
        raise InputError(f"`fps` of {label} is {shown(fps)}; write its images per second, such as 30.0.")
    if not is_number(start) or abs(start) > LONGEST_S:
        raise InputError(f"`start` of {label} is {shown(start)}; write the seconds at which its first image was taken, such as -1.25.")
    if not is_number(drift) or abs(drift) > MOST_DRIFT_PPM:
        raise InputError(f"`drift_ppm` of {label} is {shown(drift)}; write by how many millionths its clock is slow, such as 20.0.")
    readout = entry.get("readout", 0.0)
    if not is_number(readout) or abs(readout) > LONGEST_READOUT_S:
        raise InputError(f"`readout` of {label} is {shown(readout)}; write the seconds from its first row to the last, such as 0.016.")
    stamps = entry.get("timestamps")
    if stamps is not None:
        inside(Path(), stamps, label, "timestamps")
    numbers = {"start_s": float(start), "drift_ppm": float(drift), "readout_s": float(readout)}
    return {"fps": None if fps is None else float(fps), "timestamps": stamps, **numbers}


def clocks_of(take: "Take", sequences: Sequence["ImageSequence"]) -> tuple[Clock, ...]:
    """The clocks of all views; none where every view is shifted by whole frames at most.

    Raises:
        InputError: the time stamps cannot be read, or are not one for every image.
    """
    if not any(view.has_clock for view in take.views):
        return ()
    rate = take.fps / take.field_layout.per_image
    return tuple(_clock(view, rate, s.count, take.folder) for view, s in zip(take.views, sequences))


def _clock(view: "View", rate: float, count: int, folder: Path) -> Clock:
    period = (1 + 1e-6 * view.drift_ppm) / (view.fps or rate)
    start = view.start_s - view.offset_frames / (view.fps or rate)
    if view.timestamps is None:
        return Clock(start_s=start, period_s=period, readout_s=view.readout_s)
    stamps = read_timestamps(folder / view.timestamps, view.name)
    if len(stamps) != count:
        raise InputError(
            f"{folder / view.timestamps} has {len(stamps)} time stamps of view {view.name}, which has {count} images; "
            "there must be one for every image."
        )
    times = view.start_s + (1 + 1e-6 * view.drift_ppm) * (stamps - stamps[0])
    usual = float(np.median(np.diff(times))) if count > 1 else period
    shifted = times - view.offset_frames * usual
    return Clock(start_s=float(times[0]), period_s=usual, times_s=shifted, readout_s=view.readout_s)


def read_timestamps(path: Path, view: str) -> np.ndarray:
    """The time stamps (n,) in seconds of a view's images, in order.

    A CSV with a header. Its time column is one of TIME_COLUMNS; a column of VIEW_COLUMNS, if there is one, has the name of the view, or the
    number at its end (“cam_2” or “2”); rows are in the order of the images, or have `frame_index`.

    Raises:
        InputError: the file is missing or no such table, or its times do not increase.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(bounded.text_of(path, bounded.CALIBRATION_BYTES))))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"Cannot read the time stamps {path}: {getattr(error, 'strerror', None) or error}.") from error
    header = list(rows[0]) if rows else []
    column = next((name for name in TIME_COLUMNS if name in header), None)
    if column is None:
        raise InputError(f"{path} has no time stamps; it must be a CSV with the columns view,time_s and a row for every image.")
    of_view = next((name for name in VIEW_COLUMNS if name in header), None)
    if of_view is not None:
        names = {view, view.rsplit("_", 1)[-1]}
        rows = [row for row in rows if row[of_view] in names]
    try:
        times = np.array([float(row[column]) for row in rows], dtype=np.float64)
        if ORDER_COLUMN in header:
            order = np.unique([int(row[ORDER_COLUMN]) for row in rows], return_index=True)[1]
            if len(order) < len(times):
                raise InputError(f"{path} has two time stamps of one image of view {view}; remove one of them.")
            times = times[order]
    except (TypeError, ValueError) as error:
        raise InputError(f"{path} has a row of view {view} that is not a number in “{column}”; correct it.") from error
    if len(times) < 2 or not np.isfinite(times).all() or np.abs(times).max() > 1e12:
        raise InputError(f"{path} has no usable time stamps of view {view}; it needs finite seconds in “{column}” for two images or more.")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise InputError(f"The time stamps of view {view} in {path} do not increase after image {back[0]}; correct them.")
    return times
