"""What the header of an image file says before it is decoded: its size and the memory that it takes, for a small file must not unpack to
gigabytes, and its pages."""

import re
import struct

JPEG_FRAMES = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}  # the markers with the size
TIFF_KINDS = {1: ("B", 1), 3: ("H", 2), 4: ("I", 4), 16: ("Q", 8), 6: ("b", 1), 8: ("h", 2), 9: ("i", 4), 17: ("q", 8)}
MOST_SCANS = 100  # of a progressive JPEG, each of which passes over the whole image
MOST_SCANNED = 1_000_000_000  # pixels of an image times its scans: 27 scans of the largest image
MOST_ENTRIES = 4096  # of a TIFF directory
KIND, WIDTH, HEIGHT, BITS, COLOURS, SAMPLES, STRIP_ROWS, TILE_WIDTH, TILE_HEIGHT = TAGS = (254, 256, 257, 258, 262, 277, 278, 322, 323)
MOST_SAMPLES = 16  # bits of so many are looked at; all must have the same
WHOLE = (1 << 31) - 1  # from so many rows on, a strip is the whole image
GREY, LOGARITHMS = (0, 1), (32844, 32845)  # colours of a TIFF: one channel; and floats of 32 bits, however many bits it has
PNG_CHANNELS = {0: 1, 2: 3}  # by the kind of its colours; with transparency, or a palette, 4
GREY_BYTES = 4  # of a pixel as a grey value
REDUCED = 1  # bit of a TIFF directory's kind (tag 254): a preview of another image
ANIMATED = 2  # bit of a WebP's flags


def claimed_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) in the header of an image file; None if it is damaged or of an unknown kind."""
    for first, reader in READERS:
        if data.startswith(first):
            try:
                return reader(data)
            except (struct.error, IndexError, ValueError):
                return None
    return None


def memory_bytes(data: bytes, size_px: tuple[int, int]) -> int:
    """The memory of an image file whose `claimed_size` is known: its pixels, and what is decoded at once of a TIFF or the grey image."""
    area = size_px[0] * size_px[1]
    if data.startswith(b"\x89PNG"):
        bits, colours = int.from_bytes(data[24:25], "big"), int.from_bytes(data[25:26], "big")
        channels = 4 if data.find(b"tRNS", 0, max(data.find(b"IDAT"), 0)) > 0 else PNG_CHANNELS.get(colours, 4)
        return area * (channels * (2 if bits > 8 else 1) + GREY_BYTES)
    if data.startswith((b"II", b"MM")):
        return _tiff_bytes(_directory(data, _first_directory(data))[0], size_px)
    return area * (6 + GREY_BYTES)  # others have at most 3 × 16 bits


def has_several_images(data: bytes) -> bool:
    """Whether an image file has more than one image: pages of a TIFF, previews left out, or the frames of an animation."""
    try:
        if data.startswith(b"\x89PNG"):
            at = data.find(b"acTL", 0, max(data.find(b"IDAT"), 0))
            return at > 0 and int.from_bytes(data[at + 4 : at + 8], "big") > 1
        if data.startswith((b"II", b"MM")):
            return _pages(data) > 1
        return data[:4] == b"RIFF" and data[12:16] == b"VP8X" and bool(data[20] & ANIMATED)
    except (struct.error, IndexError):
        return False


def _png(data: bytes) -> tuple[int, int] | None:
    """OpenCV allocates the claimed length of each chunk, so the chunks must lie within the file."""
    w, h = struct.unpack(">II", data[16:24])
    at = 8
    while at + 8 <= len(data) and data[at + 4 : at + 8] != b"IEND":
        at += 12 + struct.unpack(">I", data[at : at + 4])[0]
    return (w, h) if data[12:16] == b"IHDR" and at < len(data) else None


def _jpeg(data: bytes) -> tuple[int, int] | None:
    scans = data.count(b"\xff\xda")
    if scans > MOST_SCANS:
        return None
    at = 2
    while at + 9 < len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in JPEG_FRAMES:
            h, w = struct.unpack(">HH", data[at + 5 : at + 9])
            return (w, h) if scans * w * h <= max(MOST_SCANNED, w * h) else None
        at += 1 if marker == 0xFF else 2 if marker in (0x01, *range(0xD0, 0xDA)) else 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    return None


def _bmp(data: bytes) -> tuple[int, int]:
    if struct.unpack("<I", data[14:18])[0] == 12:
        w, h = struct.unpack("<HH", data[18:22])
        return w, h
    w, h = struct.unpack("<ii", data[18:26])
    return abs(w), abs(h)


def _portable(data: bytes) -> tuple[int, int]:
    words = re.sub(rb"#[^\n]*", b" ", data[2:4096]).split()
    return int(words[0]), int(words[1])


def _webp(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L":
        bits = struct.unpack("<I", data[21:25])[0]
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        w, h = struct.unpack("<HH", data[26:30])
        return w & 0x3FFF, h & 0x3FFF
    return None


def _tiff(data: bytes) -> tuple[int, int] | None:
    """The largest size in the first directory of a classic or big TIFF."""
    found = _directory(data, _first_directory(data))[0]
    return (found[WIDTH], found[HEIGHT]) if found.get(WIDTH) and found.get(HEIGHT) else None


def _tiff_bytes(found: dict[int, int], size_px: tuple[int, int]) -> int:
    """See `memory_bytes`; OpenCV decodes a whole strip or tile, with four bytes for a pixel at least."""
    width, height = size_px
    samples = found.get(SAMPLES, 1)
    channels = samples if samples == 1 and found.get(COLOURS, 1) in GREY else max(samples, 3) if samples != 2 else 4
    pixel = channels * (4 if found.get(COLOURS) in LOGARITHMS else -(-found.get(BITS, 1) // 8))
    rows = found.get(STRIP_ROWS, WHOLE)
    at_once = width * (rows if 0 < rows < WHOLE else height)
    if found.get(TILE_WIDTH, 0) > 0 or found.get(TILE_HEIGHT, 0) > 0:
        at_once = max(found.get(TILE_WIDTH, 0) or width, 1) * max(found.get(TILE_HEIGHT, 0) or height, 1)
    return width * height * pixel + max(at_once * max(pixel, GREY_BYTES), width * height * GREY_BYTES)


def _pages(data: bytes) -> int:
    """How many images a TIFF has, previews left out; at most 2 are counted."""
    at, pages, seen = _first_directory(data), 0, set[int]()
    while at and at not in seen and pages < 2 and len(seen) < MOST_ENTRIES:
        seen.add(at)
        found, at = _directory(data, at)
        pages += not found.get(KIND, 0) & REDUCED
    return pages


def _first_directory(data: bytes) -> int:
    order, big = _layout(data)
    return int(struct.unpack(order + ("Q" if big else "I"), data[8:16] if big else data[4:8])[0])


def _layout(data: bytes) -> tuple[str, bool]:
    """The order of a TIFF's bytes, and whether it is a big one."""
    order = "<" if data[:1] == b"I" else ">"
    return order, struct.unpack(order + "H", data[2:4])[0] == 43


def _directory(data: bytes, at: int) -> tuple[dict[int, int], int]:
    """The largest values of TAGS in the directory of a TIFF there, and the place of the next or 0."""
    order, big = _layout(data)
    count = struct.unpack(order + ("Q" if big else "H"), data[at : at + (8 if big else 2)])[0]
    at, step, value = at + (8 if big else 2), 20 if big else 12, 12 if big else 8
    room, long = (8, "Q") if big else (4, "I")
    found: dict[int, int] = {}
    for i in range(min(count, MOST_ENTRIES)):
        tag, kind = struct.unpack(order + "HH", data[at + i * step : at + i * step + 4])
        if tag in TAGS and kind in TIFF_KINDS:
            code, size = TIFF_KINDS[kind]
            place = at + i * step + value
            number = max(min(struct.unpack(order + long, data[place - room : place])[0], MOST_SAMPLES), 1)
            if number * size > room:
                place = struct.unpack(order + long, data[place : place + room])[0]
            values = struct.unpack(f"{order}{number}{code}", data[place : place + number * size])
            found[tag] = max(found.get(tag, 0), *values)
    rest = data[at + count * step : at + count * step + (8 if big else 4)]
    return found, int.from_bytes(rest, "little" if order == "<" else "big") if len(rest) == (8 if big else 4) else 0


READERS = (
    (b"\x89PNG\r\n\x1a\n", _png), (b"\xff\xd8\xff", _jpeg), (b"BM", _bmp), (b"RIFF", _webp), (b"II", _tiff), (b"MM", _tiff),
    *((kind, _portable) for kind in (b"P2", b"P3", b"P5", b"P6")),
)  # fmt: skip
