"""What the packets of a movie say where the decoder is silent: pictures that change their size, and pictures marked as interlaced."""

import struct
import zlib
from base64 import b64decode
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.images import packets
from tricap.core.images.packets import Packets, _reader
from tricap.core.images.sequence import Movie, open_sequence

# sequence headers as x264 and x265 write them, after the units' start: codec, header, width, height, whether pictures may be interlaced
HEADERS = [
    ("avc1", "67640028acd940780227e5c044000003000400000300c83c60c658", 1920, 1080, False),
    ("h264", "67640028acd94078044fde0220000003002000000643e2c5b2c0", 1920, 1080, True),
    ("h264", "677a0028bcd94078044fcb808800000300080000030190f8b16cb0", 1920, 1080, True),  # 4:2:2
    ("h264", "6764000bacd94344f9623011000003000100000300320f142996", 200, 130, False),
    ("hvc1", "4201010408000003009e0800000300007890007810021ceef2cacd24995e02d0100000030010000003019080", 1918, 1078, False),  # 4:4:4
    ("hevc", "42010101600000030090000003000003003ca01920227c996566924caf016808000003000800000300c840", 200, 130, False),
]
# a movie of 48×32 pixels and three frames, encoded as interlaced by x264
INTERLACED = (
    "eNpjYGBQSCupLMgszs9lYGBiANFAbJRYlmyYW2BiyMDAbJ6bn1/GwMCQk1uWkcKAAphfAIkKBkYGEEIARlRV6HwHBryACYjaSooSs4HsmJJssJ3MWEyrwNBJ"
    "jL0GQKwA5qqkppQUA2mZ1JziEiQdQHNZoHoZ/+WmZCaCdOSmoPvdCIjZGEKPgDm6GSk5RTCZssyUVGSVYUB+vkdiXkpOKkgN48rczLw0IEOkLBdsKLIzVVIg"
    "cjIpRalpSI7iKS3KUYCwGTOLS5JygOy9xSXFKUhq1oIiDUdQgDyuwOABpD1gKnh8gOoVcjKTKozMTLBFhMT//0DSGKjKmTGFQfT/QwaxdCC95qbfDY4GUJwA"
    "CUn+LpHTjAxsGb8XPNmk8/fHD5BGgYLE4gKoI0BYJKmkCBrC0W8hmEGiuAQc+jDHMoMjHqgW6ClkcRDWSEaoZYaIsUDl2aA0WK8MUG8yml6oegYFoFwVctIF"
    "CnsBaW5Q4ELsTc5H6GVOB9K2pSkloNg3zU0F0yCgiBzTwNRRlFhQkIMcahyZkOTEkVaUmgqKrdyURCCf0S21o4mb//+Zyd9yd5xL/f/NJ9zF8UfYH63nsYxM"
    "LEfe6t32uxlTlWRzsSpWa5/q1HOvf7ko6Cu/lreVDb1eePpT3ez61O2hLO8K5gYa92gFvZjlfiS9YENkeEhyuC3X+z2PnRUmuDG3PrOJOszGUS6o+SWp9aqP"
    "iXPisVtP28yYW2sv5meWP7W7lvkvP3vplY1+XeIr6s8Yce1OyinJZwyum3NDRexp6+rM5L7O++VtovpG5vd7irf1z31cevFvxfGI9gx5Z6e9nZYL57r5y8+b"
    "wbRU48KlGzIz569eb6H9Kl3t5gK3H7s//2+1cfi7t69tf5h/4nI/awaZ9+vvlDD4WhScn8lUVXK17NBeY8/dccuFejTWZ3hsVXuyQSls61nLQyHX+BZbvrkw"
    "75TKofv+DWcl1iwJUrBVvXVM/M49ZTOWh2ZOFbZ8WTwpDiczTl9quOdaWQkMWXbHWYpx9eWg7MzBOM/h/qT6Y40AIMwU8A=="
)


def avi(path: Path, sizes: list[tuple[int, int]]) -> Path:
    """A movie of JPEG pictures of those sizes; its header has the first."""
    (w, h), n, movie, index = sizes[0], len(sizes), b"", b""
    for i, size in enumerate(sizes):
        picture = np.random.default_rng(i).integers(0, 255, (size[1], size[0]), dtype=np.uint8)
        data = cv2.imencode(".jpg", picture)[1].tobytes()
        index += struct.pack("<4sIII", b"00dc", 16, 4 + len(movie), len(data))
        movie += struct.pack("<4sI", b"00dc", len(data)) + data + b"\0" * (len(data) % 2)

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack("<4sI", name, len(data)) + data

    head = chunk(b"avih", struct.pack("<14I", 40000, 0, 0, 16, n, 0, 1, 0, w, h, 0, 0, 0, 0))
    stream = struct.pack("<4s4sIHH8I4H", b"vids", b"MJPG", 0, 0, 0, 0, 1, 25, 0, n, 0, 0xFFFFFFFF, 0, 0, 0, w, h)
    kind = struct.pack("<IIIHH4s5I", 40, w, h, 1, 24, b"MJPG", 0, 0, 0, 0, 0)
    streams = chunk(b"LIST", b"strl" + chunk(b"strh", stream) + chunk(b"strf", kind))
    parts = chunk(b"LIST", b"hdrl" + head + streams) + chunk(b"LIST", b"movi" + movie) + chunk(b"idx1", index)
    path.write_bytes(chunk(b"RIFF", b"AVI " + parts))
    return path


def test_a_movie_whose_pictures_change_their_size_is_refused_from_there_on(tmp_path: Path) -> None:
    """The decoder scales them to the first size, so that they would fit no calibration."""
    path = avi(tmp_path / "m.avi", [(64, 48)] * 3 + [(128, 96)] * 2 + [(64, 48)])
    capture = cv2.VideoCapture(str(path))
    assert {capture.read()[1].shape for _ in range(6)} == {(48, 64, 3)}, "the decoder tells it now: is this module needed still?"
    movie = open_sequence(tmp_path, images=None, movie="m.avi", view="L")
    for frame in (4, 3):
        with pytest.raises(InputError, match=r"From frame 3 on, the pictures of .*m.avi have 128×96 pixels instead of 64×48. Leave out"):
            movie.read(frame)
    for frame in (2, 0, 5, 1):
        assert movie.read(frame).shape == (48, 64)
    sizes = Packets(path)
    assert [sizes.at(i) for i in (5, 4, 2, 900)] == [(5, (64, 48)), (3, (128, 96)), (0, (64, 48)), (5, (64, 48))]


@pytest.mark.parametrize(("code", "header", "w", "h", "interlaced"), HEADERS)
def test_sizes_in_the_headers_of_a_stream(code: str, header: str, w: int, h: int, interlaced: bool) -> None:
    data = bytes.fromhex(header)
    packet = b"\0\0\0\1\x06\xff\0\0\0\1" + data + b"\0\0\0\1\x68\xee"
    assert _reader(code)(packet) == ((w, h), interlaced)
    assert _reader(code)(b"\0\0\1\x65" + b"\x88" * 20) is None
    for length in range(1, len(data)):  # cut off: another size, or nothing; never another error
        _reader(code)(b"\0\0\1" + data[:length])


def test_sizes_in_the_headers_of_pictures() -> None:
    read = _reader("apch")
    prores = b"\0\0\1\0icpf\0\x94\0\0Lavc" + struct.pack(">HH", 1920, 1080)
    assert read(prores + b"\x84") == ((1920, 1080), True) and read(prores + b"\x80") == ((1920, 1080), False)
    assert read(b"\x10\0\0\x9d\x01\x2a" + struct.pack("<HH", 320 | 1 << 14, 240)) == ((320, 240), False)  # VP8, with a scale
    assert read(b"\x11\0\0") is None and read(b"") is None and read(b"\xff\xd8\xff") is None


def test_a_movie_marked_as_interlaced_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The decoder returns the same leftovers of memory for every frame."""
    path = tmp_path / "m.mp4"
    path.write_bytes(zlib.decompress(b64decode(INTERLACED)))
    with pytest.raises(InputError, match="m.mp4 is marked as interlaced, .*: ffmpeg -i m.mp4 -vf setfield=prog -c:v ffv1 new.mkv"):
        Movie(path)
    with pytest.raises(InputError, match="ffmpeg -i 'm;reboot .mp4' -vf"):  # the line is made to be copied
        Movie(path.rename(tmp_path / "m;reboot .mp4"))
    monkeypatch.setattr(packets, "FIELDS", ("MJPG",))
    assert Movie(avi(tmp_path / "n.avi", [(64, 48)] * 3)).read(2).shape == (48, 64), "frames that differ were decoded"
