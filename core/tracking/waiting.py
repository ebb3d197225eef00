"""Lost points that wait: carried along by their neighbours, they are taken up again where their key template reappears.

A point is lost when a frame contradicts it, or when something passes before it. Its surface goes on, so for a few frames its place is
predicted by the rigid motion of the tracked points about it (neighbours.py), frame after frame. There the key template is matched in the
reference view and from it the other views, and the point is the same again if

    ρ ≥ ρ_min ,   |X − X̂| ≤ √a d   after a frames,   and the rays meet                                        (1)

with d the deviation from neighbours that the filters allow in one frame.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..images.sampling import SplineImage
from .neighbours import common_motion, nearest_neighbours
from .settings import TrackingSettings, TrackStatus
from .step import TEMPLATE_SIGMA_PX, TrackingView, intersect, match_spatially
from .templates import Templates
from .tracked import TrackedFrame, joined, nothing, rows_of

HARMLESS_M = 2e-3  # scatter of neighbours about their common motion
MIN_MEMBERS = 4


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Waiting:
    """N lost points: as they were last seen, but for `xyz_m`, which goes with the neighbours."""

    points: TrackedFrame
    frames: np.ndarray  # (N,) since when, in frames

    def after(self, current: TrackedFrame, tracked: TrackedFrame, settings: TrackingSettings) -> "Waiting":
        """Those that wait when `current` has become `tracked`: with the newly lost, without the regained and those that waited too long."""
        lost = np.isin(current.identity, tracked.ended[tracked.reason != TrackStatus.LEFT_IMAGE])
        still = ~np.isin(self.points.identity, tracked.identity)
        points = joined(self.points.select(still), current.select(lost))
        since = np.zeros(len(points.identity), dtype=np.int64)
        at = rows_of(self.points.identity, points.identity)
        since[at >= 0] = self.frames[at[at >= 0]]
        return Waiting(points=points, frames=since).carried(current, tracked, settings)

    def carried(self, current: TrackedFrame, tracked: TrackedFrame, settings: TrackingSettings) -> "Waiting":
        """Moved with the points tracked from one frame to the other; without those that nobody carries or that waited too long."""
        at = rows_of(tracked.identity, current.identity)
        before, after = current.xyz_m[at >= 0], tracked.xyz_m[at[at >= 0]]
        since = self.frames + abs(tracked.frame - current.frame)
        if not len(before) or not len(since):
            return nobody(self.points.xy.shape[1], tracked.frame)
        rows, there = nearest_neighbours(self.points.xyz_m, before, settings.neighbourhood_m)
        goal = common_motion(self.points.xyz_m, before[rows], after[rows], there.astype(np.float64), HARMLESS_M)
        good = (since <= settings.wait_frames) & (goal.members >= MIN_MEMBERS) & np.isfinite(goal.xyz_m).all(axis=1)
        return Waiting(points=replace(self.points.select(good), xyz_m=goal.xyz_m[good], frame=tracked.frame), frames=since[good])

    def retaken(self, view: TrackingView, templates: Templates, images: list[SplineImage]) -> TrackedFrame:
        """Those of the carried points that are seen again in the frame of `images`, the splines of all views.  (1)"""
        p, ref = self.points, view.reference
        if not len(p.identity):
            return p
        centre = np.stack([view.rows.from_frame(camera.project(p.xyz_m)) for camera in view.cameras], axis=1)
        key = templates.match(p.identity, images[ref], centre[:, ref], p.key_shape)
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
    return Waiting(points=nothing(frame, views), frames=np.zeros(0, dtype=np.int64))
