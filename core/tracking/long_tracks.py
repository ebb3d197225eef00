"""Trajectories of recordings that are too long to be looked at as one table: stretch after stretch, in memory that does not grow with them.

A stretch is a run of frames with all points that were seen in it. It overlaps with the next by twice a margin, so that the filters know on
both sides what comes before and after; each frame is decided on in one stretch. What was decided goes cell by cell (a point in a frame)
into a temporary file. At the end every trajectory gets a column of the table, in which it is written in rows, again to temporary files.
Where the table would be too large, trajectories that are apart in time share columns, the longest first (`Trajectories.track` tells them
apart); those that find no room are left out and counted.

A trajectory that is false in most of the frames of a stretch is removed there, and not from the stretches before and after.
"""

import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import IO, Any

import numpy as np

from ..foundation.errors import InputError
from ..images.interlace import frame_time_s
from .settings import TrackingSettings, TrackStatus
from .tracked import TrackedFrame
from .trajectories import Filtered, Kinematics, Seen, Trajectories, assembled, differences, seen_of, smoothed

STRETCH_CELLS = 500_000  # frames times trajectories of a stretch: filtering it takes about 0.3 GB
TABLE_CELLS = 4_000_000  # of the table that is written
MARGIN_FRAMES = 20  # twice the longest span of the filters
CELLS_AT_ONCE = 100_000  # whose velocities are found at once
CELL = np.dtype([("row", "<i4"), ("track", "<i4"), ("piece", "<i8"), ("xyz_m", "<f4", 3), ("sigma_m", "<f4"), ("status", "i1")])
NO_PIECE = -1

Decide = Callable[[Trajectories, range], tuple[Filtered, np.ndarray]]
"""Filters raw trajectories; of a range of rows it tells the columns that the user took out whole."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Stretch:
    """Consecutive frames, of which the rows `own` are decided on here."""

    seen: list[Seen]
    own: range
    whole: bool  # it is the recording


def in_stretches(steps: Iterable[TrackedFrame], margin: int, most_cells: int = STRETCH_CELLS) -> Iterator[Stretch]:
    """A recording in stretches of about so many cells."""
    seen, identity, own, first = list[Seen](), np.zeros(0, dtype=np.int64), 0, True
    for step in steps:
        seen.append(seen_of(step))
        identity = np.union1d(identity, step.identity)
        end = len(seen) - margin
        if len(seen) * len(identity) > most_cells and end > own + margin:
            yield Stretch(seen=seen, own=range(own, end), whole=False)
            seen, own, first = seen[end - margin :], margin, False
            identity = np.unique(np.concatenate([s[1] for s in seen]))
    yield Stretch(seen=seen, own=range(own, len(seen)), whole=first)


def trajectories_of(
    steps: Iterable[TrackedFrame],
    fps: float,
    settings: TrackingSettings,
    decide: Decide,
    stretch_cells: int = STRETCH_CELLS,
    table_cells: int = TABLE_CELLS,
) -> tuple[Filtered, Counter[int]]:
    """The filtered trajectories of consecutive tracked frames, and how many have each `Filtered.reason`.

    Raises:
        InputError: there is no room for a temporary file.
    """
    margin = max(MARGIN_FRAMES, settings.min_length, settings.smooth_frames)
    cells = _Cells()
    for stretch in in_stretches(steps, margin, stretch_cells):
        raw, identity = assembled(stretch.seen, fps, settings.smooth_frames if stretch.whole else 0)
        filtered, taken_out = decide(raw, stretch.own)
        if stretch.whole:
            return filtered, Counter(filtered.reason.tolist())
        cells.add(filtered, identity, stretch.own, identity[taken_out])
        del raw, filtered  # before the next is made
    return cells.tables(fps, settings.smooth_frames, table_cells), cells.reasons


@dataclass(kw_only=True)
class _Extents:
    """First and last row of what has a number, and its length in cells."""

    parts: list[np.ndarray] = field(default_factory=list)  # (M, 4) int64

    def add(self, number: np.ndarray, row: np.ndarray) -> None:
        """Numbers (n,) were found in rows (n,), in ascending rows."""
        key, first, back = np.unique(number, return_index=True, return_inverse=True)
        last = np.zeros(len(key), dtype=np.int64)
        np.maximum.at(last, back, row)
        self.parts.append(np.stack([key, row[first], last, np.bincount(back, minlength=len(key))], axis=1))

    def merged(self) -> np.ndarray:
        """(M, 4) number, first row, last row, length, by ascending numbers."""
        every = np.concatenate([np.zeros((0, 4), dtype=np.int64), *self.parts])
        key, first, back = np.unique(every[:, 0], return_index=True, return_inverse=True)
        last, length = np.zeros(len(key), dtype=np.int64), np.zeros(len(key), dtype=np.int64)
        np.maximum.at(last, back, every[:, 2])
        np.add.at(length, back, every[:, 3])
        return np.stack([key, every[first, 1], last, length], axis=1)


class _Cells:
    """What was decided, cell by cell, in the order of the rows."""

    def __init__(self) -> None:
        self._file, self._ends = _temporary(), [0]  # in cells
        self._frames: list[np.ndarray] = []
        self._tracks, self._pieces = _Extents(), _Extents()
        self._open: dict[int, tuple[int, bool]] = {}  # by identity: how often it was false so far, and whether it was kept at last
        self._taken_out: set[int] = set()
        self.reasons: Counter[int] = Counter()

    def add(self, filtered: Filtered, identity: np.ndarray, own: range, taken_out: np.ndarray) -> None:
        """The rows `own` of a stretch whose columns have these identities (N,)."""
        raw, rows = filtered.raw, slice(own.start, own.stop)
        there = raw.status != TrackStatus.ABSENT
        t, n = np.nonzero(there[rows])
        part = np.zeros(len(t), dtype=CELL)
        part["row"], part["track"] = t + sum(map(len, self._frames)), identity[n]
        part["piece"] = self._numbered(raw, there, identity, own)[t, n]
        part["xyz_m"], part["sigma_m"], part["status"] = raw.xyz_m[rows][t, n], raw.sigma_m[rows][t, n], raw.status[rows][t, n]
        with _room():
            self._file.seek(0, 2)
            self._file.write(part.tobytes())
        self._ends.append(self._ends[-1] + len(part))
        self._frames.append(raw.frames[rows])
        self._taken_out |= set(taken_out.tolist())
        self._tracks.add(part["track"].astype(np.int64), part["row"].astype(np.int64))
        of_piece = part[part["piece"] != NO_PIECE]
        self._pieces.add(of_piece["piece"], of_piece["row"].astype(np.int64))
        ends = there[rows].any(axis=0) & ~there[own.stop :].any(axis=0)
        self.reasons.update(filtered.reason[ends].tolist())

    def _numbered(self, raw: Trajectories, there: np.ndarray, identity: np.ndarray, own: range) -> np.ndarray:
        """Numbers (len(own), N) of the pieces that keep each cell, or that end there."""
        known = [self._open.get(int(i), (0, False)) for i in identity]
        false, kept = np.array([k[0] for k in known], dtype=np.int64), np.array([k[1] for k in known], dtype=bool)
        measured = raw.seen & (raw.status == TrackStatus.MEASURED)
        piece = np.full((len(own), len(identity)), NO_PIECE, dtype=np.int64)
        for i, t in enumerate(own):
            here = there[t] & (measured[t] | kept)
            piece[i, here] = identity[here] << 32 | false[here]
            false += there[t] & ~measured[t]
            kept = np.where(there[t], measured[t], kept)
        goes_on = np.flatnonzero(there[max(own.stop - MARGIN_FRAMES, 0) :].any(axis=0))
        self._open = {int(identity[n]): (int(false[n]), bool(kept[n])) for n in goes_on}
        return piece

    def tables(self, fps: float, smooth_frames: int, most_cells: int) -> Filtered:
        """The trajectories in columns."""
        frames = np.concatenate(self._frames)
        tracks, pieces = self._tracks.merged(), self._pieces.merged()
        pieces = pieces[~np.isin(pieces[:, 0] >> 32, list(self._taken_out))]
        shared = len(frames) * max(len(tracks), len(pieces)) > most_cells
        own = [in_columns(e, len(frames), most_cells) if shared else np.arange(len(e)) for e in (tracks, pieces)]
        raw = self._table(frames, fps, "track", tracks[:, 0], own[0], shared, smooth_frames=0)
        kept = self._table(frames, fps, "piece", pieces[:, 0], own[1], shared, smooth_frames=smooth_frames)
        at = np.searchsorted(tracks[:, 0], pieces[:, 0] >> 32)
        return Filtered(kept=kept, source=np.full(kept.xyz_m.shape[1], -1) if shared else at, raw=raw)

    def _table(
        self, frames: np.ndarray, fps: float, name: str, number: np.ndarray, column: np.ndarray, shared: bool, smooth_frames: int
    ) -> Trajectories:
        N, gone = int(column.max(initial=-1)) + 1, list(self._taken_out)
        tables = {"xyz_m": _Rows((N, 3), "<f4"), "sigma_m": _Rows((N,), "<f4"), "status": _Rows((N,), "i1"), "track": _Rows((N,), "<i4")}
        for (first, end), part in self._parts():
            part = part[np.isin(part[name], number)].copy()
            at = column[np.searchsorted(number, part[name])]
            part, at = part[at >= 0], at[at >= 0]
            part["status"][np.isin(part["track"], gone) & np.isfinite(part["sigma_m"])] = TrackStatus.REMOVED_BY_USER
            if name == "piece":
                beyond = part["status"] != TrackStatus.MEASURED
                part["xyz_m"][beyond] = part["sigma_m"][beyond] = np.nan
            for n, nothing in (("xyz_m", np.nan), ("sigma_m", np.nan), ("status", TrackStatus.ABSENT), ("track", -1)):
                rows = tables[n].empty(end - first, nothing)
                rows[part["row"] - first, at] = part[n]
                tables[n].append(rows)
        xyz, sigma, status, track = (r.mapped() for r in tables.values())
        raw, smooth = _kinematics(xyz, sigma, fps, frames, smooth_frames)
        return Trajectories(
            frames=frames,
            time_s=frame_time_s(frames, fps),
            xyz_m=xyz,
            velocity_m_s=raw.velocity_m_s,
            acceleration_m_s2=raw.acceleration_m_s2,
            sigma_m=sigma,
            status=status,
            raw=raw,
            smooth=smooth,
            track=track if shared else None,
            omitted=int((column < 0).sum()),
        )

    def _parts(self) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
        """The rows (first, end) and cells of each stretch."""
        first = 0
        for frames, begin, end in zip(self._frames, self._ends, self._ends[1:]):
            self._file.seek(begin * CELL.itemsize)
            yield (first, first + len(frames)), np.frombuffer(self._file.read((end - begin) * CELL.itemsize), dtype=CELL)
            first += len(frames)


def in_columns(extent: np.ndarray, frames: int, most_cells: int) -> np.ndarray:
    """Columns (M,), −1 where there is no room, for what has a number, a first and a last row and a length (M, 4), the longest first.

    Between two that share a column lies a frame at least.
    """
    taken = np.zeros((frames + 2, max(1, most_cells // frames)), dtype=bool)
    column = np.full(len(extent), -1)
    for i in np.argsort(-extent[:, 3], kind="stable"):
        _, first, last, _ = extent[i]
        free = ~taken[first : last + 3].any(axis=0)
        if free.any():
            column[i] = free.argmax()
            taken[first + 1 : last + 2, column[i]] = True
    return column


def _kinematics(
    xyz_m: np.ndarray, sigma_m: np.ndarray, fps: float, frames: np.ndarray, smooth_frames: int
) -> tuple[Kinematics, Kinematics]:
    """Velocities and accelerations of a table, some rows at a time: raw and smoothed (raw where nothing is smoothed)."""
    dt, margin = float(np.median(np.diff(frames))) / fps, max(2, smooth_frames)
    made = [{f.name: _Rows((xyz_m.shape[1], *((3,) if "sigma" not in f.name else ())), "<f4") for f in fields(Kinematics)}
            for _ in range(1 + bool(smooth_frames))]  # fmt: skip
    at_once = max(1, CELLS_AT_ONCE // max(1, xyz_m.shape[1]))
    for begin in range(0, len(frames), at_once):
        first, end = max(0, begin - margin), min(len(frames), begin + at_once + margin)
        xyz, sigma = xyz_m[first:end].astype(np.float64), sigma_m[first:end].astype(np.float64)
        for i, rows in enumerate(made):
            found = smoothed(xyz, sigma, dt, smooth_frames) if i else differences(xyz, sigma, dt)
            for name, table in rows.items():
                table.append(getattr(found, name)[begin - first : begin - first + at_once])
    given = [Kinematics(**{name: table.mapped() for name, table in rows.items()}) for rows in made]
    return given[0], given[-1]


class _Rows:
    """A table in a temporary file, to which rows are appended."""

    def __init__(self, row: tuple[int, ...], kind: str) -> None:
        self._file, self._row, self._kind, self._count = _temporary(), row, np.dtype(kind), 0

    def empty(self, count: int, value: float) -> np.ndarray:
        """So many rows of one value."""
        return np.full((count, *self._row), value, dtype=self._kind)

    def append(self, rows: np.ndarray) -> None:
        """Write rows."""
        with _room():
            self._file.write(np.ascontiguousarray(rows, dtype=self._kind).tobytes())
        self._count += len(rows)

    def mapped(self) -> np.ndarray:
        """All rows, read when they are asked for."""
        shape: Any = (self._count, *self._row)
        if 0 in shape:
            return np.zeros(shape, dtype=self._kind)
        with _room():
            self._file.flush()
            return np.memmap(self._file, dtype=self._kind, mode="r", shape=shape)


def _temporary() -> IO[bytes]:
    with _room():
        return tempfile.TemporaryFile()


@contextmanager
def _room() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        place = tempfile.gettempdir()
        raise InputError(f"Cannot write to {place}: {error.strerror or error}. Free some space there, or set TMPDIR.") from error
