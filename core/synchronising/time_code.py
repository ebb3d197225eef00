"""The time code of a movie's first image, from the `tmcd` track of an MP4 or QuickTime file.

OpenCV and Blender do not read it. The file is a tree of atoms, each with its size and kind in front (ISO/IEC 14496-12, 4.2). Below
moov/trak/mdia, a track of time codes has the handler `tmcd`; its sample description gives the rate and the way of counting (QuickTime File
Format, “Timecode sample description”); its first sample, somewhere in the file, is the number of frames since midnight, as 32 bits. With
drop-frame counting it is the number of frames that really passed, so that in both cases

    t = number · (frame duration / time scale)                                                   (1)

Other containers (AVI, MXF, MPEG) and the user data of cameras are not read.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from ..foundation import bounded
from ..foundation.errors import InputError

DAY_S = 86400.0
MOST_ATOMS = 20_000  # of a file
MOST_TABLE = 4096  # bytes of a description or a table of places that are read
DEEPER = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
DROP_FRAME = 1
FASTEST, SLOWEST = 1 / 1000, 1.0  # seconds per frame


@dataclass(frozen=True, kw_only=True, slots=True)
class TimeCode:
    """When the first image was taken, by the clock of the camera, in seconds since its midnight. `frame_s` is one unit of the code.

    `labelled` : the code counts at the nominal rate (29.97 as 30) without drop frames, and so runs slow by a thousandth.
    """

    first_s: float
    frame_s: float
    labelled: bool = False


def read_time_code(path: Path) -> TimeCode | None:
    """The time code of a movie; None where it has none, or is in another container.

    Raises:
        InputError: the movie cannot be opened.
    """
    try:
        with bounded.opened(path, bounded.MOVIE_BYTES) as file:
            return _of_file(file)
    except OSError as error:
        raise InputError(f"Cannot read the movie {path}: {error.strerror or error}.") from error


@dataclass(slots=True)
class _Track:
    is_code: bool = False
    description: bytes = b""
    place: int | None = None


def _of_file(file: BinaryIO) -> TimeCode | None:
    size = file.seek(0, 2)
    tracks: list[_Track] = []
    for kind, start, end in _atoms(file, 0, size, 0, [MOST_ATOMS]):
        if kind == b"trak":
            tracks.append(_Track())
        elif tracks and kind in (b"hdlr", b"stsd", b"stco", b"co64"):
            _note(tracks[-1], kind, _bytes_at(file, start, min(end - start, MOST_TABLE)))
    codes = [code for track in tracks if track.is_code and (code := _of_track(file, track, size)) is not None]
    return codes[0] if codes else None


def _atoms(file: BinaryIO, start: int, end: int, depth: int, left: list[int]) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of the content of the atoms in a part of a file, those inside DEEPER after their parent; what is damaged ends
    the list."""
    while start + 8 <= end and left[0] > 0:
        left[0] -= 1
        length, kind = struct.unpack(">I4s", _bytes_at(file, start, 8).ljust(8, b"\0"))
        head = 8
        if length == 1:
            length, head = struct.unpack(">Q", _bytes_at(file, start + 8, 8).ljust(8, b"\0"))[0], 16
        last = end if length == 0 else start + length
        if last > end or last < start + head:
            return
        yield kind, start + head, last
        if kind in DEEPER and depth < len(DEEPER):
            yield from _atoms(file, start + head, last, depth + 1, left)
        start = last


def _bytes_at(file: BinaryIO, start: int, count: int) -> bytes:
    file.seek(start)
    return file.read(count)


def _note(track: _Track, kind: bytes, data: bytes) -> None:
    """Keep what an atom says of its track."""
    if kind == b"hdlr":
        track.is_code = track.is_code or data[8:12] == b"tmcd"
    elif kind == b"stsd" and data[12:16] == b"tmcd":
        track.description = data[8:]
    elif kind in (b"stco", b"co64"):
        width = 4 if kind == b"stco" else 8
        if len(data) >= 8 + width and int.from_bytes(data[4:8], "big") > 0:
            track.place = int.from_bytes(data[8 : 8 + width], "big")


def _of_track(file: BinaryIO, track: _Track, size: int) -> TimeCode | None:
    """(1)"""
    if len(track.description) < 33 or track.place is None or not 0 <= track.place <= size - 4:
        return None
    flags, scale, duration, per_second = struct.unpack(">IIIB", track.description[20:33])
    if not scale or not FASTEST <= duration / scale <= SLOWEST or not per_second:
        return None
    frame_s = duration / scale
    first_s = int.from_bytes(_bytes_at(file, track.place, 4), "big") * frame_s
    if first_s >= 2 * DAY_S:
        return None
    exact = abs(per_second * frame_s - 1) < 1e-6
    return TimeCode(first_s=first_s, frame_s=frame_s, labelled=not exact and not flags & DROP_FRAME)


def started_after(a: TimeCode, b: TimeCode) -> float | None:
    """By how many seconds the movie with code `b` began after that with `a`, within half a day; None where the codes cannot be compared.

    They cannot where both are 0, as in cameras whose clock was never set, or where one counts at a nominal rate and the other does not.
    """
    if a.first_s == b.first_s == 0 or a.labelled != b.labelled or (a.labelled and abs(a.frame_s / b.frame_s - 1) > 1e-6):
        return None
    return (b.first_s - a.first_s + DAY_S / 2) % DAY_S - DAY_S / 2
