"""The person in an image, against a background that stands still.

An image is averaged in square cells. A cell's difference r from the background, less that of a slightly different light (an offset and a
gain), is noise where the background is visible, and wide where the person covers it:

    p(r | background) = (1 − ε) N(0, σ) + ε Laplace(0, 2 s) ,   p(r | person) = (1 − δ) Laplace(0, s) + δ / 256              (1)
    x = u + w G ∗ tanh(x / 2) ,   u = c ln(p(r | person) / p(r | background)) + seen                                         (2)

s is the mean difference of cells with measured points: a person in plain cloth may hardly differ from the background. c is how well the
background is known there, `seen` is added where points were measured, and G is a Gaussian: a cell is more likely the person's among cells
of the person (mean field of a Potts model; Koller & Friedman 2009, §11.5). The background of a cell is the tightest cluster of its values
over time (Parzen 1962; Bickel 2002: half-sample mode), of those without measured points near if there are enough: a person who lingers does
not become the background. Where measured points looked just so, nothing is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..foundation.arrays import frozen
from ..geometry.robust import mad_sigma
from .background import EMPTY_SHARE, OTHER_ROOM
from .second_look import CLEAR, NEVER, look_cost, second_is_background

FEWEST = 5  # images for a background
FEWEST_BARE = 3  # of these, without anybody near the cell
CLUSTER = 0.5  # of a cell's values, of which the tightest cluster consists
TIGHT = 6.0  # times the noise: a wider cluster is no background
LEAST_NOISE = 0.3  # grey values
ROWS = 64  # of cells, processed at a time
SAME_LOOK, MANY = 1.5, 0.2  # times the noise: what differs less looks the same; the share of the cells around that do
LINGERING = 0.3  # c of a cell near which there was always a person
UNEVEN, UNEVEN_SHARE = 1.5, 0.02  # times the noise, and of all cells: where fewer have so much, the person has added it
STRAY, SAME = 0.02, 0.05  # ε: shadows and the like; δ of (1)
LEAST_DIFFERENCE = 3.0  # s over the noise
ODDS = (-3.0, 5.0)  # bounds of the logarithm in (2)
SEEN = 4.0  # of a cell with measured points
COUPLING, RADIUS, ROUNDS = 6.0, 2.0, 10  # w of (2), sigma of G in cells, iterations
SMALLEST = 60  # cells of a region
NORMAL_QUARTILE, NORMAL_UPPER = 0.3186, 1.1503  # lower and upper quartile of |N(0, 1)|
GAIN_CELLS, GAIN_STEPS = 4000, 10  # for a gain: cells, and iterations with each weight
GAIN_PRIOR = 1e4  # weight of no gain, in grey values² over the noise's
GAIN_WIDTH = 3.0  # times the noise, of the second weight
LEAST_GAIN = 0.25  # times the noise, of what a gain changes (root mean square): the person adds up to 0.15
OTHER_LIGHT = 4.0  # times the noise: the difference of so large a share is not noise


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CellBackground:
    """The background of a view in cells (h, w), the noise of a cell in grey values, and how well it is known there, 0 to 1.

    `noise` is that of most cells, `sigma` (h, w) that of each: light that flickers or drifts, and coded movies, change some of them more.
    """

    grey: np.ndarray
    noise: float
    sigma: np.ndarray
    known: np.ndarray
    cell_px: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "grey", frozen(self.grey, (None, None), np.float32, "grey"))
        object.__setattr__(self, "sigma", frozen(self.sigma, self.grey.shape, np.float32, "sigma"))
        object.__setattr__(self, "known", frozen(self.known, self.grey.shape, np.float32, "known"))


def cells(image: np.ndarray, cell_px: int) -> np.ndarray:
    """The means (h', w') of an image (h, w) in square cells; incomplete ones at the far edges are left out."""
    h, w = (n // cell_px * cell_px for n in image.shape)
    whole = image[:h, :w].astype(np.float32)
    return whole if cell_px == 1 else np.asarray(whole.reshape(h // cell_px, cell_px, w // cell_px, cell_px).mean(axis=(1, 3)))


def still_background(
    images: Sequence[np.ndarray], near: Sequence[np.ndarray], seen: Sequence[np.ndarray], cell_px: int
) -> CellBackground | None:
    """The background of images in cells (h, w), spread over time; None if there are too few.

    `near` and `seen` (h, w) of each: where somebody is near, and where measured.
    """
    if len(images) < FEWEST:
        return None
    grey, width, bare, bare_width = (np.empty(images[0].shape, np.float32) for _ in range(4))
    for row in range(0, len(grey), ROWS):  # piece by piece: several copies of all images would take too much memory
        part = slice(row, row + ROWS)
        values = np.stack([image[part] for image in images])
        grey[part], width[part] = _tightest(np.sort(values, axis=0), np.full(values.shape[1:], len(values)))
        without = np.where(np.stack([there[part] for there in near]), np.inf, values)
        bare[part], bare_width[part] = _tightest(np.sort(without, axis=0), np.isfinite(without).sum(axis=0))
    noise = max(LEAST_NOISE, float(np.median([mad_sigma(image - grey) for image in images])))
    certain = bare_width < TIGHT * noise
    grey = np.where(certain, bare, grey)
    known = np.where(certain, 1.0, np.where(width < TIGHT * noise, LINGERING, 0.0))
    second, gain = _second_look(images, seen, grey, noise)
    grey = np.where(gain > CLEAR, second, grey)
    known = np.where(gain > CLEAR, 1.0, np.where(gain > 0, 0.0, known))
    known[_same_when_seen(images, seen, grey, noise)] = 0.0
    return CellBackground(grey=grey, noise=noise, sigma=_sigma(images, near, grey, noise), known=known, cell_px=cell_px)


def _sigma(images: Sequence[np.ndarray], near: Sequence[np.ndarray], grey: np.ndarray, noise: float) -> np.ndarray:
    """The noise (h, w) of each cell and those around, by the upper quartile of its differences while nobody is near; the same for all cells
    unless many of them have more."""
    sigma, lights = np.empty(grey.shape, np.float32), [_light(image - grey, grey, noise) for image in images]
    for row in range(0, len(grey), ROWS):
        part = slice(row, row + ROWS)
        left = [np.abs(image[part] - (1 + gain) * grey[part] - offset) for image, (gain, offset) in zip(images, lights)]
        bare = np.less(left, TIGHT * noise) & ~np.stack([there[part] for there in near])
        ascending = np.sort(np.where(bare, left, np.inf), axis=0)
        shown = np.isfinite(ascending).sum(axis=0)
        quartile = np.take_along_axis(ascending, np.maximum(shown - 1, 0)[None] * 3 // 4, axis=0)[0]
        sigma[part] = np.where(shown > 0, quartile, 0.0) / NORMAL_UPPER
    sigma = np.maximum(cv2.GaussianBlur(sigma, (0, 0), RADIUS), noise)
    return sigma if np.mean(sigma > UNEVEN * noise) > UNEVEN_SHARE else np.full(grey.shape, noise)


def _second_look(images: Sequence[np.ndarray], seen: Sequence[np.ndarray], grey: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """How cells (h, w) look where they do not look as `grey`, and what speaks for that as the background (`second_look`)."""
    others = sum((np.abs(image - grey) >= TIGHT * noise).astype(int) for image in images)
    at = np.nonzero(others >= FEWEST_BARE)
    values, measured = (np.stack([cells[at] for cells in of]) for of in (images, seen))
    first = np.abs(values - grey[at]) < TIGHT * noise
    look, width = _tightest(np.sort(np.where(first, np.inf, values), axis=0), (~first).sum(axis=0))
    also = (width < TIGHT * noise) & (np.abs(values - look) < TIGHT * noise) & ~first
    second, costs = np.array(grey), (np.zeros(grey.shape), np.full(grey.shape, NEVER))
    second[at] = look
    for cost, like in zip(costs, (first, also)):
        cost[at] = look_cost(like.sum(axis=0), (like & measured).sum(axis=0))
    return second, second_is_background(grey, second, *costs, noise)


def _same_when_seen(images: Sequence[np.ndarray], seen: Sequence[np.ndarray], grey: np.ndarray, noise: float) -> np.ndarray:
    """Cells (h, w) in which measured points of the person look as the background `grey` does: a foot that stood there all the time, and
    was not always measured. None in cloth that looks like the background everywhere."""
    middle = np.full(grey.shape, np.inf, np.float32)
    for row in range(0, len(grey), ROWS):
        part = slice(row, row + ROWS)
        there = np.stack([cells[part] for cells in seen])
        difference = np.where(there, np.abs(np.stack([image[part] for image in images]) - grey[part]), np.inf)
        count = there.sum(axis=0)
        half = np.take_along_axis(np.sort(difference, axis=0), np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
        middle[part] = np.where(count >= FEWEST_BARE, half, np.inf)
    measured = np.isfinite(middle)
    if not measured.any() or float(np.median(middle[measured])) < LEAST_DIFFERENCE * noise:
        return np.zeros(grey.shape, dtype=bool)
    same = (middle < SAME_LOOK * noise).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(same, (0, 0), RADIUS) > MANY)  # single ones are chance


def given_background(grey: np.ndarray, images: Sequence[np.ndarray], cell_px: int) -> CellBackground | None:
    """A background that the user gave, in cells (h, w), with its noise from those of the images that show it; None if none does."""
    quartiles = [float(np.quantile(np.abs(image - grey), EMPTY_SHARE)) / NORMAL_QUARTILE for image in images]
    noise = [q for q in quartiles if q <= OTHER_ROOM]
    if not noise:
        return None
    least = max(LEAST_NOISE, float(np.median(noise)))
    shown = [image for image, q in zip(images, quartiles) if q <= OTHER_ROOM]
    sigma = _sigma(shown, [np.zeros(grey.shape, dtype=bool)] * len(shown), grey, least)
    return CellBackground(grey=grey, noise=least, sigma=sigma, known=np.ones(grey.shape), cell_px=cell_px)


def person(background: CellBackground, image: np.ndarray, seen: np.ndarray) -> np.ndarray | None:
    """Where (h, w) an image in cells shows the person; `seen`: cells with measured points. None in another light, or of a black image."""
    difference, certain = image - background.grey, background.known == 1
    comparable = certain if certain.any() else np.ones(certain.shape, dtype=bool)
    if np.quantile(np.abs(difference[comparable]), EMPTY_SHARE) > OTHER_LIGHT * background.noise:
        return None
    gain, offset = _light(difference, background.grey, background.noise, comparable)
    r = np.abs(difference - gain * background.grey - offset)
    there = seen & certain
    wide = np.maximum(LEAST_DIFFERENCE * background.sigma, float(r[there].mean()) if there.any() else 0.0)
    x = u = background.known * _log_odds(r, background.sigma, wide) + SEEN * seen
    for _ in range(ROUNDS):
        x = u + COUPLING * cv2.GaussianBlur(np.tanh(x / 2), (0, 0), RADIUS)  # (2)
    _, label, stats, _ = cv2.connectedComponentsWithStats((x > 0).astype(np.uint8))
    large = stats[:, cv2.CC_STAT_AREA] >= SMALLEST
    large[0] = False
    return np.asarray(large[label])


def _light(difference: np.ndarray, grey: np.ndarray, noise: float, comparable: np.ndarray | slice = np.s_[:]) -> tuple[float, float]:
    """What another light adds to the differences (h, w) from a background `grey`: gain · grey + offset.

    By least absolute residuals, then with weights that leave out the person (Geman-McClure).
    """
    d, g = difference[comparable].ravel(), grey[comparable].ravel()
    every = 1 + len(d) // GAIN_CELLS
    some, level = d[::every].astype(np.float64), g[::every].astype(np.float64)
    level = level - level.mean()
    gain, offset = 0.0, float(np.median(some))
    for step in range(2 * GAIN_STEPS):
        r = np.abs(some - offset - gain * level) / noise
        w = 1 / np.maximum(r, 1.0) if step < GAIN_STEPS else 1 / (1 + (r / GAIN_WIDTH) ** 2) ** 2
        m = (w * level).sum() / w.sum()
        offset = float((w * some).sum() / w.sum() - gain * m)
        gain = float((w * (level - m) * some).sum() / ((w * (level - m) ** 2).sum() + GAIN_PRIOR))
    if abs(gain) * level.std() < LEAST_GAIN * noise:
        gain = 0.0
    return gain, _of_light(d - gain * g, noise)


def _of_light(difference: np.ndarray, noise: float) -> float:
    """What the light adds to all differences (N,): the mean of the tightest half of those not far from the noise."""
    near = np.sort(difference[np.abs(difference) < 2 * OTHER_LIGHT * noise])
    half = (len(near) + 1) // 2
    first = int(np.argmin(near[half - 1 :] - near[: len(near) - half + 1]))
    return float(near[first : first + half].mean()) if half else 0.0


def _log_odds(r: np.ndarray, noise: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """ln p(r | person) − ln p(r | background) of absolute differences (h, w).  (1)"""
    narrow = np.exp(-0.5 * (r / noise) ** 2) / (noise * np.sqrt(2 * np.pi))
    empty = (1 - STRAY) * narrow + STRAY * np.exp(-r / (2 * wide)) / (4 * wide)
    covered = (1 - SAME) * np.exp(-r / wide) / (2 * wide) + SAME / 256
    return np.clip(np.log(covered) - np.log(np.maximum(empty, np.finfo(np.float32).tiny)), *ODDS).astype(np.float32)


def _tightest(ascending: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean and the width (h, w) of the tightest cluster of the first `count` (h, w) of ascending values (n, h, w); width infinite where
    they are too few."""
    n = len(ascending)
    size = np.maximum(FEWEST_BARE, np.ceil(CLUSTER * count).astype(int))
    sums = np.concatenate([np.zeros((1, *count.shape)), np.cumsum(np.where(np.isfinite(ascending), ascending, 0.0), axis=0)])
    mean, width = ascending[0].astype(np.float64), np.full(count.shape, np.inf)
    for i in range(n - FEWEST_BARE + 1):
        end = i + size
        enough = end <= count
        last = np.take_along_axis(ascending, np.where(enough, end - 1, i)[None], axis=0)[0]
        with np.errstate(invalid="ignore"):  # infinite ones are not enough
            here = np.where(enough, last - ascending[i], np.inf)
        tighter = here < width
        total = np.take_along_axis(sums, np.where(enough, end, 0)[None], axis=0)[0] - sums[i]
        mean, width = np.where(tighter, total / size, mean), np.where(tighter, here, width)
    return mean, width
