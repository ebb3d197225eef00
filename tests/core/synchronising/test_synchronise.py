"""The beginning of views by their sound and by the rays, against truth; sounds and takes in which it cannot be found."""

import re
import struct
import wave
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from tricap.core.cli import main
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Monitor
from tricap.core.synchronising.sound import RATE, Sound, offset_between, read_wav
from tricap.core.synchronising.synchronise import synchronise
from tricap.core.take.footage import open_take
from tricap.core.take.take import FrameClicks, read_take

Capture = pytest.CaptureFixture[str]


def noise(seconds: float, seed: int, rate: int = RATE) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.asarray(lfilter([1.0], [1.0, -0.7], rng.normal(size=round(seconds * rate))))


def world(seconds: float) -> np.ndarray:
    """A room at 4 × RATE: faint noise, and louder now and then."""
    x = noise(seconds, 1, 4 * RATE)
    t = np.arange(len(x)) / (4 * RATE)
    return np.asarray(x * (0.02 + 0.2 * (np.sin(1.3 * t) * np.sin(0.37 * t) > 0.6)))


def heard(room: np.ndarray, start_s: float, seconds: float, *, seed: int, drift: float = 0.0) -> Sound:
    """What a camera hears that starts at a second of the room's sound and whose clock is slow, with its own noise."""
    t = start_s + (1 + drift) * np.arange(round(seconds * RATE)) / RATE
    return Sound(samples=np.interp(t, np.arange(len(room)) / (4 * RATE), room) + 0.02 * noise(seconds, seed))


@pytest.mark.parametrize(("start_s", "seconds", "drift"), [(43.1234567, 60.0, 50e-6), (-21.00333, 70.0, 0.0), (1.2345, 9.0, 0.0)])
def test_sound_gives_the_start_and_the_drift(start_s: float, seconds: float, drift: float) -> None:
    """Measured: 0.004 to 0.02 ms, limit 0.1 ms; recordings of unequal length."""
    room, before = world(125.0), max(0.0, -start_s)
    a, b = heard(room, before, 100.0, seed=2), heard(room, before + start_s, seconds, seed=3, drift=drift)
    found = offset_between(a, b, Monitor())
    assert found is not None and abs(found.drift - drift) < 1.5e-6
    middle = (max(0.0, -start_s) + seconds) / 2
    assert abs(found.offset_s + found.drift * middle - start_s - drift * middle) < 1e-4 and found.sigma_s < 1e-4


def test_a_recording_that_began_minutes_before_a_short_one_is_found() -> None:
    """Both share the last 9 of its 200 seconds."""
    room = world(209.0)
    a, b = heard(room, 195.0, 9.0, seed=2), heard(room, 4.0, 200.0, seed=3, drift=50e-6)
    found = offset_between(a, b, Monitor())
    assert found is not None and abs(found.offset_s + found.drift * 195.5 - (4.0 - 195.0) - 50e-6 * 195.5) < 1e-4


def test_unrelated_and_silent_sounds_have_nothing_in_common() -> None:
    room = world(60.0)
    a = heard(room, 0.0, 60.0, seed=2)
    assert all(offset_between(a, Sound(samples=noise(40.0, seed)), Monitor()) is None for seed in range(4, 9))
    hum = np.sin(2 * np.pi * 300 * np.arange(30 * RATE) / RATE)
    assert offset_between(a, Sound(samples=hum), Monitor()) is None
    for samples in (np.zeros(9 * RATE), np.zeros(0), np.ones(3)):
        assert offset_between(a, Sound(samples=samples), Monitor()) is None
    stopped = Monitor()
    stopped.cancel()
    with pytest.raises(Cancelled):
        offset_between(a, a, stopped)


def write_wav(path: Path, samples: np.ndarray, *, width: int = 2, channels: int = 1, rate: int = RATE) -> None:
    whole = np.clip(np.round(samples * 2 ** (8 * width - 1)), -(2 ** (8 * width - 1)), 2 ** (8 * width - 1) - 1).astype(np.int64)
    data = (whole + 128).astype(np.uint8)[:, None] if width == 1 else whole.astype("<i8").view(np.uint8).reshape(-1, 8)[:, :width]
    with wave.open(str(path), "wb") as wav:
        wav.setnchannels(channels), wav.setsampwidth(width), wav.setframerate(rate)
        wav.writeframes(np.repeat(data[:, None], channels, axis=1).tobytes())


@pytest.mark.parametrize(("width", "channels", "rate"), [(1, 1, RATE), (2, 2, 2 * RATE), (3, 1, 48000), (4, 2, RATE)])
def test_wav_files_of_all_widths_are_read(tmp_path: Path, width: int, channels: int, rate: int) -> None:
    t = np.arange(rate) / rate
    write_wav(tmp_path / "a.wav", 0.5 * np.sin(2 * np.pi * 440 * t), width=width, channels=channels, rate=rate)
    read = read_wav(tmp_path / "a.wav").samples
    assert len(read) == RATE and np.abs(read - 0.5 * np.sin(2 * np.pi * 440 * np.arange(RATE) / RATE))[200:-200].max() < 0.02


def test_damaged_wav_files_are_refused(tmp_path: Path) -> None:
    write_wav(tmp_path / "a.wav", np.zeros(100))
    sound = (tmp_path / "a.wav").read_bytes()
    for data in (
        b"",
        b"RIFF",
        sound[:20],
        b"RIFF" + bytes(60),
        sound[:20] + struct.pack("<H", 85) + sound[22:],
        sound[:24] + bytes(4) + sound[28:],
    ):
        (tmp_path / "b.wav").write_bytes(data)
        with pytest.raises(InputError, match=r"b\.wav[^()]*(\(.+\))?[^()]*;|b\.wav: A sound of 0 samples per second cannot"):
            read_wav(tmp_path / "b.wav")


@pytest.fixture
def loose(at_thirty: Callable[[Mapping[str, Sequence[int]]], Path]) -> Path:
    """Three views at 30 images per second, of which R began half an image interval late; take.toml does not say so."""
    return at_thirty({"L": range(0, 18, 2), "C": range(0, 18, 2), "R": range(1, 18, 2)})


@pytest.mark.slow
def test_sound_then_rays_give_the_start_of_a_view_half_a_frame_late(loose: Path, capsys: Capture) -> None:
    """The sound is 2 ms early in R, as from a source nearer to it; the rays correct it, to 0.9 ms in images of 224 pixels."""
    room = world(16.0)
    for view, start_s, seconds in (("L", 1.0, 12.0), ("C", 1.0, 14.0), ("R", 1.0 + 1 / 60 - 0.002, 10.0)):
        write_wav(loose / f"{view}.wav", heard(room, start_s, seconds, seed=ord(view)).samples)
    by_sound = synchronise(replace(read_take(loose), rig_path=loose / "none.toml"), Monitor())
    assert [t.method for t in by_sound] == ["sound", "reference", "sound"] and abs(by_sound[2].start_s - 1 / 60 + 0.002) < 1e-4
    assert by_sound[2].sigma_s > 0.002, "the sigma contains the way of the sound"
    before = (loose / "take.toml").read_bytes()
    assert main.main(["synchronise", str(loose), "--quiet"]) == 0 and (loose / "take.toml").read_bytes() == before
    capsys.readouterr()
    assert main.main(["synchronise", str(loose), "--write"]) == 0
    said = capsys.readouterr().out
    assert "View C: starts at 0.0000 s (the reference view)." in said and "by sound and rays" in said
    take = read_take(loose)
    assert take.views[1].start_s == 0 and abs(take.views[0].start_s) < 1.2e-3 and abs(take.views[2].start_s - 1 / 60) < 1.2e-3
    footage = open_take(replace(take, clicks=FrameClicks()))
    assert abs(footage.delay(2, 4)) == pytest.approx(0.5, abs=0.04)


@pytest.mark.slow
def test_without_sound_the_rays_alone_are_enough_where_somebody_moves(loose: Path) -> None:
    timings = synchronise(read_take(loose), Monitor())
    assert [t.method for t in timings] == ["rays", "reference", "rays"]
    assert abs(timings[2].start_s - 1 / 60) < 1.2e-3 and abs(timings[0].start_s) < 1.2e-3 and timings[2].sigma_s < 1e-3


def test_all_steps_have_the_same_reference_view(loose: Path) -> None:
    """R, the middle of the list, although opened footage has C as its reference view."""
    take = read_take(loose)
    left, centre, right = take.views
    take = replace(take, views=(left, right, centre), reference_view="R", reference_chosen=False)
    assert open_take(replace(take, clicks=FrameClicks(), frames=None)).take.reference_view == "C"
    timings = synchronise(take, Monitor())
    assert [t.method for t in timings] == ["rays", "reference", "rays"]
    assert abs(timings[0].start_s + 1 / 60) < 1.2e-3 and abs(timings[2].start_s + 1 / 60) < 1.2e-3


@pytest.mark.parametrize(
    ("samples", "said"),
    [
        (None, r"there is no sound of R \(no R.wav\)"),
        (np.zeros(8 * RATE), "the sound of R is silent"),
        (0.1 * noise(8.0, 77), "has nothing in common with that of the reference view"),
    ],
)
def test_a_view_that_cannot_be_found_is_told_in_one_sentence(loose: Path, capsys: Capture, samples: np.ndarray | None, said: str) -> None:
    (loose / "rig.toml").unlink()
    room = world(16.0)
    write_wav(loose / "L.wav", heard(room, 2.0, 12.0, seed=5).samples)
    write_wav(loose / "C.wav", heard(room, 1.0, 12.0, seed=6).samples)
    if samples is not None:
        write_wav(loose / "R.wav", samples)
    before = (loose / "take.toml").read_bytes()
    assert main.main(["synchronise", str(loose), "--write"]) == 2 and (loose / "take.toml").read_bytes() == before
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("Nothing was written. View R: ") or "Nothing was written. View R: " in error
    assert re.search(said, error) and "Clap once" in error
    assert main.main(["synchronise", str(loose)]) == 2
    shown = capsys.readouterr().out.splitlines()
    assert "by sound" in shown[0] and re.search(said, shown[2]), shown
