"""Reacquisition of lost points: a lost point is carried along by its neighbours until its key template reappears.

A point is lost when a frame contradicts it, or when something moves in front of it. For a few frames its position is then predicted by the
rigid motion of the tracked points about it (neighbours.py), frame after frame. At the predicted position the key template is matched in the
reference view, and from there in the other views. The point resumes its trajectory if

    ρ ≥ ρ_min ,   |X − X̂| ≤ √a d   after a frames,   and the rays meet                                        (1)

with d the deviation from neighbours that the filters allow in one frame.

Where a fitted body exists (`Guide`), it carries a point whose neighbours are lost as well, or which has been lost for too long: the point
moves with its bone, and is searched for only while the body does not occlude it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..images.sampling import SplineImage
from .neighbours import common_motion, nearest_neighbours
from .settings import TrackingSettings, TrackStatus
from .step import HARMLESS_M, TrackingView, measured_at
from .templates import Templates
from .tracked import TrackedFrame, joined, nothing, rows_of

MIN_MEMBERS = 4  # neighbours that share a motion which can carry a point


class Guide(Protocol):
    """A moving body that predicts where occluded points are."""

    @property
    def key(self) -> str:
        """A digest of the body and its motion."""

    @property
    def longest_frames(self) -> int:
        """For how many frames a point is carried."""

    def bind(self, frame: int, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The bone (N,) of each point (N, 3), −1 where it has none, and the point in the bone's coordinates (N, 3)."""

    def places(self, frame: int, bone: np.ndarray, own_m: np.ndarray) -> np.ndarray:
        """World positions (N, 3) in a frame of points in their bones' coordinates; NaN where the frame has no pose."""

    def visible(self, frame: int, xyz_m: np.ndarray) -> np.ndarray:
        """Which points (N,) the body does not occlude in the reference camera."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LostPoints:
    """N lost points: as they were last visible, except for `xyz_m`, which moves with the neighbours or the body."""

    points: TrackedFrame
    lost_frames: np.ndarray  # (N,) frames since the point was last visible
    bone: np.ndarray  # (N,) that carries it, −1 for none
    own_m: np.ndarray  # (N, 3) in the bone's coordinates
    by_body: np.ndarray  # (N,) whether the body predicts its position now

    def after(self, current: TrackedFrame, tracked: TrackedFrame, settings: TrackingSettings, guide: Guide | None = None) -> "LostPoints":
        """The points that are lost after `current` has become `tracked`: without those reacquired, and without those lost for too long."""
        newly_lost = np.isin(current.identity, tracked.ended[tracked.reason != TrackStatus.LEFT_IMAGE])
        still = ~np.isin(self.points.identity, tracked.identity)
        points = joined(self.points.select(still), current.select(newly_lost))
        n = len(points.identity)
        lost_frames, bone, own = np.zeros(n, dtype=np.int64), np.full(n, -1, dtype=np.int64), np.zeros((n, 3))
        at = rows_of(self.points.identity, points.identity)
        old, new = at >= 0, at < 0
        lost_frames[old], bone[old], own[old] = self.lost_frames[at[old]], self.bone[at[old]], self.own_m[at[old]]
        if guide is not None:
            bone[new], own[new] = guide.bind(current.frame, points.xyz_m[new])
        lost = LostPoints(points=points, lost_frames=lost_frames, bone=bone, own_m=own, by_body=np.zeros(n, dtype=bool))
        return lost.carried(current, tracked, settings, guide)

    def carried(self, current: TrackedFrame, tracked: TrackedFrame, settings: TrackingSettings, guide: Guide | None = None) -> "LostPoints":
        """Moved with the points tracked from one frame to the other, or with the body; points that neither carries are dropped, and so are
        those lost for too long."""
        lost_frames = self.lost_frames + abs(tracked.frame - current.frame)
        xyz = self._with_neighbours(current, tracked, settings)
        xyz[lost_frames > settings.wait_frames] = np.nan
        rest = np.isnan(xyz[:, 0])
        if guide is not None:
            rest &= (self.bone >= 0) & (lost_frames <= guide.longest_frames)
            xyz[rest] = guide.places(tracked.frame, self.bone[rest], self.own_m[rest])
        good = np.flatnonzero(np.isfinite(xyz).all(axis=1))
        return LostPoints(
            points=replace(self.points.select(good), xyz_m=xyz[good], frame=tracked.frame),
            lost_frames=lost_frames[good],
            bone=self.bone[good],
            own_m=self.own_m[good],
            by_body=rest[good],
        )

    def _with_neighbours(self, current: TrackedFrame, tracked: TrackedFrame, settings: TrackingSettings) -> np.ndarray:
        """Positions (N, 3) to which the tracked neighbours carry the points, NaN where there are too few."""
        at = rows_of(tracked.identity, current.identity)
        before, after = current.xyz_m[at >= 0], tracked.xyz_m[at[at >= 0]]
        xyz = np.full((len(self.lost_frames), 3), np.nan)
        if len(before) and len(xyz):
            rows, there = nearest_neighbours(self.points.xyz_m, before, settings.neighbourhood_m)
            goal = common_motion(self.points.xyz_m, before[rows], after[rows], there.astype(np.float64), HARMLESS_M)
            good = goal.members >= MIN_MEMBERS
            xyz[good] = goal.xyz_m[good]
        return xyz

    def in_sight(self, guide: Guide | None) -> "LostPoints":
        """Without the points carried by the body that it occludes."""
        if guide is None or not self.by_body.any():
            return self
        good = ~self.by_body
        good[self.by_body] = guide.visible(self.points.frame, self.points.xyz_m[self.by_body])
        rows = np.flatnonzero(good)
        points, by_body = self.points.select(rows), self.by_body[rows]
        return LostPoints(points=points, lost_frames=self.lost_frames[rows], bone=self.bone[rows], own_m=self.own_m[rows], by_body=by_body)

    def reacquired(self, view: TrackingView, templates: Templates, images: Sequence[SplineImage]) -> TrackedFrame:
        """Those of the carried points that are visible again in the frame of `images`, the splines of all views.  (1)"""
        p, ref = self.points, view.reference
        if not len(p.identity):
            return p
        centre = view.projected(p.xyz_m)
        key = templates.match(p.identity, images[ref], centre[:, ref], p.key_shape)
        if view.curvature is not None:
            key = view.curvature.corrected(key, p.key_local_surface)
        status = np.full(p.xy.shape[:2], TrackStatus.MEASURED, dtype=np.int8)
        status[~(key.ok & (key.correlation >= view.tracking.drift_correlation)), ref] = TrackStatus.NOT_FOUND
        shift = key.xy - centre[:, ref]
        at = [key.xy if k == ref else centre[:, k] + np.einsum("nij,nj->ni", p.shape[:, k], shift) for k in range(len(view.cameras))]
        found, verdict = measured_at(view, replace(p, key_shape=key.shape, drift=key.covariance), at, images, status)
        far = np.linalg.norm(found.xyz_m - p.xyz_m, axis=1) > np.sqrt(self.lost_frames) * 1e-3 * view.tracking.max_deviation_mm
        return found.select((verdict == TrackStatus.MEASURED) & ~far)


def none_lost(views: int, frame: int = 0) -> LostPoints:
    """No lost points."""
    none = np.zeros(0, dtype=np.int64)
    return LostPoints(points=nothing(frame, views), lost_frames=none, bone=none, own_m=np.zeros((0, 3)), by_body=np.zeros(0, dtype=bool))
