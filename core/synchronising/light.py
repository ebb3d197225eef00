"""When the light changed in a view: a lamp that is switched, or a flash, seen by all cameras.

Rows b of image n are exposed from M_n + ρ (y_b − ½) − e/2 to M_n + ρ (y_b − ½) + e/2, in intervals of the images (M_n = n), with the
exposure e, the readout ρ from the first row to the last, and the height y_b of the rows, 0 … 1. The share of a change at the time T that
they see is

    w_nb = clip((M_n + ρ (y_b − ½) + e/2 − T) / e, 0, 1)                a lamp that is switched                (1)
    w_nb = 1 if |M_n + ρ (y_b − ½) − T| < e/2 else 0                     a flash                                (2)
    p(T, e, ρ) ∝ exp(−½ Σ (q_nb − w_nb)² / σ²)                                                                  (3)

with q_nb the brightness relative to before and after. e and ρ are those of the view: their distribution is the product of those from all
changes, over which that of T is averaged. A rolling shutter shows the change at some row of an image, and so its time to a part of an
image; with a global shutter its time follows from the image that was exposed while the light changed, or lies between two images.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..foundation.progress import Monitor
from ..images.interlace import RowGrid
from ..images.sequence import ImageSequence

BANDS, COLUMNS = 16, 4  # of an image
EVERY = 3  # row and column that is averaged
GAMMA = 2.2  # of the grey values
NOISE = 8.0  # times the scatter of the differences between images: a change
LEAST_CHANGE = 0.03  # of the brightness
WIDEST = 4  # images in which it happens
AROUND = 2  # images before and after
FLASH, SWITCH = 0.25, 0.6  # of the change that remains afterwards: less is a flash, more a lamp
LIT = 0.3  # of the light of the brightest rows: rows that a flash met
ALIKE = 4.0  # bands whose brightness is wrong in the same way
EVERYWHERE = 0.7  # of the parts of the image that must change alike
Q_SIGMA = 0.04  # of q: grey values are not quite light
FLASH_SIGMA = 0.35  # of the light of a flash in a part of the image
EXPOSURES = np.array([0.03, 0.08, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95, 1.0])
READOUTS = np.linspace(0.0, 1.0, 11)
STEP = 0.02  # images, of T
LEAST_SIGMA = 0.005  # images
MATCHED = 1.0  # images by which changes of two views may differ, plus …
MOST_DRIFT = 5e-4  # … this share of the time between them
LEAST_SPAN_S = 20.0  # over which a drift is looked for
SIGNIFICANT = 4.0  # sigmas of a drift


@dataclass(frozen=True, kw_only=True, slots=True)
class LightChange:
    """A change of the light, at a number of images (the middle of the exposure of the middle row of image n is n) of its view."""

    image: float
    sigma: float
    kind: str  # "on", "off" or "flash"


@dataclass(frozen=True, kw_only=True, slots=True)
class LightOffset:
    """A view began `offset_s` after another, and its clock is slow by `drift`; `sigma_s` is that of the moments of the changes."""

    offset_s: float
    drift: float
    sigma_s: float
    changes: int


def brightness_of(sequence: ImageSequence, rows: RowGrid, monitor: Monitor) -> np.ndarray:
    """The mean light (n, BANDS, COLUMNS) of parts of every image of a view, 0 … 1.

    Raises:
        InputError: an image cannot be read.
    """
    found = np.empty((sequence.count, BANDS, COLUMNS))
    for n in range(sequence.count):
        monitor.step("reading the brightness", n, sequence.count)
        light = (np.clip(rows.rows(sequence.read(n))[::EVERY, ::EVERY], 0, 255) / 255) ** GAMMA
        found[n] = [[part.mean() for part in np.array_split(band, COLUMNS, axis=1)] for band in np.array_split(light, BANDS)]
    return found


def light_changes(brightness: np.ndarray, readout: float | None = None) -> tuple[LightChange, ...]:
    """The changes of the light in a view (n, BANDS, COLUMNS), in the order of time. `readout` ρ in intervals of the images, if known."""
    mean = brightness.mean(axis=(1, 2))
    if len(mean) < 2 * AROUND + 2:
        return ()
    step = np.abs(np.diff(mean))
    limit = max(NOISE * 1.4826 * float(np.median(step)), LEAST_CHANGE * float(np.median(mean)))
    where = np.flatnonzero(step > limit)
    groups = np.split(where, np.flatnonzero(np.diff(where) > AROUND) + 1) if len(where) else []
    readouts = READOUTS if readout is None else np.array([abs(readout)])
    found = [_likelihood(brightness, int(g[0]), int(g[-1]) + 1, readouts) for g in groups]
    of_view = [likelihood for likelihood in found if likelihood is not None]
    if not of_view:
        return ()
    shared = sum(np.logaddexp.reduce(log, axis=-1) for _, _, log in of_view)  # (E, R)
    return tuple(_change(kind, times, log, shared - np.logaddexp.reduce(log, axis=-1)) for kind, times, log in of_view)


Likelihood = tuple[str, np.ndarray, np.ndarray]  # kind, times (T,), and the logarithm (E, R, T) of (3)


def _likelihood(brightness: np.ndarray, last_before: int, first_after: int, readouts: np.ndarray) -> Likelihood | None:
    """The distribution of a change between two images; None where it is not one of the light."""
    start, stop = last_before, first_after + 1  # with an image to spare on either side
    if start < AROUND or stop + AROUND > len(brightness) or stop - start > WIDEST + 1:
        return None
    before, after = brightness[start - AROUND : start].mean(axis=0), brightness[stop : stop + AROUND].mean(axis=0)
    kind = _kind(brightness[start - AROUND : stop], before, after)
    if kind is None:
        return None
    times = np.arange(start - 1.0, stop, STEP)
    heights = (np.arange(BANDS) + 0.5) / BANDS - 0.5
    middle = np.arange(start, stop)[:, None] + readouts[:, None, None] * heights  # (R, n, BANDS)
    late = middle[None, :, None] - times[:, None, None]  # (1, R, T, n, BANDS)
    e = EXPOSURES[:, None, None, None, None]
    light = (brightness[start:stop] - before).mean(axis=2)
    if kind == "flash":  # (2), its edges as soft as the bands are high
        w = np.clip((e / 2 - np.abs(late)) * BANDS / np.maximum(readouts[:, None, None, None], 1 / BANDS) + 0.5, 0, 1)
        q = light / max(float(np.median(light[light > light.max() / 2])), 1e-9)
        variance = Q_SIGMA**2 + (FLASH_SIGMA * w) ** 2
        return kind, times, -0.5 / ALIKE * ((q - w) ** 2 / variance + np.log(variance)).sum(axis=(-2, -1))
    change = (after - before).mean(axis=1)
    q = np.clip(light / np.where(np.abs(change) > 0, change, 1.0), -0.5, 1.5)
    w = np.clip((late + e / 2) / e, 0, 1)  # (1)
    return kind, times, -0.5 / ALIKE * ((q - w) ** 2).sum(axis=(-2, -1)) / Q_SIGMA**2


def _kind(images: np.ndarray, before: np.ndarray, after: np.ndarray) -> str | None:
    """What changed in images of which the first AROUND are before the change; None where it is not the light of the whole image."""
    during = images[AROUND:]
    largest = during.mean(axis=(1, 2)) - before.mean()
    peak, remains = float(largest[np.argmax(np.abs(largest))]), float(after.mean() - before.mean())
    if abs(remains) < FLASH * abs(peak) and peak > 0:
        kind, tiles = "flash", (during - before).sum(axis=0)
        tiles = tiles[tiles.mean(axis=1) > LIT * tiles.mean(axis=1).max()]  # rows between two exposures do not see it
    elif abs(remains) > SWITCH * abs(peak):
        kind, tiles = ("on" if remains > 0 else "off"), after - before
    else:
        return None
    noise = np.abs(np.diff(images[:AROUND], axis=0)).mean() + 1e-9
    return kind if np.mean(tiles * np.sign(tiles.sum()) > noise) > EVERYWHERE else None


def _change(kind: str, times: np.ndarray, log: np.ndarray, others: np.ndarray) -> LightChange:
    """Mean and scatter of T over the distribution (3), with what the `others` (E, R) tell about exposure and readout."""
    whole = log + others[..., None]
    p = np.exp(whole - whole.max())
    p = p.sum(axis=(0, 1)) / p.sum()
    mean = float(p @ times)
    return LightChange(image=mean, sigma=float(np.sqrt(max(p @ (times - mean) ** 2, LEAST_SIGMA**2))), kind=kind)


def offset_by_light(a: Sequence[LightChange], b: Sequence[LightChange], a_s: np.ndarray, b_s: np.ndarray) -> LightOffset | None:
    """By how much view b began after a; None where no start, or more than one, brings their changes together.

    `a_s` and `b_s` (n, 2) are the times of the changes on the clocks of the views, and the intervals of their images then.
    """
    candidates = [_pairs(a, b, a_s[:, 0], b_s[:, 0], a_s[i, 0] - b_s[j, 0], float(a_s[i, 1] + b_s[j, 1]) / 2 * MATCHED)
                  for i in range(len(a)) for j in range(len(b)) if a[i].kind == b[j].kind]  # fmt: skip
    most = max((len(pairs) for pairs in candidates), default=0)
    best = sorted({tuple(pairs) for pairs in candidates if len(pairs) == most})
    if not most or len(best) > 1:
        return None
    i, j = np.array(best[0]).T
    delays = a_s[i, 0] - b_s[j, 0]
    sigma = np.hypot([a[n].sigma * a_s[n, 1] for n in i], [b[n].sigma * b_s[n, 1] for n in j])
    return _line(b_s[j, 0], delays, sigma)


def _pairs(
    a: Sequence[LightChange], b: Sequence[LightChange], a_s: np.ndarray, b_s: np.ndarray, offset_s: float, near_s: float
) -> list[tuple[int, int]]:
    """The changes of both views that belong together if b began `offset_s` after a."""
    pairs = []
    for j, change in enumerate(b):
        off = [abs(a_s[i] - b_s[j] - offset_s) if other.kind == change.kind else np.inf for i, other in enumerate(a)]
        i = int(np.argmin(off))
        if off[i] < near_s + MOST_DRIFT * float(np.ptp(b_s)):
            pairs.append((i, j))
    return pairs if len({i for i, _ in pairs}) == len(pairs) else []


def _line(t: np.ndarray, delays: np.ndarray, sigma: np.ndarray) -> LightOffset:
    """The offset from the delays at the times t on b's clock, and the drift where it is significant."""
    weight = 1 / sigma**2
    mean = float(weight @ t / weight.sum())
    for slope in (True, False) if len(t) > 2 and np.ptp(t) > LEAST_SPAN_S else (False,):
        A = np.stack([np.ones_like(t), t - mean], axis=1)[:, : 1 + slope]
        N = np.linalg.inv((A * weight[:, None]).T @ A)
        x = N @ (A * weight[:, None]).T @ delays
        chi = float(weight @ (delays - A @ x) ** 2) / max(len(t) - A.shape[1], 1)
        N = N * max(chi, 1.0)
        if slope and abs(x[1]) > SIGNIFICANT * np.sqrt(N[1, 1]):
            break
    drift = float(x[1]) if slope else 0.0
    return LightOffset(offset_s=float(x[0] - drift * mean), drift=drift, sigma_s=float(np.sqrt(N[0, 0])), changes=len(t))
