"""What the header of an image file says of the memory and work that it takes, before it is decoded."""

import struct
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.images.headers import claimed_size, memory_bytes
from tricap.core.images.picture import MAX_PIXELS, MOST_BYTES, decoded, read_image

from ...mutations import MEGABYTES, forget_the_most, memory_mb

WIDTH, HEIGHT = 8190, 4394  # nearly MAX_PIXELS
SHORT, LONG, SIGNED = 3, 4, 9  # types of a TIFF's values


def tiff(bits: int, samples: int, *, form: int = 1, rows: int = 16, colours: int = 1, kind: int = SHORT, **more: int) -> bytes:
    """A TIFF of WIDTH×HEIGHT zeros that consists of one compressed strip again and again; `more`: tags “t…”."""
    strip = zlib.compress(bytes(WIDTH * min(rows, HEIGHT) * samples * bits // 8))
    count = -(-HEIGHT // rows)
    tags = {256: [WIDTH], 257: [HEIGHT], 258: [bits] * samples, 259: [8], 262: [colours], 273: [0] * count, 277: [samples], 278: [rows],
            279: [len(strip)] * count, 284: [1], 338: [2] * (samples - 3), 339: [form] * samples}  # fmt: skip
    tags |= {int(tag[1:]): [value] for tag, value in more.items()}
    tags = {tag: values for tag, values in sorted(tags.items()) if values}
    end = 8 + 2 + 12 * len(tags) + 4
    tags[273] = [end + 8 * len(tags) * 4 + 8 * count] * count
    entries, rest = b"", b""
    for tag, values in tags.items():
        of_bits, code = (kind, {SHORT: "H", SIGNED: "i"}[kind]) if tag == 258 else (LONG, "I")
        data = struct.pack(f"<{len(values)}{code}", *values)
        entries += struct.pack("<HHI", tag, of_bits, len(values))
        entries += data.ljust(4, b"\0") if len(data) <= 4 else struct.pack("<I", end + len(rest))
        rest += data if len(data) > 4 else b""
    head = b"II*\0\x08\0\0\0" + struct.pack("<H", len(tags)) + entries + bytes(4) + rest
    return head.ljust(tags[273][0], b"\0") + strip


def png(bits: int, colours: int, *chunks: bytes, sound: bool = False) -> bytes:
    """A PNG of WIDTH×HEIGHT zeros; without its pixels if not `sound`."""
    row = 1 + WIDTH * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colours] * bits // 8
    packed = zlib.compress(bytes(row * HEIGHT if sound else 9))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", WIDTH, HEIGHT, bits, colours, 0, 0, 0))
    more = b"".join(chunk(kind, bytes(6)) for kind in chunks)
    return b"\x89PNG\r\n\x1a\n" + head + more + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


BOMBS = {
    "four float64 channels.tif": lambda: tiff(64, 4, form=3),
    "one float64 channel.tif": lambda: tiff(64, 1, form=3),
    "four float32 channels.tif": lambda: tiff(32, 4, form=3),
    "bits as signed numbers.tif": lambda: tiff(64, 4, form=3, kind=SIGNED),
    "a strip of all.tif": lambda: tiff(16, 3, rows=HEIGHT),
    "a strip of more than all.tif": lambda: tiff(8, 3, rows=4 * HEIGHT),
    "a tile of more than all.tif": lambda: tiff(8, 3, t322=16384, t323=16384),
    "logarithms.tif": lambda: tiff(16, 3, colours=32845),
    "four channels of 16 bits.png": lambda: png(16, 6),
    "grey and transparent.png": lambda: png(16, 4),
    "colours and transparent.png": lambda: png(16, 2, b"tRNS"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_does_not_unpack_to_gigabytes(tmp_path: Path, name: str) -> None:
    """The pixels are as many as may be, but of up to 32 bytes."""
    (tmp_path / name).write_bytes(BOMBS[name]())
    assert WIDTH * HEIGHT <= MAX_PIXELS and (tmp_path / name).stat().st_size < 1_000_000
    forget_the_most()
    before = memory_mb()[0]
    with pytest.raises(InputError, match=r"would unpack to [01]\.\d GB, more than 100 times its size; save it with 8 bits per channel"):
        read_image(tmp_path / name)
    assert memory_mb()[1] - before < 50


HONEST = {
    "rgba 8.png": lambda: png(8, 6, sound=True),
    "rgb 16.png": lambda: png(16, 2, sound=True),
    "grey 16.png": lambda: png(16, 0, sound=True),
    "rgba 8.tif": lambda: tiff(8, 4, colours=2, rows=HEIGHT),
    "rgb 8.tif": lambda: tiff(8, 3, colours=2, rows=HEIGHT),
    "rgb 16.tif": lambda: tiff(16, 3, colours=2),
    "grey 16.tif": lambda: tiff(16, 1, rows=HEIGHT),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HONEST)
def test_ordinary_images_of_36_megapixels_are_read_within_the_limits(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(HONEST[name]())
    forget_the_most()
    before, began = memory_mb()[0], time.process_time()
    assert read_image(tmp_path / name).shape == (HEIGHT, WIDTH)
    assert time.process_time() - began < 2.0 and memory_mb()[1] - before < MEGABYTES


def test_a_large_honest_file_may_unpack_to_more() -> None:
    """Four channels of 16 bits with the noise of a camera are no bomb: 0.3 GB that do not compress."""
    needed = memory_bytes(png(16, 6), (WIDTH, HEIGHT))
    assert MOST_BYTES < needed < 100 * 8 * WIDTH * HEIGHT / 50


GREY, RGB, RGBA = (24, 41), (24, 41, 3), (24, 41, 4)
SOUND = [
    *((".tif", shape, kind) for shape in (GREY, RGB, RGBA) for kind in ("uint8", "uint16", "float32", "float64")),
    *((".png", shape, kind) for shape in (GREY, RGB, RGBA) for kind in ("uint8", "uint16")),
    *((ending, shape, "uint8") for ending in (".jpg", ".bmp", ".webp") for shape in (GREY, RGB, RGBA)),
    *((ending, shape, kind) for ending, shape in ((".pgm", GREY), (".ppm", RGB)) for kind in ("uint8", "uint16")),
]


@pytest.mark.parametrize(("ending", "shape", "kind"), SOUND)
def test_the_memory_of_sound_images_is_not_underrated(tmp_path: Path, ending: str, shape: tuple[int, ...], kind: str) -> None:
    path = tmp_path / f"a{ending}"
    path.write_bytes(cv2.imencode(ending, np.ones(shape, kind))[1].tobytes())
    data, image = path.read_bytes(), decoded(path)
    assert memory_bytes(data, (41, 24)) >= image.nbytes + 4 * 24 * 41
    assert image.dtype == kind


def scans(count: int, width: int, height: int) -> bytes:
    """A progressive JPEG file with so many scans."""
    picture = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    at = picture.index(b"\xff\xc2")
    sized = picture[: at + 5] + struct.pack(">HH", height, width) + picture[at + 9 : -2]
    own = sized.count(b"\xff\xda")
    return sized + (count - own) * b"\xff\xda\x00\x08\x01\x01\x00\x01\x3f\x00" + b"\xff\xd9"


def test_scans_of_a_large_image_are_counted(tmp_path: Path) -> None:
    """99 of them passed over 36 megapixels for 3 s; of a small image as many may be there."""
    assert claimed_size(scans(27, WIDTH, HEIGHT)) == (WIDTH, HEIGHT)
    assert claimed_size(scans(99, 1920, 1080)) == (1920, 1080)
    assert claimed_size(scans(101, 8, 8)) is None
    (tmp_path / "a.jpg").write_bytes(scans(28, WIDTH, HEIGHT))
    with pytest.raises(InputError, match="is not a readable image"):
        read_image(tmp_path / "a.jpg")
