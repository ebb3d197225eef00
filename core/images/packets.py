"""What the packets of a movie say of its pictures, where the decoder is silent: it scales all pictures to the size of the first, and of
pictures that are marked as interlaced it returns what happens to be in memory (OpenCV 4.13 and 5.0, whose libswscale refuses them).

The packets are read beside the decoder, without being decoded. Their headers: JPEG (ITU-T T.81), H.264 (ITU-T H.264, 7.3.2.1.1), HEVC
(ITU-T H.265, 7.3.2.2), ProRes (SMPTE RDD 36), VP8 (RFC 6386). In other codecs a change of size is not noticed.
"""

import re
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from .headers import claimed_size

Size = tuple[int, int]  # width and height in pixels
Header = tuple[Size, bool]  # and whether pictures may be interlaced
HIGH_PROFILES = (44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244)  # whose sequence headers have a format of colours
START = re.compile(rb"\x00\x00\x01")
H264 = ("avc1", "avc3", "h264", "H264", "x264", "X264", "\x1b\0\0\0")
HEVC = ("hvc1", "hev1", "hevc", "HEVC", "H265", "\x24\0\0\0")
FIELDS = ("dvsd", "dvcp", "dvh1", "mpg2", "mp2v", "\x02\0\0\0")  # DV and MPEG-2, which mark nearly all pictures as interlaced
MOST_HEADER = 4096  # bytes of a sequence header that are looked at
CLEARLY_MORE = 8  # pictures beyond those of the header: a few may be stored twice, or be empty
REORDERED = 16  # packets by which a codec may store a picture before those that are shown earlier


class Packets:
    """The sizes of a movie's pictures, by frame, whether they may be marked as interlaced, and when they are shown."""

    def __init__(self, path: Path) -> None:
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
        code = int(self._capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF if self._capture.isOpened() else 0
        name = struct.pack("<I", code).decode("latin-1")
        self._header_in = _reader(name)
        self._fields = name in FIELDS
        self._next = 0
        self._changes: list[tuple[int, Size]] = []
        self._stamps_ms: list[float] = []

    @property
    def may_be_interlaced(self) -> bool:
        """Whether pictures that were looked at so far may be marked so."""
        return self._fields

    def at(self, frame: int) -> tuple[int, Size] | None:
        """The frame from which on the pictures have the size of those of `frame`, and that size; None if it is not known."""
        self._read(frame)
        return next((change for change in reversed(self._changes) if change[0] <= frame), None)

    def stamps_ms(self, count: int) -> np.ndarray:
        """When the first pictures (count,) are shown, increasing; none where the movie has no such times."""
        self._read(count - 1 + REORDERED)
        stamps = np.sort(self._stamps_ms)[:count]
        return stamps if (np.diff(stamps) > 0).all() else np.zeros(0)

    def exceed(self, count: int) -> bool:
        """Whether clearly more than so many pictures are stored."""
        self._read(count + CLEARLY_MORE)
        return self._next > count + CLEARLY_MORE

    def _read(self, frame: int) -> None:
        while self._next <= frame and self._capture.isOpened():
            more, packet = self._capture.read()
            if not more:
                self._capture.release()
                break
            self._stamps_ms.append(float(self._capture.get(cv2.CAP_PROP_POS_MSEC)))
            found = self._header_in(np.asarray(packet).tobytes())
            if found is not None:
                self._fields |= found[1]
                if not self._changes or found[0] != self._changes[-1][1]:
                    self._changes.append((self._next, found[0]))
            self._next += 1


def _reader(code: str) -> Callable[[bytes], Header | None]:
    """What finds the header in a packet of that codec; None where there is none."""
    if code in H264:
        return lambda packet: _in_stream(packet, 7, lambda first: first & 31, _h264)
    if code in HEVC:
        return lambda packet: _in_stream(packet, 33, lambda first: first >> 1 & 63, _hevc)
    return _of_picture


def _of_picture(packet: bytes) -> Header | None:
    """The header of a packet that is a picture with one of its own."""
    if packet.startswith(b"\xff\xd8\xff"):
        size = claimed_size(packet)
        return None if size is None else (size, False)
    if packet[4:8] == b"icpf" and len(packet) > 20:
        w, h = struct.unpack(">HH", packet[16:20])
        return (w, h), bool(packet[20] & 0x0C)
    if packet[3:6] == b"\x9d\x01\x2a" and len(packet) >= 10 and not packet[0] & 1:
        w, h = struct.unpack("<HH", packet[6:10])
        return (w & 0x3FFF, h & 0x3FFF), False
    return None


def _in_stream(packet: bytes, kind: int, kind_of: Callable[[int], int], parse: Callable[["_Bits"], Header]) -> Header | None:
    """The last sequence header among the units of a packet."""
    found = None
    for match in START.finditer(packet):
        at = match.end()
        if at < len(packet) and kind_of(packet[at]) == kind:
            try:
                found = parse(_Bits(packet[at : at + MOST_HEADER].replace(b"\0\0\3", b"\0\0")))
            except IndexError:  # it is damaged, as the decoder will tell
                continue
    return found


class _Bits:
    """Bits of a sequence header, from the first on."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, count: int) -> int:
        """The next `count` bits as a number.

        Raises:
            IndexError: there are not so many.
        """
        value = 0
        for at in range(self._at, self._at + count):
            value = value << 1 | self._data[at >> 3] >> (7 - (at & 7)) & 1
        self._at += count
        return value

    def number(self) -> int:
        """The next number ue(v), coded as by Exp-Golomb (H.264, 9.1)."""
        zeros = 0
        while not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)

    def signed(self) -> int:
        """The next number se(v)."""
        value = self.number()
        return (value + 1) // 2 if value & 1 else -(value // 2)


def _h264(bits: _Bits) -> Header:
    bits.take(8)
    profile = bits.take(8)
    bits.take(16)
    bits.number()
    colours = _h264_format(bits) if profile in HIGH_PROFILES else 1
    bits.number()
    order = bits.number()
    if order == 0:
        bits.number()
    elif order == 1:
        bits.take(1)
        bits.signed(), bits.signed()
        [bits.signed() for _ in range(bits.number())]
    bits.number()
    bits.take(1)
    columns, rows, whole = bits.number() + 1, bits.number() + 1, bits.take(1)
    bits.take(1 if whole else 2)
    across, down = (2 if colours in (1, 2) else 1), (2 if colours == 1 else 1) * (2 - whole)
    return _cropped(bits, 16 * columns, 16 * rows * (2 - whole), across, down), not whole


def _h264_format(bits: _Bits) -> int:
    """The format of the colours; all up to the end of the scaling matrices is passed."""
    colours = bits.number()
    if colours == 3:
        bits.take(1)
    bits.number(), bits.number()
    bits.take(1)
    if bits.take(1):
        for i in range(12 if colours == 3 else 8):
            if bits.take(1):
                _pass_scaling(bits, 16 if i < 6 else 64)
    return colours


def _pass_scaling(bits: _Bits, size: int) -> None:
    last, following = 8, 8
    for _ in range(size):
        if following:
            following = (last + bits.signed()) % 256
        last = following or last


def _hevc(bits: _Bits) -> Header:
    bits.take(16 + 4)
    layers = bits.take(3)
    bits.take(1 + 96)
    parts = [(bits.take(1), bits.take(1)) for _ in range(layers)]
    bits.take(2 * (8 - layers) if layers else 0)
    for profile, level in parts:
        bits.take(88 * profile + 8 * level)
    bits.number()
    colours = bits.number()
    if colours == 3:
        bits.take(1)
    w, h = bits.number(), bits.number()
    return _cropped(bits, w, h, 2 if colours in (1, 2) else 1, 2 if colours == 1 else 1), False


def _cropped(bits: _Bits, w: int, h: int, across: int, down: int) -> Size:
    """The size less what is cut off, of which the next bits tell."""
    if bits.take(1):
        left, right, top, bottom = (bits.number() for _ in range(4))
        w, h = w - across * (left + right), h - down * (top + bottom)
    return w, h
