"""Tables of a movie that claim more samples than the file can hold: FFmpeg would make an entry in memory for each."""

import io
import struct
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.images.sample_tables import CONTAINERS, claimed_samples
from tricap.core.images.sequence import Movie

from ...coded_movies import atom
from ...mutations import memory_mb

FRAMES = 6
MANY = 80_000_000


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("movie") / "m.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25.0, (64, 48))
    for i in range(FRAMES):
        writer.write(np.random.default_rng(i).integers(0, 255, (48, 64, 3), dtype=np.uint8))
    writer.release()
    return path.read_bytes()


def numbers(*values: int) -> bytes:
    return struct.pack(f">{len(values)}I", *values)


def changed(data: bytes, change: Callable[[bytes, bytes], bytes]) -> bytes:
    """The boxes with what a function makes of each kind and content, those inside first."""
    made, at = b"", 0
    while at + 8 <= len(data):
        size, kind = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + size]
        made += change(kind, changed(body, change) if kind in CONTAINERS else body)
        at += size
    return made


def replaced(data: bytes, **tables: bytes) -> bytes:
    """The movie with other tables."""
    return changed(data, lambda kind, body: atom(kind, tables.get(kind.decode("latin-1"), body)))


def with_more(data: bytes, parent: bytes, more: bytes) -> bytes:
    """The movie with one more box at the end of another."""
    return changed(data, lambda kind, body: atom(kind, body + more) if kind == parent else atom(kind, body))


def wide(kind: bytes, body: bytes) -> bytes:
    """A box whose size has eight bytes."""
    return struct.pack(">I4sQ", 1, kind, 16 + len(body)) + body


SIZES = numbers(0, 1, MANY)
EDITS = atom(b"edts", atom(b"elst", numbers(0, 20_000) + numbers(240, 0, 65536) * 20_000))
RUN = atom(b"moof", atom(b"traf", atom(b"trun", numbers(0, MANY))))
CLAIMS: dict[str, Callable[[bytes], bytes]] = {
    "sizes": lambda data: replaced(data, stsz=SIZES),
    "sizes, times and runs": lambda data: replaced(data, stsz=SIZES, stts=numbers(0, 1, MANY, 512), stsc=numbers(0, 1, 1, MANY, 1)),
    "times": lambda data: replaced(data, stts=numbers(0, 2, MANY, 512, MANY, 512)),
    "offsets of times": lambda data: with_more(data, b"stbl", atom(b"ctts", numbers(0, 1, MANY, 512))),
    "runs": lambda data: replaced(data, stsc=numbers(0, 1, 1, MANY, 1)),
    "runs of many chunks": lambda data: replaced(data, stsc=numbers(0, 1, 1, 500, 1), stco=numbers(0, 1000) + bytes(4000)),
    "edits": lambda data: with_more(replaced(data, stsz=numbers(0, 1, 100)), b"trak", EDITS),
    "a fragment": lambda data: data + RUN,
    "small sizes": lambda data: with_more(data, b"stbl", atom(b"stz2", numbers(0, 0, MANY))),
    "a wide box": lambda data: with_more(data, b"stbl", wide(b"stsz", SIZES)),
    "a box to the end": lambda data: with_more(data, b"stbl", bytes(4) + b"stsz" + SIZES),
    "beside the track": lambda data: with_more(data, b"moov", atom(b"stsz", SIZES)),
    "in a description": lambda data: with_more(data, b"stsd", atom(b"stsz", SIZES)),
    "in a box that seems free": lambda data: data + atom(b"free", atom(b"mvhd", bytes(8)), atom(b"stsz", SIZES)),
    "many tracks": lambda data: data + 100 * atom(b"trak", atom(b"stsz", numbers(0, 1, 1000))),
}
DAMAGED: dict[str, Callable[[bytes], bytes]] = {
    "sizes that are not there": lambda data: replaced(data, stsz=numbers(0, 0, MANY)),
    "small sizes that are not there": lambda data: with_more(data, b"stbl", atom(b"stz2", numbers(0, 4, MANY))),
    "times that are not there": lambda data: replaced(data, stts=numbers(0, MANY, 1, 512)),
    "runs that are not there": lambda data: replaced(data, stsc=numbers(0, MANY, 1, 1, 1)),
    "edits that are not there": lambda data: with_more(data, b"trak", atom(b"elst", numbers(0, MANY))),
    "samples of a fragment that are not there": lambda data: data + atom(b"moof", atom(b"trun", numbers(0x200, MANY))),
    "a cut table": lambda data: replaced(data, stsz=numbers(0, 1)),
}


@pytest.mark.parametrize("case", [*CLAIMS, *DAMAGED])
def test_a_small_movie_does_not_claim_millions_of_samples(movie: bytes, tmp_path: Path, case: str) -> None:
    path = tmp_path / "m 1.mp4"
    path.write_bytes((CLAIMS | DAMAGED)[case](movie))
    assert path.stat().st_size < 1_000_000
    said = r"its tables claim \d+ images or sounds, more than its \d+ bytes" if case in CLAIMS else "a table claims more|a table is cut"
    before, began = memory_mb()[1], time.process_time()
    with pytest.raises(InputError, match=rf"m 1.mp4 is not a movie that can be decoded \(({said}).*ffmpeg -i 'm 1.mp4' -c copy"):
        Movie(path)
    assert time.process_time() - began < 0.5 and memory_mb()[1] - before < 50


def test_compressed_tables_are_not_read(movie: bytes, tmp_path: Path) -> None:
    for data in (with_more(movie, b"moov", atom(b"cmov", bytes(20))), with_more(movie, b"stsd", atom(b"cmov", bytes(20)))):
        (tmp_path / "m.mov").write_bytes(data)
        with pytest.raises(InputError, match="its tables are compressed"):
            Movie(tmp_path / "m.mov")


def test_a_sound_movie_is_read(movie: bytes, tmp_path: Path) -> None:
    assert claimed_samples(io.BytesIO(movie), len(movie)) == FRAMES
    edited = with_more(movie, b"trak", atom(b"edts", atom(b"elst", numbers(0, 1, 240, 0, 65536))))
    for data in (movie, edited, movie + atom(b"free", bytes(100))):
        (tmp_path / "m.mp4").write_bytes(data)
        assert Movie(tmp_path / "m.mp4").read(FRAMES - 1).shape == (48, 64)


def test_boxes_in_each_other_and_cut_files_come_to_an_end(movie: bytes) -> None:
    deep = b""
    for _ in range(10_000):
        deep = atom(b"udta", deep)
    for data in (deep, 100_000 * atom(b"free"), b"\0\0\0\7moov" + movie, *(movie[:cut] for cut in range(0, len(movie), 97))):
        try:
            assert claimed_samples(io.BytesIO(data), len(data)) <= len(data)
        except ValueError as error:
            assert "table" in str(error)


def test_a_picture_is_no_movie(tmp_path: Path) -> None:
    """A GIF file begins like a transport stream."""
    assert cv2.imwrite(str(tmp_path / "m.gif"), np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "m.gif").rename(tmp_path / "m.mpg")
    with pytest.raises(InputError, match="is not a movie that can be decoded; convert it"):
        Movie(tmp_path / "m.mpg")
