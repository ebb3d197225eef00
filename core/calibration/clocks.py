"""Films at different rates: image points of each camera, measured in its own images, at the instants of the slowest camera.

Image n of camera c was taken at s_c + n h_c. At an instant t its point is interpolated, as for delays (`delays`, (1)):

    x_c(t) = p(τ) ,   n + τ = (t − s_c) / h_c ,   |τ| ≤ 1/2                                                                     (1)

through its own images n − 3 … n + 3. What the clocks are still wrong by is an unknown of the adjustment, in images of the slowest camera,
of which an instant has one point at most: faster cameras do not count their noise several times.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..foundation.arrays import frozen
from ..foundation.errors import InputError
from .delays import FEWEST_STEPS, STEPS, moving_points, without_jumps

SLOWEST_FPS, FASTEST_FPS = 0.1, 10_000.0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Clocks:
    """When the images of each camera were taken, in one time."""

    start_s: np.ndarray  # (C,) of image 0
    interval_s: np.ndarray  # (C,) from image to image

    def __post_init__(self) -> None:
        object.__setattr__(self, "start_s", frozen(self.start_s, (None,), name="start_s"))
        object.__setattr__(self, "interval_s", frozen(self.interval_s, self.start_s.shape, name="interval_s"))

    @property
    def slowest(self) -> int:
        """The camera whose images are the instants."""
        return int(np.argmax(self.interval_s))

    def image_at(self, camera: int, of_slowest: np.ndarray) -> np.ndarray:
        """The images of a camera, with their parts, at those of the slowest one."""
        t = self.start_s[self.slowest] + np.asarray(of_slowest) * self.interval_s[self.slowest]
        return np.asarray((t - self.start_s[camera]) / self.interval_s[camera])

    def of_fields(self, per_image: int) -> "Clocks":
        """Those of the fields of interlaced images."""
        return Clocks(start_s=self.start_s, interval_s=self.interval_s / per_image)

    def check_overlap(self, names: Sequence[str], counts: Sequence[int]) -> None:
        """Raise InputError if films of so many images have no instant in common."""
        image = np.stack([self.image_at(c, np.arange(counts[self.slowest])) for c in range(len(names))])
        inside = (image >= 0) & (image <= np.array(counts)[:, None] - 1)
        if not inside.all(axis=0).any():
            never = names[int(np.argmin(inside.sum(axis=1)))]
            raise InputError(
                f"The film of view {never} has no instant in common with the others; film the bar or board with all cameras at once, and "
                "check the images per second."
            )

    def around(self, camera: int, of_slowest: np.ndarray) -> np.ndarray:
        """The numbers of the images of a camera by which its points are interpolated at images of the slowest one."""
        if camera == self.slowest:
            return np.asarray(of_slowest)
        nearest = np.rint(self.image_at(camera, of_slowest)).astype(np.int64)
        return np.unique(nearest[:, None] + STEPS)


def rates_of(text: str, names: Sequence[str]) -> np.ndarray:
    """Images per second (C,) of the cameras from a text such as "L=24, C=30, R=60".

    Raises:
        InputError: it is something else, or not of these cameras.
    """
    found: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = (piece.strip() for piece in part.rpartition("="))
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = np.nan
        if not name or not SLOWEST_FPS <= found[name] <= FASTEST_FPS:
            raise InputError(f"“{text}” gives no images per second of each view; write them as L=24,C=30,R=60.")
    wrong = sorted(set(found) ^ set(names))
    if wrong:
        raise InputError(f"“{text}” {'lacks' if wrong[0] in names else 'names'} the view {wrong[0]}; the views are {', '.join(names)}.")
    return np.array([found[name] for name in names])


def begun_together(rates_fps: np.ndarray) -> Clocks:
    """The clocks of films that begin at the same instant."""
    return Clocks(start_s=np.zeros(len(rates_fps)), interval_s=1 / rates_fps)


def at_common_instants(clocks: Clocks, numbers: Sequence[np.ndarray], xy_px: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The images (N,) of the slowest camera, and the points (N, C, K, 2) of all cameras at their instants, NaN where they are not known.

    `numbers` (n,) and `xy_px` (n, K, 2) are those of the images of each camera.

    Raises:
        InputError: no instant is common to the films.
    """
    frames = numbers[clocks.slowest]
    parts = []
    for c, (own, xy) in enumerate(zip(numbers, xy_px)):
        parts.append(xy if c == clocks.slowest else _at_images(own, xy, clocks.image_at(c, frames)))
    every = np.stack(parts, axis=1)
    if (np.isfinite(every[..., 0]).any(axis=2).sum(axis=1) >= 2).sum() < FEWEST_STEPS:
        raise InputError("No instant is common to the films in which two views show the target; check the images per second of each view.")
    return frames, every


def _at_images(numbers: np.ndarray, xy_px: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Points (N, K, 2) between the images (n,) of one camera.  (1)"""
    moving = moving_points(numbers, without_jumps(numbers, xy_px[:, None]))
    order = np.argsort(numbers)
    nearest = np.rint(images).astype(np.int64)
    row = order[np.minimum(np.searchsorted(numbers, nearest, sorter=order), len(numbers) - 1)]
    a = moving.coefficients[:, row, 0]  # (7, N, K, 2)
    powers = (images - nearest) ** np.arange(len(a))[:, None]
    return np.where((numbers[row] == nearest)[:, None, None], np.einsum("mn,mnkx->nkx", powers, a), np.nan)


def corners_at_common_instants(
    clocks: Clocks, found: Sequence[Mapping[int, np.ndarray]], symmetries: np.ndarray
) -> list[dict[int, np.ndarray]]:
    """The corners (K, 2) of a board by image of the slowest camera, from those by image of each camera.

    The corners of a board that looks the same from both ends are numbered from the same end in images that follow one another.
    """
    numbers = [np.array(sorted(of_view), dtype=np.int64) for of_view in found]
    xy = [_in_one_order(own, np.stack([of_view[n] for n in own.tolist()]), symmetries) for own, of_view in zip(numbers, found)]
    frames, every = at_common_instants(clocks, numbers, xy)
    shown = np.isfinite(every[..., 0]).any(axis=2)
    return [{int(frames[n]): every[n, c] for n in np.flatnonzero(shown[:, c])} for c in range(len(found))]


def _in_one_order(numbers: np.ndarray, xy_px: np.ndarray, symmetries: np.ndarray) -> np.ndarray:
    """Corners (n, K, 2), each image in the order that is nearest to that of the image before."""
    ordered = xy_px.copy()
    for n in np.flatnonzero(np.diff(numbers) == 1) + 1 if len(symmetries) > 1 else ():
        off = [float(np.nanmean(np.abs(ordered[n][order] - ordered[n - 1]))) for order in symmetries]
        ordered[n] = ordered[n][symmetries[int(np.argmin(off))]]
    return ordered
