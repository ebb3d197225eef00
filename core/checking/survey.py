"""One pass over the reduced footage: how much moves in each frame, how bright it is, and which frames repeat."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..foundation.progress import Monitor
from ..images.retime import Recent
from ..images.sequence import Movie
from ..take.footage import Footage
from .findings import Cause, Finding, doubtful, remark, wrong

LONGEST = 240  # frames; of a longer take its middle is used
WIDTH_PX = 96  # of the reduced images
BLANK_SPREAD = 1.0  # standard deviation of the grey values of a blank image
DARK = 24.0  # grey value: the brightest parts of a dark image are below
WHITE = 253.0  # grey value of an overexposed pixel
WHITE_SHARE = 0.03  # of the pixels
BRIGHT_PERCENTILE = 98  # of the grey values: the brightest parts
BEGINNING = 50  # frames of a movie
UNEVEN = 0.6  # frames; time stamps are rounded
STAMPED = 5000  # frames of a movie whose time stamps are compared
GAP = 1.5  # usual steps of the time stamps: images are missing in a larger one
FEW_GAPS = 0.05  # share of the steps; with more of them, the rate varies
SAME_RATE = 0.02  # relative difference of two frame rates
TIMESTAMPS = "Give the view the `timestamps` of its images in take.toml, or convert the movie to a constant frame rate."
REPEATED = 0.2  # of a view's usual motion energy, which includes the noise
FEWEST_FRAMES = 4  # for a usual motion energy
BRIEF = 3  # frames; where less moves for longer, or at an end of the take, the person stands still or is not there
SELDOM = 0.02  # share of repeated frames, and one at least, that harms nothing: there the motion pauses for a frame


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Survey:
    """Figures (V, T) of V views in T consecutive frames."""

    frames: range
    energy: np.ndarray  # motion energy: mean grey difference from the frame before, NaN in the first and where it is the same image
    spread: np.ndarray  # standard deviation of the grey values
    bright: np.ndarray  # 98th percentile of the grey values
    white: np.ndarray  # share of overexposed pixels


def survey(footage: Footage, monitor: Monitor) -> Survey:
    """The figures of a take, of at most LONGEST frames from its middle.

    Raises:
        InputError: see `Footage.read`.
    """
    frames = footage.frames
    if len(frames) > LONGEST:
        first = frames.start + (len(frames) - LONGEST) // 2
        frames = range(first, first + LONGEST)
    figures = np.full((4, len(footage.sequences), len(frames)), np.nan)
    before: list[np.ndarray] = []
    for t, frame in enumerate(frames):
        monitor.step("checking the footage", t, len(frames))
        images = [footage.take.rows_at(frame).rows(image) for image in footage.read(frame)]
        small = [reduced(image) for image in images]
        for k, image in enumerate(images):
            same = before and footage.number(k, frame) == footage.number(k, frames[t - 1])  # of a view with fewer images per second
            energy = motion_energy(before[k], small[k]) if before and not same else np.nan
            figures[:, k, t] = energy, small[k].std(), np.percentile(small[k], BRIGHT_PERCENTILE), (image[::4, ::4] >= WHITE).mean()
        before = small
    return Survey(frames=frames, energy=figures[0], spread=figures[1], bright=figures[2], white=figures[3])


def reduced(image: np.ndarray) -> np.ndarray:
    """An image (h, w), `WIDTH_PX` wide."""
    width = min(WIDTH_PX, image.shape[1])
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def motion_energy(before: np.ndarray, now: np.ndarray) -> float:
    """How much moves between two `reduced` images of a view: their mean difference in grey values."""
    return float(np.abs(now - before).mean())


def picture_findings(figures: Survey, names: tuple[str, ...]) -> list[Finding]:
    """Views that are blank, dark or overexposed, and frames that repeat the frame before."""
    findings = []
    for k, name in enumerate(names):
        blank = figures.spread[k] < BLANK_SPREAD
        if blank.any():
            findings.append(_blank(figures, name, blank))
            continue
        if np.median(figures.bright[k]) < DARK:
            findings.append(
                doubtful(
                    Cause.DARK,
                    f"View {name} is very dark: its brightest parts have {np.median(figures.bright[k]):.0f} of 255 grey values.",
                    "Open the iris of the camera, or use footage with more bits per pixel.",
                    bright_grey=float(np.median(figures.bright[k])),
                )
            )
        if np.median(figures.white[k]) > WHITE_SHARE:
            findings.append(
                doubtful(
                    Cause.OVEREXPOSED,
                    f"{100 * np.median(figures.white[k]):.0f} % of view {name} is white: nothing can be matched there.",
                    "Close the iris or shorten the exposure if these parts are on the person.",
                    white_share=float(np.median(figures.white[k])),
                )
            )
    return [*findings, *_frozen(figures, names), *_repeated(figures, names)]


def rate_findings(footage: Footage) -> list[Finding]:
    """Movies whose frame rate varies among the frames read so far, or in the first second or two; that lack images in mid-clip; or whose
    rate is not the take's."""
    findings, rates = [], dict[str, tuple[float, float]]()
    for k, (view, sequence) in enumerate(zip(footage.take.views, footage.sequences)):
        movie = sequence.behind if isinstance(sequence, Recent) else sequence
        if not isinstance(movie, Movie) or view.timestamps is not None:
            continue
        used = footage.number(k, footage.frames.stop - 1) + 1
        if movie.shown < min(BEGINNING, used):
            movie.read(min(BEGINNING, used) - 1)
        step_ms, gaps = _gaps(movie.stamps_ms(min(max(used, BEGINNING), STAMPED)), used)
        uneven, few = movie.unevenness, len(gaps) <= FEW_GAPS * used
        if uneven > UNEVEN and not (gaps and few):
            sentence = f"View {view.name} has a variable frame rate: its frames are up to {uneven:.1f} frames off an even rate."
            findings.append(wrong(Cause.VARIABLE_FRAME_RATE, sentence, TIMESTAMPS, uneven_frames=uneven))
        elif gaps:
            lost = f"{len(gaps)} places, the first of them" if len(gaps) > 1 else "one place,"
            sentence = f"The time stamps of view {view.name} show that images are missing in {lost} before its image {gaps[0]}."
            findings.append(wrong(Cause.FRAMES_MISSING, sentence, TIMESTAMPS, first_image=gaps[0], places=len(gaps)))
        if step_ms > 0:
            rates[view.name] = 1000.0 / step_ms, view.fps or footage.take.fps / footage.take.field_layout.per_image
    return findings + _other_rates(rates)


def _gaps(stamps_ms: np.ndarray, used: int) -> tuple[float, list[int]]:
    """The usual step of time stamps (n,), 0 if not known, and the numbers below `used` of the images before which some are missing."""
    steps = np.diff(stamps_ms)
    if len(steps) < FEWEST_FRAMES - 1:
        return 0.0, []
    usual = steps < GAP * np.median(steps)
    return float(steps[usual].mean()), (1 + np.flatnonzero(~usual[: used - 1])).tolist()


def _other_rates(rates: Mapping[str, tuple[float, float]]) -> list[Finding]:
    """Of views whose movies state another rate than take.toml has for them."""
    other = {name: (own, given) for name, (own, given) in rates.items() if abs(own / given - 1) > SAME_RATE}
    if not other:
        return []
    stated = ", ".join(f"{own:.3g} images per second in view {name} ({given:.3g} in take.toml)" for name, (own, given) in other.items())
    advice = "Correct `fps` in take.toml, or add it to the [[views]] that differ; a film in slow motion may state what it likes."
    return [doubtful(Cause.FRAME_RATE, f"The movies state {stated}: times and speeds may be wrong.", advice)]


def gap_findings(footage: Footage) -> list[Finding]:
    """Views of numbered images whose numbers advance further than those of the others: images are missing between them."""
    numbers = {
        view.name: found
        for k, (view, sequence) in enumerate(zip(footage.take.views, footage.sequences))
        if not footage.clocks and (found := _numbers(sequence.files(), [footage.number(k, frame) for frame in footage.frames]))
    }
    if len(numbers) < 2:
        return []
    table = np.array([*numbers.values()])
    advanced = table - table[:, :1]
    ahead, findings = advanced > advanced.min(axis=0), []
    for name, row, missing in zip(numbers, table, ahead):
        if missing.any():
            i = int(np.argmax(missing))
            findings.append(
                wrong(
                    Cause.FRAMES_MISSING,
                    f"View {name} seems to lack images before its image {row[i]}: from frame {footage.frames[i]} on it shows later moments "
                    "than the other views.",
                    "Put the missing images back, or leave these frames out with `frames` in take.toml.",
                    first=footage.frames[i],
                )
            )
    return findings


def _numbers(files: Sequence[Path], rows: Sequence[int]) -> list[int]:
    """The last number in the names of some of the files; none where a name has no number, or one file holds all images."""
    if len(files) < 2:
        return []
    found = [re.findall(r"\d+", files[row].stem) for row in rows]
    return [int(digits[-1]) for digits in found] if all(found) else []


def _blank(figures: Survey, name: str, blank: np.ndarray) -> Finding:
    first, bright = figures.frames[int(np.argmax(blank))], float(np.median(figures.bright[:, blank]))
    word = "black" if np.median(figures.bright[:, blank].min(axis=0)) < DARK else "blank"
    where = "in every frame" if blank.all() else f"in {int(blank.sum())} of {len(blank)} frames, first in frame {first}"
    return wrong(
        Cause.BLANK_VIEW,
        f"View {name} is {word} {where}.",
        "Give the view the right footage, or leave those frames out with `frames` in take.toml.",
        frames=int(blank.sum()),
        first=first,
        bright_grey=bright,
    )


def _frozen(figures: Survey, names: tuple[str, ...]) -> list[Finding]:
    """Views that repeat one image, noise included, while another view does not."""
    energy = np.nanmax(figures.energy, axis=1) if len(figures.frames) > 1 else np.zeros(len(names))
    return [frozen_view(name) for name, most in zip(names, energy) if not most > 0] if (energy > 0).any() else []


def frozen_view(name: str) -> Finding:
    """A view that repeats one image."""
    sentence = f"View {name} shows the same image in every frame that was checked: its camera or its export froze."
    return wrong(Cause.FROZEN_VIEW, sentence, "Give the view the right footage, or leave the view out of take.toml.")


def _repeated(figures: Survey, names: tuple[str, ...]) -> list[Finding]:
    """Frames that differ from the frame before by less than the noise: a camera, or a conversion, repeated an image."""
    findings = []
    for k, name in enumerate(names):
        shown = figures.spread[k] >= BLANK_SPREAD
        known = figures.energy[k][shown & np.roll(shown, 1) & np.isfinite(figures.energy[k])]  # a black image differs from every other one
        usual = float(np.median(known)) if len(figures.frames) >= FEWEST_FRAMES and len(known) else 0.0
        with np.errstate(invalid="ignore"):
            same = (figures.energy[k] < REPEATED * usual) & shown
            frozen = (figures.energy[k] == 0) & (np.delete(figures.energy, k, axis=0) > 0).any(axis=0)  # not even noise, and others go on
        same &= _brief(same) | frozen
        if usual > 0 and same.any():
            findings.append(_repeats(name, figures.frames[int(np.argmax(same))], int(same.sum()), len(same)))
    return findings


def _brief(low: np.ndarray) -> np.ndarray:
    """Which frames (T,) lie in a row of at most BRIEF frames that are `low`, between others that are not."""
    brief, ends = np.zeros(len(low), dtype=bool), np.flatnonzero(np.diff(low.astype(int)))  # of each row, low or not, the last frame
    for before, last in zip(ends, ends[1:]):
        brief[before + 1 : last + 1] = low[last] and last - before <= BRIEF
    return brief


def _repeats(name: str, first: int, count: int, frames: int) -> Finding:
    """A view that repeats some frames: a remark if these are few."""
    if count <= max(1, SELDOM * frames):
        where = f"in frame {first}" if count == 1 else f"in {count} of {frames} frames, first in frame {first}"
        sentence = f"View {name} repeats the frame before {where}; the motion pauses there."
        return remark(Cause.REPEATED_FRAMES, sentence, frames=count, first=first)
    return wrong(
        Cause.REPEATED_FRAMES,
        f"View {name} repeats the frame before in {count} of {frames} frames, "
        f"first in frame {first}: the camera dropped frames, or a conversion filled them in.",
        "Convert the recording again at its own frame rate, or leave those frames out.",
        frames=count,
        first=first,
    )
