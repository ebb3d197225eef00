"""The input of a fit in one value: clouds, trajectories, contours, clicks, keypoints, and what the user specifies about the joints."""

import tempfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import IO, Protocol, overload

import numpy as np

from ...foundation.arrays import frozen
from ...foundation.errors import InputError
from ...geometry.rig import Rig
from ...tracking.image_points import ImageStep
from .cloud_points import Cloud
from .material_tracks import Trajectories
from .start_joints import StartJoints

UNKNOWN = 1  # of stored distances from the person: whether the cell shows the background; the cells next to the person have more
IN_MEMORY = 1 << 24  # bytes of packed images; more go to a temporary file
ClickedAt = Mapping[str, Mapping[str, Sequence[float]]]  # joint -> view -> (x, y) full-frame pixels


Outline = tuple[np.ndarray, np.ndarray, np.ndarray]  # vertices (V, 2) px full frame; normals (V, 2) outwards; sigmas (V,) px along them


class Outlines(Protocol):
    """The outline of the person in one view, over frames."""

    @property
    def view(self) -> str:
        """The view's name."""

    def of_frame(self, frame: int) -> Outline | None:
        """That of a frame of the take; None without one."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewContours:
    """Outlines in memory: V vertices of all frames."""

    view: str
    frame: np.ndarray  # (V,) the take's frame numbers
    xy_px: np.ndarray  # (V, 2) full frame
    normal: np.ndarray  # (V, 2) unit, outwards
    sigma_px: np.ndarray  # (V,) along the normal

    def __post_init__(self) -> None:
        v = len(self.frame)
        object.__setattr__(self, "frame", frozen(self.frame, (v,), np.int64, "frame"))
        for name, shape in dict(xy_px=(v, 2), normal=(v, 2), sigma_px=(v,)).items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name=name))

    def of_frame(self, frame: int) -> Outline | None:
        """See `Outlines`."""
        rows = np.flatnonzero(self.frame == frame)
        return (self.xy_px[rows], self.normal[rows], self.sigma_px[rows]) if len(rows) else None


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class JointPlaces:
    """K places of joints from another system: in the pixels of a view (K, 2), or in space (K, 3) [m] where `view` is empty."""

    view: str
    frame: np.ndarray  # (K,) the take's frame numbers
    joint: tuple[str, ...]  # K
    place: np.ndarray  # (K, 2) or (K, 3)
    sigma: np.ndarray  # (K,) px or m

    def __post_init__(self) -> None:
        k = len(self.frame)
        object.__setattr__(self, "frame", frozen(self.frame, (k,), np.int64, "frame"))
        object.__setattr__(self, "place", frozen(self.place, (k, 2 if self.view else 3), name="place"))
        object.__setattr__(self, "sigma", frozen(self.sigma, (k,), name="sigma"))
        if len(self.joint) != k:
            raise ValueError("every place needs its joint")


class Packed(Sequence[np.ndarray]):
    """Small images (h, w) uint8 of one size, compressed: they are mostly flat. Those of a long recording are in a temporary file."""

    def __init__(self, images: Iterable[np.ndarray] = ()) -> None:
        self._file: IO[bytes] = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY)
        self._ends: list[int] = [0]
        self._size: tuple[int, ...] = (0, 0)
        for image in images:
            self.append(image)

    def append(self, image: np.ndarray) -> None:
        """Append an image.

        Raises:
            InputError: the disk is full.
        """
        self._size = image.shape
        try:
            self._file.seek(self._ends[-1])
            self._ends.append(self._ends[-1] + self._file.write(zlib.compress(image.astype(np.uint8).tobytes(), 1)))
        except OSError as error:
            place = tempfile.gettempdir()
            raise InputError(f"Cannot write to {place}: {error.strerror or error}. Free some space there, or set TMPDIR.") from error

    def __len__(self) -> int:
        return len(self._ends) - 1

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, index: slice) -> list[np.ndarray]: ...
    def __getitem__(self, index: int | slice) -> np.ndarray | list[np.ndarray]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        start, end = self._ends[:-1][index], self._ends[1:][index]
        self._file.seek(start)
        return np.frombuffer(zlib.decompress(self._file.read(end - start)), np.uint8).reshape(self._size)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BackgroundDistances:
    """The distance of every place of a view from the person: 0 inside the person's outline, `UNKNOWN` where that is not known.

    Node (j, i) is the middle of a cell of `step_px` × `step_px` pixels. Distances are stored in steps of `unit_px`.
    """

    view: str
    frame: np.ndarray  # (T,) the take's frame numbers
    distance: Packed  # T of (h, w)
    step_px: int
    unit_px: float
    estimated: bool = False  # from what stays the same in the images; not from masks, drawn outlines or an image of the background

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame", frozen(self.frame, (len(self.distance),), np.int64, "frame"))

    def of_frame(self, frame: int) -> np.ndarray | None:
        """(h, w) of one frame; None if there is none."""
        at = np.flatnonzero(self.frame == frame)
        return self.distance[at[0]] if len(at) else None


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FitInput:
    """A recording: `clouds` in the order of time, `time_s` (T,) their times, clicks by frame number; `model`: see `Take.body_model`."""

    rig: Rig
    model: str
    clouds: Sequence[Cloud]
    time_s: np.ndarray
    clicks: Mapping[int, ClickedAt] = field(default_factory=dict)
    click_frame: int | None = None  # where the fit begins; None: where most joints are located
    trajectories: Trajectories | None = None
    image_tracks: Mapping[str, Sequence[ImageStep]] = field(default_factory=dict)  # without trajectories: T − 1 steps of each view
    contours: Sequence[Outlines] = ()
    keypoints: Sequence[JointPlaces] = ()
    background: Sequence[BackgroundDistances] = ()
    locked: Sequence[str] = ()  # degrees of freedom that stay at their rest value
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # rad, by degree of freedom
    frames: Sequence[int] = ()  # the take's numbers (T); without them those of the clouds
    start: StartJoints | None = None  # where the fit begins without clicks, if that was found before

    def __post_init__(self) -> None:
        times = np.asarray(self.time_s, dtype=np.float64)
        if times.shape != (len(self.clouds),) or not len(times) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError(
                f"The fit needs a growing time for each of the {len(self.clouds)} frames; check the frame rate and the frames of the take."
            )
        object.__setattr__(self, "time_s", frozen(times, times.shape))
        object.__setattr__(self, "frames", [int(f) for f in self.frames or (cloud.frame for cloud in self.clouds)])
        for frame in self.clicks:
            if frame not in self.frames:
                raise InputError(f"The joints are clicked in frame {frame}, which was not measured; measure it, or click in another frame.")
