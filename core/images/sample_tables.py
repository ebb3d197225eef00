"""How many samples (images, pieces of sound) the tables of an MP4 or QuickTime file claim, counted before FFmpeg makes an entry of 24 bytes
for each (ISO/IEC 14496-12): a table of 20 bytes may claim four thousand million of one size, and an edit list repeats them.

Boxes are looked for wherever FFmpeg does, which is also where none belong.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np

CONTAINERS = frozenset(
    b"avss dinf edts gmhd grpl hoov iprp mdia minf moof moov mvex schi sinf stbl traf trak tref udta wave".split()
)  # whose content FFmpeg reads as boxes
HIDDEN = (b"hoov", b"free", b"skip")  # which it takes for a `moov` box where they begin like one
SEARCHED = (b"stsd", b"meta", b"ipco", b"jp2h", b"ilst")  # and after heads of many lengths
DEEPEST = 16  # boxes in each other; FFmpeg reads no more than ten
PIECE = 1 << 16  # entries that are read at once
LARGEST_SEARCHED = 1 << 20  # bytes
DURATION, SIZE, FLAGS, OFFSET = 0x100, 0x200, 0x400, 0x800  # what a fragment's table (`trun`) has for each sample
FIRST_OFFSET, FIRST_FLAGS = 0x1, 0x4  # and once


@dataclass(slots=True)
class _Track:
    samples: int = 0
    chunks: int = 0
    edits: int = 1
    runs: list[tuple[int, int]] = field(default_factory=list)  # first chunk, from 1, and samples in each chunk from there on

    def total(self) -> int:
        """How many samples it has at most, as often as its edits may show them."""
        ends = [*(first for first, _ in self.runs[1:]), self.chunks + 1]
        in_chunks = sum(each * max(min(end, self.chunks + 1) - first, 0) for (first, each), end in zip(self.runs, ends))
        return max(self.samples, in_chunks) * self.edits


def claimed_samples(file: BinaryIO, size: int) -> int:
    """The samples of all tracks of a file of `size` bytes.

    Raises:
        ValueError: a table claims more entries than it has, or the tables are compressed.
    """
    tracks = [_Track()]
    _walk(file, 0, size, tracks, 0)
    return sum(track.total() for track in tracks)


def _walk(file: BinaryIO, at: int, end: int, tracks: list[_Track], depth: int) -> None:
    """Count what is in the boxes from `at` to `end`."""
    while at + 8 <= end:
        file.seek(at)
        head = file.read(24)
        length, kind, start = int.from_bytes(head[:4], "big"), head[4:8], at + 8
        if length == 1:
            length, start = int.from_bytes(head[8:16], "big"), at + 16
        stop = min(at + length, end) if length else end
        if stop < start:
            return
        if kind == b"cmov":
            raise ValueError("its tables are compressed")
        if kind == b"trak":
            tracks.append(_Track())
        if kind in TABLES:
            _count(file, kind, start, stop, tracks[-1])
        elif depth < DEEPEST and (kind in CONTAINERS or kind in HIDDEN and head[start - at + 4 : start - at + 8] in (b"mvhd", b"cmov")):
            _walk(file, start, stop, tracks, depth + 1)
        elif kind in SEARCHED:
            _search(file, start, stop, tracks)
        at = stop


def _search(file: BinaryIO, start: int, stop: int, tracks: list[_Track]) -> None:
    """Count what is in the tables anywhere from `start` to `stop`."""
    file.seek(start)
    data = file.read(min(stop - start, LARGEST_SEARCHED))
    for kind in (*TABLES, b"cmov"):
        at = data.find(kind, 4)
        while at >= 0:
            if kind == b"cmov":
                raise ValueError("its tables are compressed")
            length = int.from_bytes(data[at - 4 : at], "big")
            _count(file, kind, start + at + 4, min(start + at - 4 + length, stop) if length else stop, tracks[-1])
            at = data.find(kind, at + 4)


def _count(file: BinaryIO, kind: bytes, start: int, stop: int, track: _Track) -> None:
    file.seek(start)
    body = file.read(min(max(stop - start, 0), 16))
    if len(body) >= 8:
        TABLES[kind](_Table(file, start, stop, body), track)


@dataclass(frozen=True, slots=True)
class _Table:
    """A table of a track: version and flags, and then numbers."""

    file: BinaryIO
    start: int
    stop: int
    head: bytes  # its first 8 to 16 bytes

    def number(self, at: int) -> int:
        """The number of four bytes there.

        Raises:
            ValueError: the table is shorter.
        """
        if at + 4 > len(self.head):
            raise ValueError("a table is cut")
        return int(struct.unpack(">I", self.head[at : at + 4])[0])

    def check(self, count: int, entry_bits: int, at: int) -> None:
        """Check that entries from `at` on fit into it.

        Raises:
            ValueError: they do not.
        """
        if count * entry_bits > 8 * (self.stop - self.start - at):
            raise ValueError("a table claims more entries than it has")

    def entries(self, width: int, each: Callable[[np.ndarray], None]) -> None:
        """Pass the entries of `width` numbers to a function, some at a time."""
        count = self.number(4)
        self.check(count, 32 * width, 8)
        self.file.seek(self.start + 8)
        for first in range(0, count, PIECE):
            data = self.file.read(4 * width * min(PIECE, count - first))
            each(np.frombuffer(data[: len(data) // (4 * width) * 4 * width], dtype=">u4").reshape(-1, width).astype(np.int64))


def _sizes(table: _Table, track: _Track) -> None:
    count = table.number(8)
    if not table.number(4):
        table.check(count, 32, 12)
    track.samples = max(track.samples, count)


def _small_sizes(table: _Table, track: _Track) -> None:
    count = table.number(8)
    table.check(count, table.number(4) & 255, 12)
    track.samples = max(track.samples, count)


def _times(table: _Table, track: _Track) -> None:
    total = 0

    def add(rows: np.ndarray) -> None:
        nonlocal total
        total += int(rows[:, 0].sum())

    table.entries(2, add)
    track.samples = max(track.samples, total)


def _runs(table: _Table, track: _Track) -> None:
    track.runs = []
    table.entries(3, lambda rows: track.runs.extend(zip(rows[:, 0].tolist(), rows[:, 1].tolist())))


def _chunks(table: _Table, track: _Track) -> None:
    track.chunks = max(track.chunks, table.number(4))


def _edits(table: _Table, track: _Track) -> None:
    count = table.number(4)
    table.check(count, 160 if table.head[0] == 1 else 96, 8)
    track.edits = max(track.edits, count)


def _fragment(table: _Table, track: _Track) -> None:
    flags, count = table.number(0), table.number(4)
    once = 4 * (bool(flags & FIRST_OFFSET) + bool(flags & FIRST_FLAGS))
    table.check(count, 32 * sum(bool(flags & one) for one in (DURATION, SIZE, FLAGS, OFFSET)), 8 + once)
    track.samples += count


TABLES: dict[bytes, Callable[[_Table, _Track], None]] = {
    b"stsz": _sizes, b"stz2": _small_sizes, b"stts": _times, b"ctts": _times, b"stsc": _runs, b"stco": _chunks, b"co64": _chunks,
    b"elst": _edits, b"trun": _fragment,
}  # fmt: skip
