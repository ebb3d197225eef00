"""The measured frames of a take: each is read from its checkpoint on access, and none stays in memory.

A long recording thus needs no more memory than a short one. Figures of all frames (how many points, how precise) are summarised when a
frame is measured.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median_low
from typing import overload

import numpy as np

from ..foundation.arrays import LazySequence
from ..foundation.errors import InputError
from ..geometry.robust import finite_median
from ..results.folder import Results
from ..take.footage import Footage
from .cloud import PointCloud
from .measure import MeasuredFrame, read_checkpoint


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameSummary:
    """Figures of a measured frame that stay in memory. Medians are NaN where it has no points."""

    frame: int
    key: str  # of its checkpoint
    points: int
    limit_px: float  # by which rays were allowed to miss each other
    smoothed_px: float  # sigma of the Gaussian that took noise away, 0 without one
    residual_px: float  # median
    sigma_m: float  # median


def summary_of(m: MeasuredFrame) -> FrameSummary:
    """The summary of a frame that was measured."""
    residual, sigma = finite_median(m.cloud.residual_px), finite_median(m.cloud.sigma_m)
    return FrameSummary(
        frame=m.frame,
        key=m.key,
        points=len(m.cloud.xyz_m),
        limit_px=m.field.limit_px,
        smoothed_px=m.smoothed_px,
        residual_px=residual,
        sigma_m=sigma,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredFrames(Sequence[MeasuredFrame]):
    """Measured frames in the order of time. Reading one raises InputError if its checkpoint was deleted."""

    footage: Footage
    results: Results
    summaries: tuple[FrameSummary, ...] = ()

    def __len__(self) -> int:
        return len(self.summaries)

    @overload
    def __getitem__(self, index: int) -> MeasuredFrame: ...
    @overload
    def __getitem__(self, index: slice) -> "MeasuredFrames": ...
    def __getitem__(self, index: int | slice) -> "MeasuredFrame | MeasuredFrames":
        if isinstance(index, slice):
            return MeasuredFrames(footage=self.footage, results=self.results, summaries=self.summaries[index])
        summary = self.summaries[index]
        measured = read_checkpoint(self.footage, self.results, summary.frame, summary.key)
        if measured is None:
            raise InputError(f"The checkpoint of frame {summary.frame} in {self.results.path('cache')} was deleted. Run again.")
        return measured

    def __iter__(self) -> Iterator[MeasuredFrame]:
        return (self[i] for i in range(len(self)))

    @property
    def limit_px(self) -> float:
        """The median over the frames of the distance by which rays were allowed to miss each other."""
        return float(np.median([s.limit_px for s in self.summaries]))

    @property
    def smoothed_px(self) -> float:
        """The sigma of the Gaussian that took noise away in most of the frames, or 0."""
        return median_low([s.smoothed_px for s in self.summaries]) if self.summaries else 0.0

    def clouds(self, corrected: Callable[[PointCloud], PointCloud]) -> Sequence[PointCloud]:
        """The frames' clouds, each read and corrected on access."""
        return LazySequence(self, lambda measured: corrected(measured.cloud))
