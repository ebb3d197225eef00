"""Tracking the whole surface: which points are followed, and where new ones start (D'Apuzzo et al. 2000, §3.2)."""

import numpy as np
from scipy.spatial import cKDTree

from ..matching.growing import TripletField
from .step import TrackedFrame, TrackingSettings

BARE = 1.5  # a surface point with no tracked point within this many spacings starts a new trajectory


def start_tracks(field: TripletField, frame: int, settings: TrackingSettings) -> TrackedFrame:
    """The first tracked points: the measured surface, thinned to the tracking's spacing."""
    rows = _thinned(field, settings.spacing_px)
    none = np.zeros(0, dtype=np.int64)
    return TrackedFrame(
        frame=frame,
        identity=np.arange(len(rows)),
        xy=field.xy[rows],
        shape=field.shape[rows],
        xyz_m=field.xyz_m[rows],
        covariance_m2=field.covariance_m2[rows],
        ended=none,
        reason=none.astype(np.int8),
    )


def regenerate(tracked: TrackedFrame, field: TripletField, reference: int, next_identity: int, settings: TrackingSettings) -> TrackedFrame:
    """The tracked points of a frame and new ones from the frame's own surface, where it has no tracked point near."""
    rows = _thinned(field, settings.spacing_px)
    if len(tracked.identity) and len(rows):
        to_frame = field.grid.rows.to_frame
        distance, _ = cKDTree(to_frame(tracked.xy[:, reference])).query(to_frame(field.xy[rows, reference]))
        rows = rows[distance > BARE * settings.spacing_px]
    identity = np.arange(next_identity, next_identity + len(rows))

    def both(name: str) -> np.ndarray:
        return np.concatenate([getattr(tracked, name), getattr(field, name)[rows]])

    return TrackedFrame(
        frame=tracked.frame,
        identity=np.concatenate([tracked.identity, identity]),
        xy=both("xy"),
        shape=both("shape"),
        xyz_m=both("xyz_m"),
        covariance_m2=both("covariance_m2"),
        ended=tracked.ended,
        reason=tracked.reason,
    )


def _thinned(field: TripletField, spacing_px: int) -> np.ndarray:
    """Rows of the field on every n-th column and row of the grid."""
    n = max(1, round(spacing_px / field.grid.spacing_px))
    j, i = field.cell // field.grid.shape[1], field.cell % field.grid.shape[1]
    return np.flatnonzero((i % n == 0) & (j % n == 0))
