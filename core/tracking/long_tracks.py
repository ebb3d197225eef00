"""Trajectories of recordings that are too long for one table in memory: they are filtered in stretches, with bounded memory.

A stretch is a run of frames with all points visible in it. It overlaps with the next by twice a margin, so that the filters have the frames
before and after; the result of each frame is taken from one stretch. Results are written to a temporary file cell by cell, a cell being a
point in a frame. At the end every trajectory gets a column of the table, which is written row by row, again to temporary files. Where the
table would be too large, trajectories that do not overlap in time share columns, the longest first (`Trajectories.track` identifies them);
those for which there is no room are left out and counted.

A trajectory that is false in most of the frames of a stretch is removed there, but not from the stretches before and after.
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
from .trajectories import Filtered, FramePositions, Kinematics, Trajectories, assembled, differences, positions_of, smoothed

STRETCH_CELLS = 500_000  # frames times trajectories of a stretch: filtering it takes about 0.3 GB
TABLE_CELLS = 4_000_000  # frames times columns of the table that is written
MARGIN_FRAMES = 20  # twice the longest span of the filters
CELLS_AT_ONCE = 100_000  # whose velocities are computed at once
CELL = np.dtype([("row", "<i4"), ("track", "<i4"), ("piece", "<i8"), ("xyz_m", "<f4", 3), ("sigma_m", "<f4"), ("status", "i1")])
NO_PIECE = -1  # of a cell that the filters removed

Decide = Callable[[Trajectories, range], tuple[Filtered, np.ndarray]]
"""Filters raw trajectories; also returns the columns that the user removed by clicks in a range of rows."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Stretch:
    """Consecutive frames; the results of the rows `own` are taken from this stretch."""

    frames: list[FramePositions]
    own: range
    whole: bool  # it is the whole recording


def in_stretches(steps: Iterable[TrackedFrame], margin: int, most_cells: int = STRETCH_CELLS) -> Iterator[Stretch]:
    """A recording in stretches of about `most_cells` cells."""
    frames, identity, own, first = list[FramePositions](), np.zeros(0, dtype=np.int64), 0, True
    for step in steps:
        frames.append(positions_of(step))
        identity = np.union1d(identity, step.identity)
        end = len(frames) - margin
        if len(frames) * len(identity) > most_cells and end > own + margin:
            yield Stretch(frames=frames, own=range(own, end), whole=False)
            frames, own, first = frames[end - margin :], margin, False
            identity = np.unique(np.concatenate([f.identity for f in frames]))
    yield Stretch(frames=frames, own=range(own, len(frames)), whole=first)


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
        raw, identity = assembled(stretch.frames, fps, settings.smooth_frames if stretch.whole else 0)
        filtered, removed = decide(raw, stretch.own)
        if stretch.whole:
            return filtered, Counter(filtered.reason.tolist())
        cells.add(filtered, identity, stretch.own, identity[removed])
        del raw, filtered  # before the next stretch is assembled
    return cells.tables(fps, settings.smooth_frames, table_cells), cells.reasons


@dataclass(kw_only=True)
class _Extents:
    """First and last row of everything that has a number, and its length in cells."""

    parts: list[np.ndarray] = field(default_factory=list)  # (M, 4) int64

    def add(self, number: np.ndarray, row: np.ndarray) -> None:
        """Numbers (n,) in rows (n,), which ascend."""
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
    """The results of the stretches, cell by cell, in the order of the rows."""

    def __init__(self) -> None:
        self._file, self._ends = _temporary(), [0]  # in cells
        self._frames: list[np.ndarray] = []
        self._tracks, self._pieces = _Extents(), _Extents()
        self._open: dict[int, tuple[int, bool]] = {}  # by identity: false frames so far, and whether the last was measured
        self._removed: set[int] = set()
        self.reasons: Counter[int] = Counter()

    def add(self, filtered: Filtered, identity: np.ndarray, own: range, removed: np.ndarray) -> None:
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
        self._removed |= set(removed.tolist())
        self._tracks.add(part["track"].astype(np.int64), part["row"].astype(np.int64))
        of_piece = part[part["piece"] != NO_PIECE]
        self._pieces.add(of_piece["piece"], of_piece["row"].astype(np.int64))
        ends = there[rows].any(axis=0) & ~there[own.stop :].any(axis=0)
        self.reasons.update(filtered.reason[ends].tolist())

    def _numbered(self, raw: Trajectories, there: np.ndarray, identity: np.ndarray, own: range) -> np.ndarray:
        """Numbers (len(own), N) of the pieces to which each cell belongs, or which end there."""
        states = [self._open.get(int(i), (0, False)) for i in identity]
        false, kept = np.array([s[0] for s in states], dtype=np.int64), np.array([s[1] for s in states], dtype=bool)
        measured = raw.visible & (raw.status == TrackStatus.MEASURED)
        piece = np.full((len(own), len(identity)), NO_PIECE, dtype=np.int64)
        for i, t in enumerate(own):
            here = there[t] & (measured[t] | kept)
            piece[i, here] = identity[here] << 32 | false[here]
            false += there[t] & ~measured[t]
            kept = np.where(there[t], measured[t], kept)
        unfinished = np.flatnonzero(there[max(own.stop - MARGIN_FRAMES, 0) :].any(axis=0))
        self._open = {int(identity[n]): (int(false[n]), bool(kept[n])) for n in unfinished}
        return piece

    def tables(self, fps: float, smooth_frames: int, most_cells: int) -> Filtered:
        """The trajectories in columns."""
        frames = np.concatenate(self._frames)
        tracks, pieces = self._tracks.merged(), self._pieces.merged()
        pieces = pieces[~np.isin(pieces[:, 0] >> 32, list(self._removed))]
        shared = len(frames) * max(len(tracks), len(pieces)) > most_cells
        own = [in_columns(e, len(frames), most_cells) if shared else np.arange(len(e)) for e in (tracks, pieces)]
        raw = self._table(frames, fps, "track", tracks[:, 0], own[0], shared, smooth_frames=0)
        kept = self._table(frames, fps, "piece", pieces[:, 0], own[1], shared, smooth_frames=smooth_frames)
        at = np.searchsorted(tracks[:, 0], pieces[:, 0] >> 32)
        return Filtered(kept=kept, source=np.full(kept.xyz_m.shape[1], -1) if shared else at, raw=raw)

    def _table(
        self, frames: np.ndarray, fps: float, name: str, number: np.ndarray, column: np.ndarray, shared: bool, smooth_frames: int
    ) -> Trajectories:
        N, gone = int(column.max(initial=-1)) + 1, list(self._removed)
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
    """Columns (M,), −1 where there is no room, for extents (M, 4): number, first row, last row and length. The longest come first.

    Between two that share a column there is at least one frame.
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
    """Velocities and accelerations of a table, some rows at a time: raw and smoothed (raw as well if `smooth_frames` is 0)."""
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
    tables = [Kinematics(**{name: table.mapped() for name, table in rows.items()}) for rows in made]
    return tables[0], tables[-1]


class _Rows:
    """A table in a temporary file, to which rows are appended."""

    def __init__(self, row: tuple[int, ...], kind: str) -> None:
        self._file, self._row, self._kind, self._count = _temporary(), row, np.dtype(kind), 0

    def empty(self, count: int, value: float) -> np.ndarray:
        """`count` rows of one value."""
        return np.full((count, *self._row), value, dtype=self._kind)

    def append(self, rows: np.ndarray) -> None:
        """Write rows."""
        with _room():
            self._file.write(np.ascontiguousarray(rows, dtype=self._kind).tobytes())
        self._count += len(rows)

    def mapped(self) -> np.ndarray:
        """All rows, read on access."""
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
