"""One look at the footage, frame after frame in a small size: how much moves when, how bright it is, and what repeats."""

from dataclasses import dataclass

import cv2
import numpy as np

from ..foundation.progress import Monitor
from ..images.retime import Recent
from ..images.sequence import Movie
from ..take.take import Footage
from .findings import Finding, doubtful, wrong

LONGEST = 240  # frames; a longer take is looked at from its middle
WIDTH_PX = 96
BLANK_SPREAD, DARK, WHITE, WHITE_SHARE = 1.0, 24.0, 253.0, 0.03  # grey values; share of the pixels
BEGINNING = 50  # frames of a movie
UNEVEN = 0.6  # frames; time stamps are rounded
REPEATED = 0.2  # of a view's usual motion energy, noise included


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Survey:
    """Figures (V, T) of V views in T consecutive frames."""

    frames: range
    energy: np.ndarray  # mean grey difference from the frame before, NaN in the first
    spread: np.ndarray  # standard deviation of the grey values
    bright: np.ndarray  # 98th percentile of the grey values
    white: np.ndarray  # share of pixels at the upper end of the range


def survey(footage: Footage, monitor: Monitor) -> Survey:
    """Look at the frames of a take, at most LONGEST from its middle.

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
        monitor.step("looking at the footage", t, len(frames))
        pictures = [footage.take.rows_at(frame).rows(image) for image in footage.read(frame)]
        small = [_reduced(picture) for picture in pictures]
        for k, picture in enumerate(pictures):
            energy = float(np.abs(small[k] - before[k]).mean()) if before else np.nan
            figures[:, k, t] = energy, small[k].std(), np.percentile(small[k], 98), (picture[::4, ::4] >= WHITE).mean()
        before = small
    return Survey(frames=frames, energy=figures[0], spread=figures[1], bright=figures[2], white=figures[3])


def _reduced(picture: np.ndarray) -> np.ndarray:
    width = min(WIDTH_PX, picture.shape[1])
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))


def picture_findings(seen: Survey, names: tuple[str, ...]) -> list[Finding]:
    """Views that are blank, dark or overexposed, and frames that repeat the frame before."""
    found = []
    for k, name in enumerate(names):
        blank = seen.spread[k] < BLANK_SPREAD
        if blank.any():
            found.append(_blank(seen, name, blank))
            continue
        if np.median(seen.bright[k]) < DARK:
            found.append(
                doubtful(
                    "dark",
                    f"View {name} is very dark: its brightest parts have {np.median(seen.bright[k]):.0f} of 255 grey values.",
                    "Open the camera's iris, or use footage with more bits a pixel.",
                    bright_grey=float(np.median(seen.bright[k])),
                )
            )
        if np.median(seen.white[k]) > WHITE_SHARE:
            found.append(
                doubtful(
                    "overexposed",
                    f"{100 * np.median(seen.white[k]):.0f} % of view {name} is white: nothing can be matched there.",
                    "Close the iris or shorten the exposure, if that is on the person.",
                    white_share=float(np.median(seen.white[k])),
                )
            )
    return [*found, *_frozen(seen, names), *_repeated(seen, names)]


def rate_findings(footage: Footage) -> list[Finding]:
    """Movies whose frames, as far as they were looked at (or in the first second or two), do not follow each other evenly."""
    found = []
    for k, (view, sequence) in enumerate(zip(footage.take.views, footage.sequences)):
        movie = sequence.behind if isinstance(sequence, Recent) else sequence
        if not isinstance(movie, Movie):
            continue
        beginning = min(BEGINNING, footage.number(k, footage.frames.stop - 1) + 1)
        if movie.shown < beginning:
            movie.read(beginning - 1)
        uneven = movie.unevenness
        if uneven > UNEVEN:
            said = f"View {view.name} has a variable frame rate: its frames are up to {uneven:.1f} frames off an even rate."
            advice = "Convert the movie to a constant frame rate, each frame at its own moment."
            found.append(wrong("variable frame rate", said, advice, uneven_frames=uneven))
    return found


def _blank(seen: Survey, name: str, blank: np.ndarray) -> Finding:
    first, bright = seen.frames[int(np.argmax(blank))], float(np.median(seen.bright[:, blank]))
    word = "black" if np.median(seen.bright[:, blank].min(axis=0)) < DARK else "blank"
    where = "in every frame" if blank.all() else f"in {int(blank.sum())} of {len(blank)} frames, first in frame {first}"
    return wrong(
        "blank view",
        f"View {name} is {word} {where}.",
        "Give the view its right footage, or leave those frames out with `frames` in take.toml.",
        frames=int(blank.sum()),
        first=first,
        bright_grey=bright,
    )


def _frozen(seen: Survey, names: tuple[str, ...]) -> list[Finding]:
    """Views that show one picture, without even noise, while another view does not."""
    energy = np.nanmax(seen.energy, axis=1) if len(seen.frames) > 1 else np.zeros(len(names))
    return [frozen_view(name) for name, most in zip(names, energy) if not most > 0] if (energy > 0).any() else []


def frozen_view(name: str) -> Finding:
    """A view that shows one picture again and again."""
    said = f"View {name} shows the same picture in every frame that was looked at: its camera or its export stood still."
    return wrong("frozen view", said, "Give the view its right footage, or leave the view out of take.toml.")


def _repeated(seen: Survey, names: tuple[str, ...]) -> list[Finding]:
    """Frames without even the noise's difference from the frame before: a camera, or a conversion, repeated a picture."""
    found = []
    for k, name in enumerate(names):
        usual = float(np.nanmedian(seen.energy[k])) if len(seen.frames) > 3 else 0.0
        with np.errstate(invalid="ignore"):
            same = (seen.energy[k] < REPEATED * usual) & (seen.spread[k] >= BLANK_SPREAD)
        if usual > 0 and same.any():
            first = seen.frames[int(np.argmax(same))]
            found.append(
                wrong(
                    "repeated frames",
                    f"View {name} repeats the frame before in {int(same.sum())} of {len(same)} frames, "
                    f"first in frame {first}: the camera dropped frames, or a conversion filled them in.",
                    "Convert the recording again at its own frame rate, or leave those frames out.",
                    frames=int(same.sum()),
                    first=first,
                )
            )
    return found
