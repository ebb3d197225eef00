"""What every motion has: frame numbers that increase, a frame rate, and places within reach. Files that lack it are damaged."""

import numpy as np

from ..foundation.errors import InputError

LOWEST_FPS, HIGHEST_FPS = 1e-3, 1e6
LARGEST_FRAME = 1_048_574  # either way: Blender's scenes have no others, and would play nothing of them
MOST_FRAMES, MOST_PER_KEY = 20_000, 100  # from the first frame to the last: so many in any case, and so many for every one that has values
MOST_POSES = 2_000_000  # of bones in all these frames, in any case
FARTHEST = 1e9  # in whatever unit: a million kilometres; beyond, squares of numbers overflow in some step


def check_times(frames: np.ndarray, fps: float, what: object) -> None:
    """Check frame numbers (T,) and their rate. `what` begins the message.

    Raises:
        InputError: the numbers do not increase or are none, or the rate is impossible.
    """
    if not (np.abs(frames) <= LARGEST_FRAME).all():
        raise InputError(f"{what} with a frame number that is none, or beyond {LARGEST_FRAME}, Blender's last; correct the frame numbers.")
    if not LOWEST_FPS <= fps <= HIGHEST_FPS:
        raise InputError(f"{what} with {fps:.4g} frames per second; choose a file with a rate from {LOWEST_FPS:g} to {HIGHEST_FPS:g}.")
    back = np.flatnonzero(np.diff(frames) <= 0)
    if len(back):
        last, after = frames[back[0]], frames[back[0] + 1]
        raise InputError(f"{what} with frame {after:g} after frame {last:g}; frame numbers must increase. Sort the file, or correct them.")


def check_span(first: float, last: float, count: int, what: object, most_per_key: int = MOST_PER_KEY, bones: int = 1) -> None:
    """Check that `count` frames, or frames with keys, are not spread over very many, in each of which a pose of so many bones would be
    computed or written.

    Raises:
        InputError: they are.
    """
    if not last - first <= max(min(MOST_FRAMES, MOST_POSES / max(bones, 1)), most_per_key * count):
        raise InputError(f"{what} from frame {first:g} to {last:g}, with values for {count} alone; correct the frame numbers or times.")


def check_places(values: np.ndarray, what: object) -> None:
    """Check that no number of a motion is out of reach; NaN and infinity are gaps.

    Raises:
        InputError: there is one.
    """
    if ((np.abs(values) > FARTHEST) & np.isfinite(values)).any():
        raise InputError(f"{what} with positions beyond {FARTHEST:.0e}; it is damaged, or in another unit.")
