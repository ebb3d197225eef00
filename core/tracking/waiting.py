"""Lost points that wait: carried along by their neighbours, they are taken up again where their key template reappears.

A point is lost when a frame contradicts it, or when something passes before it. Its surface goes on, so for a few frames its place is
predicted by the rigid motion of the tracked points about it (neighbours.py), frame after frame. There the key template is matched in the
reference view and from it the other views, and the point is the same again if

    ρ ≥ ρ_min ,   |X − X̂| ≤ √a d   after a frames,   and the rays meet                                        (1)

with d the deviation from neighbours that the filters allow in one frame.

Where a fitted body is known (`Guide`), it carries a point on when its neighbours are gone too, or too much time has passed: the point goes
with its bone, and is looked for only while the body does not hide it.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..images.sampling import SplineImage
from .neighbours import common_motion, nearest_neighbours
from .settings import TrackingSettings, TrackStatus
from .step import TEMPLATE_SIGMA_PX, TrackingView, intersect, match_spatially
from .templates import Templates
from .tracked import TrackedFrame, joined, nothing, rows_of

HARMLESS_M = 2e-3  # scatter of neighbours about their common motion
MIN_MEMBERS = 4


class Guide(Protocol):
    """What a moving body knows of points that nobody sees."""

    @property
    def key(self) -> str:
        """A digest of the body and its motion."""

    @property
    def longest_frames(self) -> int:
        """So long a point is carried."""

    def bind(self, frame: int, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The bone (N,) of each point (N, 3), −1 where it has none, and the point in its frame (N, 3)."""

    def places(self, frame: int, bone: np.ndarray, own_m: np.ndarray) -> np.ndarray:
        """Where points of bones are in a frame (N, 3), NaN where that is not known."""

    def sees(self, frame: int, xyz_m: np.ndarray) -> np.ndarray:
        """Which points (N,) the body does not hide from the reference camera."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Waiting:
    """N lost points: as they were last seen, but for `xyz_m`, which goes with the neighbours or the body."""

    points: TrackedFrame
    frames: np.ndarray  # (N,) since when, in frames
    bone: np.ndarray  # (N,) that carries it, −1 for none
    own_m: np.ndarray  # (N, 3) in the bone's frame
    by_body: np.ndarray  # (N,) whether it is the body that says where it is now

    def after(self, current: TrackedFrame, tracked: TrackedFrame, settings: TrackingSettings, guide: Guide | None = None) -> "Waiting":
        """Those that wait when `current` has become `tracked`: with the newly lost, without the regained and those that waited too long."""
        lost = np.isin(current.identity, tracked.ended[tracked.reason != TrackStatus.LEFT_IMAGE])
        still = ~np.isin(self.points.identity, tracked.identity)
        points = joined(self.points.select(still), current.select(lost))
        n = len(points.identity)
        since, bone, own = np.zeros(n, dtype=np.int64), np.full(n, -1, dtype=np.int64), np.zeros((n, 3))
        at = rows_of(self.points.identity, points.identity)
        old, new = at >= 0, at < 0
        since[old], bone[old], own[old] = self.frames[at[old]], self.bone[at[old]], self.own_m[at[old]]
        if guide is not None:
            bone[new], own[new] = guide.bind(current.frame, points.xyz_m[new])
        waiting = Waiting(points=points, frames=since, bone=bone, own_m=own, by_body=np.zeros(n, dtype=bool))
        return waiting.carried(current, tracked, settings, guide)

    def carried(self, current: TrackedFrame, tracked: TrackedFrame, settings: TrackingSettings, guide: Guide | None = None) -> "Waiting":
        """Moved with the points tracked from one frame to the other, or with the body; without those that nobody carries or that waited
        too long."""
        since = self.frames + abs(tracked.frame - current.frame)
        xyz = self._with_neighbours(current, tracked, settings)
        xyz[since > settings.wait_frames] = np.nan
        rest = np.isnan(xyz[:, 0])
        if guide is not None:
            rest &= (self.bone >= 0) & (since <= guide.longest_frames)
            xyz[rest] = guide.places(tracked.frame, self.bone[rest], self.own_m[rest])
        good = np.flatnonzero(np.isfinite(xyz).all(axis=1))
        return Waiting(
            points=replace(self.points.select(good), xyz_m=xyz[good], frame=tracked.frame),
            frames=since[good], bone=self.bone[good], own_m=self.own_m[good], by_body=rest[good],
        )  # fmt: skip

    def _with_neighbours(self, current: TrackedFrame, tracked: TrackedFrame, settings: TrackingSettings) -> np.ndarray:
        """Where (N, 3) the neighbours that were tracked take the points, NaN where there are none."""
        at = rows_of(tracked.identity, current.identity)
        before, after = current.xyz_m[at >= 0], tracked.xyz_m[at[at >= 0]]
        xyz = np.full((len(self.frames), 3), np.nan)
        if len(before) and len(xyz):
            rows, there = nearest_neighbours(self.points.xyz_m, before, settings.neighbourhood_m)
            goal = common_motion(self.points.xyz_m, before[rows], after[rows], there.astype(np.float64), HARMLESS_M)
            good = goal.members >= MIN_MEMBERS
            xyz[good] = goal.xyz_m[good]
        return xyz

    def in_sight(self, guide: Guide | None) -> "Waiting":
        """Without the points that the body, which says where they are, hides."""
        if guide is None or not self.by_body.any():
            return self
        good = ~self.by_body
        good[self.by_body] = guide.sees(self.points.frame, self.points.xyz_m[self.by_body])
        rows = np.flatnonzero(good)
        points, by_body = self.points.select(rows), self.by_body[rows]
        return Waiting(points=points, frames=self.frames[rows], bone=self.bone[rows], own_m=self.own_m[rows], by_body=by_body)

    def retaken(self, view: TrackingView, templates: Templates, images: list[SplineImage]) -> TrackedFrame:
        """Those of the carried points that are seen again in the frame of `images`, the splines of all views.  (1)"""
        p, ref = self.points, view.reference
        if not len(p.identity):
            return p
        centre = np.stack([view.rows.from_frame(camera.project(p.xyz_m)) for camera in view.cameras], axis=1)
        key = templates.match(p.identity, images[ref], centre[:, ref], p.key_shape)
        if view.relief is not None:
            key = view.relief.corrected(key, p.key_relief)
        status = np.full(p.xy.shape[:2], TrackStatus.MEASURED, dtype=np.int8)
        status[~(key.ok & (key.correlation >= view.tracking.drift_correlation)), ref] = TrackStatus.NOT_FOUND
        shift = key.xy - centre[:, ref]
        at = [key.xy if k == ref else centre[:, k] + np.einsum("nij,nj->ni", p.shape[:, k], shift) for k in range(len(view.cameras))]
        spatial = match_spatially(view, p, at, images, status)
        xy, covariance, shape = np.stack(at, axis=1), np.tile(np.eye(2) * TEMPLATE_SIGMA_PX**2, (*status.shape, 1, 1)), p.shape.copy()
        for k, s in zip(view.others, spatial):
            xy[:, k], covariance[:, k], shape[:, k] = s.xy, s.covariance, s.shape
        regained = replace(p, key_shape=key.shape, drift=key.covariance)
        found, verdict = intersect(view, regained, xy, covariance, shape, status)
        far = np.linalg.norm(found.xyz_m - p.xyz_m, axis=1) > np.sqrt(self.frames) * 1e-3 * view.tracking.max_deviation_mm
        return found.select((verdict == TrackStatus.MEASURED) & ~far)


def nobody(views: int, frame: int = 0) -> Waiting:
    """Nobody waits."""
    none = np.zeros(0, dtype=np.int64)
    return Waiting(points=nothing(frame, views), frames=none, bone=none, own_m=np.zeros((0, 3)), by_body=np.zeros(0, dtype=bool))
