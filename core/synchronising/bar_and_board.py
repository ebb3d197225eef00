"""Films of a bar or a board whose cameras were started one by one: which images belong together."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..calibration.calibrate import Start
from ..calibration.clocks import FASTEST_FPS, SLOWEST_FPS, Clocks, begun_together, rates_of
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..images.sequence import ImageFiles, ImageSequence
from ..take.take import Take, View
from .synchronise import MovieSound, ViewTiming, synchronise


def common_start(
    folder: Path,
    names: tuple[str, ...],
    sequences: tuple[ImageSequence, ...],
    rates: str,
    monitor: Monitor,
    movie_sound: MovieSound | None = None,
    by_sound: bool = True,
) -> tuple[Start, tuple[ViewTiming, ...]]:
    """What belongs together in films of a bar or a board, and the timings of the views.

    `rates` are the images per second: of all views, such as "30", or of each of them, such as "L=24, C=30, R=60". When the views began is
    found by sound (FOLDER/NAME.wav), light or time codes; or, not `by_sound`, they began at the same instant.

    Raises:
        InputError: the rates are faulty, a view was not found, no image is common to all, or a sound or an image cannot be read.
    """
    if "=" in rates:
        every = rates_of(rates, names)
        return film_clocks(folder, names, sequences, every, monitor, movie_sound) if by_sound else (begun_together(every), ())
    try:
        fps = float(rates)
    except ValueError:
        fps = np.nan
    if not SLOWEST_FPS <= fps <= FASTEST_FPS:
        raise InputError(f"“{rates}” is no frame rate; give the images per second of all views, such as 30, or of each: L=24,C=30,R=60.")
    return first_images(folder, names, sequences, fps, monitor, movie_sound)


def film_clocks(
    folder: Path,
    names: tuple[str, ...],
    sequences: tuple[ImageSequence, ...],
    rates_fps: np.ndarray,
    monitor: Monitor,
    movie_sound: MovieSound | None = None,
) -> tuple[Clocks, tuple[ViewTiming, ...]]:
    """When the images of each view were taken, for films at different rates, by sound, light or time codes; and the timings.

    Raises:
        InputError: a view was not found, or a sound or an image cannot be read.
    """
    timings = _timings(folder, names, sequences, rates_fps, monitor, movie_sound)
    drift = np.array([1e-6 * timing.drift_ppm for timing in timings])
    return Clocks(start_s=np.array([timing.start_s for timing in timings]), interval_s=(1 + drift) / rates_fps), timings


def _timings(
    folder: Path,
    names: tuple[str, ...],
    sequences: tuple[ImageSequence, ...],
    rates_fps: np.ndarray,
    monitor: Monitor,
    movie_sound: MovieSound | None,
) -> tuple[ViewTiming, ...]:
    fps = float(rates_fps[0])
    views = tuple(
        replace(_view(folder, name, s), fps=None if rate == fps else float(rate)) for name, s, rate in zip(names, sequences, rates_fps)
    )
    take = Take(folder=folder, fps=fps, views=views, rig_path=folder / "no rig yet", reference_view=names[0])
    timings = synchronise(take, monitor, movie_sound)
    for timing in timings:
        if not timing.found:
            raise InputError(f"View {timing.view}: {timing.problem.removesuffix(', or give its `start` in take.toml.')}.")
    return timings


def first_images(
    folder: Path,
    names: tuple[str, ...],
    sequences: tuple[ImageSequence, ...],
    fps: float,
    monitor: Monitor,
    movie_sound: MovieSound | None = None,
) -> tuple[tuple[int, ...], tuple[ViewTiming, ...]]:
    """The number of that image in each view, by sound (FOLDER/NAME.wav), light or time codes, and the timings.

    It is exact to half an image; the rest is an unknown of the adjustment.

    Raises:
        InputError: a view was not found, no image is common to all, or a sound or an image cannot be read.
    """
    timings = _timings(folder, names, sequences, np.full(len(names), fps), monitor, movie_sound)
    starts = [round(timing.start_s * fps) for timing in timings]
    firsts = tuple(max(starts) - start for start in starts)
    for name, sequence, first in zip(names, sequences, firsts):
        if first >= sequence.count:
            raise InputError(f"View {name} in {folder} ended before another view began; film the bar or board with all cameras at once.")
    return firsts, timings


def _view(folder: Path, name: str, sequence: ImageSequence) -> View:
    files = sequence.files()
    if isinstance(sequence, ImageFiles):
        return View(name=name, images=f"{files[0].parent.relative_to(folder)}/*{files[0].suffix}")
    return View(name=name, movie=str(files[0].relative_to(folder)))
