"""Films of a bar or a board whose cameras were started one by one: which image of each of them is the first that all of them have."""

from pathlib import Path

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..images.sequence import ImageFiles, ImageSequence
from ..take.take import Take, View
from .synchronise import MovieSound, ViewTiming, synchronise


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
    views = tuple(_view(folder, name, s) for name, s in zip(names, sequences))
    take = Take(folder=folder, fps=fps, views=views, rig_path=folder / "no rig yet", reference_view=names[0])
    timings = synchronise(take, monitor, movie_sound)
    for timing in timings:
        if not timing.found:
            raise InputError(f"View {timing.view}: {timing.problem.removesuffix(', or give its `start` in take.toml.')}.")
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
