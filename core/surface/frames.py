"""The measured frames of a take, however many: each is read from its checkpoint when it is asked for, and none is kept.

A long recording thus needs no more memory than a short one. What is asked of all frames at once (how many points, how good) is noted when
a frame is measured.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from ..foundation.arrays import LazySequence
from ..foundation.errors import InputError
from ..results.folder import Results
from ..take.take import Footage
from .cloud import PointCloud
from .measure import MeasuredFrame, read_checkpoint


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameNote:
    """What is remembered of a measured frame. Medians are NaN where it has no points."""

    frame: int
    key: str  # of its checkpoint
    points: int
    limit_px: float  # by how much rays were allowed to miss
    residual_px: float  # median
    sigma_m: float  # median


def note_of(m: MeasuredFrame) -> FrameNote:
    """The note of a frame that was measured."""
    residual, sigma = (float(np.median(a)) if len(a) else np.nan for a in (m.cloud.residual_px, m.cloud.sigma_m))
    return FrameNote(frame=m.frame, key=m.key, points=len(m.cloud.xyz_m), limit_px=m.field.limit_px, residual_px=residual, sigma_m=sigma)


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredFrames(Sequence[MeasuredFrame]):
    """Measured frames in the order of time. Reading one raises InputError when its checkpoint was taken away."""

    footage: Footage
    results: Results
    notes: tuple[FrameNote, ...] = ()

    def __len__(self) -> int:
        return len(self.notes)

    @overload
    def __getitem__(self, index: int) -> MeasuredFrame: ...
    @overload
    def __getitem__(self, index: slice) -> "MeasuredFrames": ...
    def __getitem__(self, index: int | slice) -> "MeasuredFrame | MeasuredFrames":
        if isinstance(index, slice):
            return MeasuredFrames(footage=self.footage, results=self.results, notes=self.notes[index])
        note = self.notes[index]
        measured = read_checkpoint(self.footage, self.results, note.frame, note.key)
        if measured is None:
            raise InputError(f"The checkpoint of frame {note.frame} in {self.results.path('cache')} was taken away; run again.")
        return measured

    def __iter__(self) -> Iterator[MeasuredFrame]:
        return (self[i] for i in range(len(self)))

    @property
    def limit_px(self) -> float:
        """The usual distance by which rays were allowed to miss."""
        return float(np.median([n.limit_px for n in self.notes]))

    def clouds(self, corrected: Callable[[PointCloud], PointCloud]) -> Sequence[PointCloud]:
        """The frames' clouds, each read and corrected when it is asked for."""
        return LazySequence(self, lambda measured: corrected(measured.cloud))
