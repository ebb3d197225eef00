"""Trajectories as observations: for each pair of successive frames the points tracked in both, thinned, each on its limb."""

from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import Protocol, Self

import numpy as np

from ..observations import MaterialSteps, Steps, StepsFromFixed
from ..segmentation import SegmentationCache, segment
from ..settings import FitSettings
from ..state import BodyState
from .cloud_points import VARIANCE_FLOOR_M2, CloudPoints

SPACING_M = 0.012  # of the cubes with one tracked point each
UNKNOWN_SIGMA_M = 0.002  # of a step, where the trajectories have none


class Trajectories(Protocol):
    """The fields of trajectories that the fit reads."""

    @property
    def frames(self) -> np.ndarray:
        """(T,) frame numbers of the take."""

    @property
    def xyz_m(self) -> np.ndarray:
        """(T, N, 3) world; NaN: not measured."""

    @property
    def sigma_m(self) -> np.ndarray:
        """(T, N)."""


class PointTracks(Protocol):
    """Points that were followed from frame to frame, in the order of the fit's frames."""

    def stretch(self, frames: Sequence[int]) -> Self:
        """Those of some of the frames; their points are assigned to limbs anew."""

    def steps(self, t: int, a: BodyState, b: BodyState) -> Steps | None:
        """The observations of the points on the same limb in frame t (body `a`) and t + 1 (body `b`)."""

    def from_fixed(self, t: int, other: BodyState, backwards: bool) -> StepsFromFixed | None:
        """The same for one body, while the `other` is fixed: that of frame t, or backwards that of frame t + 1."""

    def forget(self) -> None:
        """Assign points to limbs anew: what follows must not depend on what was computed before."""


class MaterialTracks:
    """Tracked points in the order of the fit's frames."""

    def __init__(self, trajectories: Trajectories, frames: Sequence[int], surface: np.ndarray, settings: FitSettings) -> None:
        where = {int(f): i for i, f in enumerate(trajectories.frames)}
        xyz, sigma = np.asarray(trajectories.xyz_m, dtype=np.float64), np.asarray(trajectories.sigma_m, dtype=np.float64)
        self._xyz = [xyz[where[f]] if f in where else np.full(xyz.shape[1:], np.nan) for f in frames]
        self._sigma = [sigma[where[f]] if f in where else np.full(xyz.shape[1], np.nan) for f in frames]
        self._surface, self._settings = surface, settings
        self._cache = SegmentationCache()
        self._pairs = [self._pair(t) for t in range(len(frames) - 1)]

    def stretch(self, frames: Sequence[int]) -> "MaterialTracks":
        """Those of some of the frames; their points are assigned to limbs anew."""
        part, none = copy(self), (np.zeros(0, dtype=np.intp), np.zeros(0))
        part._xyz, part._sigma = [self._xyz[t] for t in frames], [self._sigma[t] for t in frames]
        part._pairs = [self._pairs[a] if b == a + 1 else none for a, b in zip(frames, frames[1:])]
        part.forget()
        return part

    def steps(self, t: int, a: BodyState, b: BodyState) -> Steps | None:
        """See `PointTracks`."""
        return self._steps(t, a, b)

    def from_fixed(self, t: int, other: BodyState, backwards: bool) -> StepsFromFixed | None:
        """See `PointTracks`."""
        steps = self._steps(t, None, other) if backwards else self._steps(t, other, None)
        return None if steps is None else StepsFromFixed(steps=steps, other=other, backwards=backwards)

    def _steps(self, t: int, a: BodyState | None, b: BodyState | None) -> MaterialSteps | None:
        """`steps`; None: a body that is not yet known."""
        rows, sigma = self._pairs[t]
        found = [
            self._cache.get((t, i), state, partial(self._limbs, i, rows, sigma, state))
            for i, state in ((t, a), (t + 1, b))
            if state is not None
        ]
        keep = np.flatnonzero((found[0] >= 0) & (found[0] == found[-1]))
        if not len(keep):
            return None
        own, skin = sigma[keep] ** 2 + VARIANCE_FLOOR_M2, self._settings.track_sigma_m**2
        in_patch = max(1.0, (self._settings.model_patch_m / SPACING_M) ** 2)
        return MaterialSteps(
            from_m=self._xyz[t][rows[keep]],
            to_m=self._xyz[t + 1][rows[keep]],
            bone=found[0][keep],
            sigma_m=np.sqrt(own + skin),
            variance_inflation=np.repeat((own + in_patch * skin) / (own + skin), 3),
        )

    def forget(self) -> None:
        """Assign points to limbs anew: what follows must not depend on what was computed before."""
        self._cache = SegmentationCache()

    def _limbs(self, t: int, rows: np.ndarray, sigma: np.ndarray, state: BodyState) -> np.ndarray:
        """The bone of each point in one frame, −1 for none."""
        points = CloudPoints(frame=t, xyz_m=self._xyz[t][rows], normals=np.zeros((len(rows), 3)), sigma_m=sigma)
        mine, bone = segment(points, state, self._surface, self._settings.gate_m)
        limbs = np.full(len(rows), -1)
        limbs[mine] = bone
        return limbs

    def _pair(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Points tracked in frames t and t + 1, the first in each cell, and the sigma of their steps."""
        tracked = np.flatnonzero(np.isfinite(self._xyz[t]).all(axis=1) & np.isfinite(self._xyz[t + 1]).all(axis=1))
        cells = np.floor(self._xyz[t][tracked] / SPACING_M).astype(np.int64)
        first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
        rows = tracked[first]
        return rows, np.nan_to_num(np.hypot(self._sigma[t][rows], self._sigma[t + 1][rows]), nan=UNKNOWN_SIGMA_M)
