"""By how much one sound recording began after another: generalised cross-correlation with phase transform (Knapp & Carter 1976,
doi:10.1109/TASSP.1976.1162830).

    R(τ) = F⁻¹[ A(f) B*(f) / |A(f) B*(f)| ]                                                  (1)

Pieces of the shorter recording are searched in all of the longer one; where several of them agree on a delay, short pieces from everywhere
give the delay over time, and a robust line through it

    t_a = D + (1 + k) t_b                                                                    (2)

gives the offset D and the drift k between the two clocks. Unrelated sounds have no peak beyond what chance gives among so many lags, or
peaks that do not agree.
"""

import wave
from dataclasses import dataclass
from math import gcd
from pathlib import Path

import numpy as np

from ..foundation import bounded
from ..foundation.arrays import frozen
from ..foundation.errors import InputError
from ..foundation.progress import Monitor

RATE = 8000  # samples per second that are compared
BAND_HZ = (150.0, 3600.0)
LOWEST_RATE, HIGHEST_RATE = 4000, 400_000
LONGEST_S = 4 * 3600.0
SILENT = 1e-4  # of full scale, root mean square: below is no sound
PIECES, PIECE_S = 8, 8.0  # that are searched everywhere
PEAK = 8.0  # times the root mean square of R: chance reaches √(2 ln n), 5.6 among the lags of ten minutes
ALONE = 12.0  # … of a single piece
AGREE_S = 0.02  # of pieces on a delay, plus what a drift makes
MOST_DRIFT = 5e-4
SHORT_S, REACH_S, MOST_SHORT = 2.0, 0.05, 120  # pieces for (2), the lags that they are searched at, and their number
SHORT_PEAK = 7.0
FEWEST_FOR_DRIFT = 8  # short pieces
STEPS = 8  # of the line's adjustment
LEAST_SCALE_S = 5e-5  # of its residuals: under half a sample
LEAST_SPAN_S = 20.0  # over which a drift is looked for
SIGNIFICANT = 4.0  # sigmas of a drift


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sound:
    """A recording, one channel: samples (n,) at RATE."""

    samples: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "samples", frozen(self.samples, (None,)))

    @property
    def silent(self) -> bool:
        """Whether nothing can be heard."""
        return len(self.samples) < RATE // 2 or float(np.sqrt(np.mean(self.samples**2))) < SILENT


@dataclass(frozen=True, kw_only=True, slots=True)
class SoundOffset:
    """A recording began `offset_s` after another, and its clock is slow by `drift`.  (2)

    `sigma_s` is that of the moments in the middle of what both recorded.
    """

    offset_s: float
    drift: float
    sigma_s: float
    pieces: int


def sound_of(samples: np.ndarray, rate: int) -> Sound:
    """The sound of samples (n,) or (n, channels) of a recording, −1…1, at `rate` per second.

    Raises:
        InputError: the rate is impossible, or the recording is longer than LONGEST_S.
    """
    from scipy.signal import resample_poly

    if not LOWEST_RATE <= rate <= HIGHEST_RATE:
        raise InputError(
            f"A sound of {rate} samples per second cannot be compared; save it with {LOWEST_RATE} to {HIGHEST_RATE}, such as 48000."
        )
    if len(samples) > LONGEST_S * rate:
        raise InputError(f"A sound of {len(samples) / rate:.0f} s is too long to be compared; shorten it to {LONGEST_S:.0f} s.")
    mono = np.asarray(samples, dtype=np.float32)
    mono = mono if mono.ndim == 1 else mono.mean(axis=1)
    mono = np.nan_to_num(mono - (mono.mean() if len(mono) else 0.0))
    common = gcd(rate, RATE)
    return Sound(samples=mono if rate == RATE or not len(mono) else resample_poly(mono, RATE // common, rate // common))


def read_wav(path: Path) -> Sound:
    """The sound of a WAV file.

    Raises:
        InputError: it cannot be read, or is not PCM of 8, 16, 24 or 32 bits.
    """
    try:
        with bounded.opened(path, bounded.TABLE_BYTES) as file, wave.Wave_read(file) as wav:
            channels, width, rate, count = wav.getnchannels(), wav.getsampwidth(), wav.getframerate(), wav.getnframes()
            data = np.frombuffer(wav.readframes(count), dtype=np.uint8)
    except (OSError, EOFError, wave.Error, ValueError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error) or "it ends too early"
        raise InputError(f"Cannot read the sound {path} ({reason}); save it as WAV, 16 bits PCM.") from error
    if width not in (1, 2, 3, 4) or channels < 1:
        raise InputError(f"Cannot read the sound {path} ({8 * width} bits); save it as WAV, 16 bits PCM.")
    parts = data[: len(data) // (width * channels) * width * channels].reshape(-1, channels, width)
    if width == 1:
        values = (parts[..., 0].astype(np.float32) - 128) / 128
    else:
        wide = np.zeros((*parts.shape[:2], 4), dtype=np.uint8)
        wide[..., 4 - width :] = parts
        values = (wide.view("<i4")[..., 0] / 2.0**31).astype(np.float32)
    try:
        return sound_of(values, rate)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def offset_between(a: Sound, b: Sound, monitor: Monitor) -> SoundOffset | None:
    """By how much `b` began after `a`; None if they have nothing in common.

    Some seconds for ten minutes of sound.
    """
    if a.silent or b.silent:
        return None
    if len(a.samples) < len(b.samples):  # what both recorded may be a small part of the longer one
        back_s = _coarse(b.samples, a.samples, monitor)
        coarse_s = None if back_s is None else -back_s
    else:
        coarse_s = _coarse(a.samples, b.samples, monitor)
    return None if coarse_s is None else _line(a.samples, b.samples, coarse_s, monitor)


def _coarse(a: np.ndarray, b: np.ndarray, monitor: Monitor) -> float | None:
    """The delay on which pieces of b, found in a, agree."""
    length = min(round(PIECE_S * RATE), len(b))
    size = _fft_size(len(a) + length)
    A, found = np.fft.rfft(a, size), list[tuple[float, float, float]]()
    starts = _loudest(b, length, PIECES)
    for n, start in enumerate(starts):
        monitor.step("comparing sound", n, len(starts) + 1)
        r = _correlation(A, np.fft.rfft(b[start : start + length], size), size)
        lag = int(np.argmax(r))
        z = float(r[lag] / np.sqrt(np.mean(r**2)))
        if z > PEAK:
            lag -= size if lag > size - length else 0
            found.append(((lag - start) / RATE, start / RATE, z))
    groups = [[g for g in found if abs(g[0] - f[0]) < AGREE_S + MOST_DRIFT * abs(g[1] - f[1])] for f in found]
    best = max(groups, key=lambda group: sum(z for *_, z in group), default=[])
    if len(best) < 2 and not (best and best[0][2] > ALONE):
        return None
    return max(best, key=lambda g: g[2])[0]


def _loudest(b: np.ndarray, length: int, count: int) -> list[int]:
    """Where the loudest piece of each part of a recording begins."""
    steps = np.arange(0, len(b) - length + 1, max(length // 4, 1))
    energy = np.concatenate([[0.0], np.cumsum(np.square(b, dtype=np.float64))])
    power = energy[steps + length] - energy[steps]
    parts = np.array_split(np.arange(len(steps)), min(count, len(steps)))
    return sorted({int(steps[part[np.argmax(power[part])]]) for part in parts})


def _line(a: np.ndarray, b: np.ndarray, coarse_s: float, monitor: Monitor) -> SoundOffset | None:
    """(2) from the delays of short pieces of b."""
    delays: list[tuple[float, float]] = []
    shift, drift, length, reach = coarse_s, 0.0, round(SHORT_S * RATE), round(REACH_S * RATE)
    first, last = max(0, round(-coarse_s * RATE)), min(len(b), len(a) - round(coarse_s * RATE))
    length = min(length, max((last - first) // 2, RATE // 4))
    middle = (first + last - length) // 2
    starts = np.unique(np.linspace(first, max(first, last - length), MOST_SHORT).astype(int))
    size = _fft_size(2 * length + 2 * reach)
    for n, start in enumerate(sorted(starts, key=lambda s: abs(int(s) - middle))):  # outwards: the drift so far predicts the next
        monitor.step("comparing sound", n, len(starts))
        times = [t for t, _ in delays]
        if len(delays) > FEWEST_FOR_DRIFT and np.ptp(times) > LEAST_SPAN_S:
            drift, shift = (float(x) for x in np.polyfit(times, [d for _, d in delays], 1))
        expected = round((shift + drift * start / RATE) * RATE)
        piece, low = b[start : start + length], start + expected - reach
        there = a[max(low, 0) : max(low + length + 2 * reach, 0)]
        if len(piece) < length or len(there) < length:
            continue
        r = _correlation(np.fft.rfft(there, size), np.fft.rfft(piece, size), size)
        inside = r[: 2 * reach + 1]
        at = int(np.argmax(inside))
        if 0 < at < len(inside) - 1 and inside[at] > SHORT_PEAK * np.sqrt(np.mean(r**2)):
            y0, y1, y2 = inside[at - 1 : at + 2]
            sub = 0.5 * (y0 - y2) / (y0 - 2 * y1 + y2)
            delays.append((start / RATE, (max(low, 0) + at + sub - start) / RATE))
    return _adjusted(np.array(delays)) if len(delays) > 2 else None


def _adjusted(delays: np.ndarray) -> SoundOffset | None:
    """A line through delays (n, 2) of time and delay, by least squares with Cauchy's weights; a constant where the drift is not
    significant."""
    t, d = delays.T
    mean, free = t.mean(), np.ptp(t) > LEAST_SPAN_S
    for slope in (True, False) if free else (False,):
        A = np.stack([np.ones_like(t), t - mean], axis=1)[:, : 1 + slope]
        x, w = np.array([np.median(d), 0.0])[: 1 + slope], np.ones_like(t)
        for _ in range(STEPS):
            v = d - A @ x
            scale = max(1.4826 * float(np.median(np.abs(v))), LEAST_SCALE_S)
            w = 1 / (1 + (v / (2 * scale)) ** 2)
            x = np.linalg.solve((A * w[:, None]).T @ A, (A * w[:, None]).T @ d)
        v = d - A @ x
        variance = max(float((w * v**2).sum()) / max(float(w.sum()) - len(x), 1.0), LEAST_SCALE_S**2)
        covariance = np.linalg.inv((A * w[:, None]).T @ A) * variance
        if not slope or abs(x[1]) > SIGNIFICANT * np.sqrt(covariance[1, 1]):
            break
    good = np.abs(v) < AGREE_S / 4
    if good.mean() < 0.5:
        return None
    drift = float(x[1]) if len(x) > 1 else 0.0
    return SoundOffset(offset_s=float(x[0] - drift * mean), drift=drift, sigma_s=float(np.sqrt(covariance[0, 0])), pieces=int(good.sum()))


def _correlation(A: np.ndarray, B: np.ndarray, size: int) -> np.ndarray:
    """R (size,) at lags 0, 1, …, −2, −1.  (1)"""
    cross = A * np.conj(B)
    f = np.arange(len(cross)) * RATE / size
    cross /= np.maximum(np.abs(cross), 1e-20)
    cross[(f < BAND_HZ[0]) | (f > BAND_HZ[1])] = 0.0
    return np.fft.irfft(cross, size)


def _fft_size(least: int) -> int:
    from scipy.fft import next_fast_len

    return int(next_fast_len(least, real=True))
