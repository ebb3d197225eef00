"""Time codes of movies, against what was written; damaged and foreign files."""

import struct
from pathlib import Path

import numpy as np
import pytest

from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Monitor
from tricap.core.synchronising import synchronise as synchronising
from tricap.core.synchronising.synchronise import synchronise
from tricap.core.synchronising.time_code import TimeCode, read_time_code, started_after
from tricap.core.take.take import read_take

from ...coded_movies import coded_movie


def read(tmp_path: Path, data: bytes) -> TimeCode | None:
    (tmp_path / "a.mov").write_bytes(data)
    return read_time_code(tmp_path / "a.mov")


def test_the_code_of_the_first_image_is_read(tmp_path: Path) -> None:
    assert read(tmp_path, coded_movie(25 * 3600 + 50)) == TimeCode(first_s=3602.0, frame_s=0.04)
    assert read(tmp_path, coded_movie(250, wide=True)) == TimeCode(first_s=10.0, frame_s=0.04)
    ntsc = dict(scale=30000, duration=1001, per_second=30)
    dropping = read(tmp_path, coded_movie(107892, drop=True, **ntsc))  # 01:00:00;00
    assert dropping is not None and abs(dropping.first_s - 3600) < 0.01 and not dropping.labelled
    assert read(tmp_path, coded_movie(108000, **ntsc)).labelled


def test_codes_that_do_not_belong_together_are_not_compared() -> None:
    a, b = TimeCode(first_s=86399.0, frame_s=0.04), TimeCode(first_s=1.5, frame_s=1 / 30)
    assert started_after(a, b) == pytest.approx(2.5), "over midnight"
    zero = TimeCode(first_s=0.0, frame_s=0.04)
    assert started_after(zero, zero) is None
    slow = TimeCode(first_s=10.0, frame_s=1001 / 30000, labelled=True)
    assert started_after(a, slow) is None and started_after(slow, slow) == 0.0


def test_damaged_and_foreign_files_have_none(tmp_path: Path) -> None:
    movie, rng = coded_movie(99), np.random.default_rng(0)
    assert read(tmp_path, b"") is None and read(tmp_path, b"RIFF" + bytes(80)) is None
    endless = struct.pack(">I4s", 8, b"free") * 50_000
    assert read(tmp_path, endless + movie) is None, "more atoms than a movie has"
    for size in range(0, len(movie), 7):
        assert read(tmp_path, movie[:size]) is None
    for _ in range(300):
        data = bytearray(movie)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(0, 256)
        found = read(tmp_path, bytes(data))
        assert found is None or 0 <= found.first_s < 2 * 86400
    with pytest.raises(InputError, match="Cannot read the movie"):
        read_time_code(tmp_path / "none.mov")


def test_movies_without_sound_start_by_their_time_codes(tmp_path: Path, scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each camera counts whole images, so the sigma is that of a part of an image."""
    scenes.write_take_toml(tmp_path, ["A", "B"])
    toml = (tmp_path / "take.toml").read_text().replace("images", "movie").replace("/*.png", ".mov")
    (tmp_path / "take.toml").write_text(toml)
    (tmp_path / "A.mov").write_bytes(coded_movie(25 * 60 + 10))
    (tmp_path / "B.mov").write_bytes(coded_movie(25 * 50))
    monkeypatch.setattr(synchronising._Lights, "timing", lambda *_: None)  # these movies have no images
    a, b = synchronise(read_take(tmp_path), Monitor())
    assert (a.method, b.method) == ("time code", "reference")
    assert a.start_s == pytest.approx(10.4) and a.sigma_s == pytest.approx(0.04 * np.sqrt(2 / 12))
    (tmp_path / "A.mov").write_bytes(b"RIFF")
    assert "nor have both movies a time code" in synchronise(read_take(tmp_path), Monitor())[0].problem
