"""Points with names over time: what TRC, C3D and CSV files hold, in the world's metres, Z up.

Axes of other worlds are given by the rows of a rotation: `file = rotation @ world`. In OpenSim's, X is forward, Y up and Z to the
right of a person who faces −Y here.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..values import frozen

AXES = {
    "Z up": np.eye(3),
    "Y up": np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]),
    "OpenSim": np.array([[0, -1.0, 0], [0, 0, 1.0], [-1.0, 0, 0]]),
}
UNITS_M = {"m": 1.0, "meters": 1.0, "metres": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "inch": 0.0254}
MOST_VALUES = 1 << 28  # 2 GB of float64


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Markers:
    """N points over T frames; NaN where a point is not known."""

    names: tuple[str, ...]
    fps: float
    frames: np.ndarray  # (T,) integer frame numbers
    xyz_m: np.ndarray  # (T, N, 3) world
    sigma_m: np.ndarray  # (T, N); NaN: not known

    def __post_init__(self) -> None:
        t, n = len(self.frames), len(self.names)
        object.__setattr__(self, "frames", frozen(self.frames, (t,), np.int64, "frames"))
        object.__setattr__(self, "xyz_m", frozen(self.xyz_m, (t, n, 3), float, "xyz_m"))
        object.__setattr__(self, "sigma_m", frozen(self.sigma_m, (t, n), float, "sigma_m"))
        if t == 0 or n == 0:
            raise InputError("There are no points in any frame; choose a file with points.")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise InputError(f"The points have {self.fps} frames per second; that must be a positive number.")


def metres_per(unit: str, where: object) -> float:
    """The factor of a unit's name.

    Raises:
        InputError: nobody knows that unit.
    """
    factor = UNITS_M.get(unit.strip().lower())
    if factor is None:
        raise InputError(f"{where} is in the unit “{unit.strip()[:20]}”, which is not known; write it in m or mm.")
    return factor


def axes_of(name: str) -> np.ndarray:
    """The rotation (3, 3) from the world to a file's axes.

    Raises:
        InputError: there are no such axes.
    """
    if name not in AXES:
        raise InputError(f"There are no axes “{name}”; choose one of {', '.join(AXES)}.")
    return AXES[name]


def check_size(counts: Sequence[int], available: int, where: object) -> None:
    """See that a header's counts can be true, before memory is asked for.

    Raises:
        InputError: they cannot.
    """
    total = 1
    for count in counts:
        total *= max(int(count), 0)
    if total == 0 or total > min(MOST_VALUES, available):
        promised = " × ".join(map(str, counts))
        raise InputError(f"{where} promises {promised} values but cannot hold them; it is damaged, export it again.")


def filled(markers: Markers) -> Markers:
    """Gaps filled on straight lines, and the ends with the nearest place; points that are never known are left out.

    Raises:
        InputError: no point is ever known.
    """
    known = np.isfinite(markers.xyz_m).all(axis=2)
    keep = np.flatnonzero(known.any(axis=0))
    if not len(keep):
        raise InputError("None of the points is ever known; choose a file with points.")
    xyz = np.stack(
        [
            np.stack([np.interp(markers.frames, markers.frames[known[:, n]], markers.xyz_m[known[:, n], n, i]) for i in range(3)], axis=1)
            for n in keep
        ],
        axis=1,
    )
    return Markers(
        names=tuple(markers.names[n] for n in keep), fps=markers.fps, frames=markers.frames, xyz_m=xyz, sigma_m=markers.sigma_m[:, keep]
    )
