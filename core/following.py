"""Tracking of a whole take: the points of each frame followed into the next, in the order of time, with a checkpoint per frame."""

from collections.abc import Iterator, Sequence
from dataclasses import fields

import numpy as np

from . import store
from .matching.least_squares import MatchingSettings
from .measuring import FrameImages, MeasuredFrame, load_images
from .progress import Monitor
from .results import Results
from .take import Footage
from .tracking.step import TrackedFrame, TrackingSettings, TrackingView, track_step
from .tracking.surface import regenerate, start_tracks

ALGORITHM = "tracking 1"


def track_frames(
    footage: Footage,
    measured: Sequence[MeasuredFrame],
    matching: MatchingSettings,
    tracking: TrackingSettings,
    results: Results,
    monitor: Monitor,
) -> Iterator[TrackedFrame]:
    """Follow the surface through the frames (in the order of time)."""
    base = store.digest(ALGORITHM, repr((matching, tracking)))
    limit_px = max(tracking.max_residual_px, float(np.median([m.field.limit_px for m in measured])))
    view = TrackingView(
        cameras=footage.rig.cameras,
        reference=footage.take.reference,
        rows=footage.take.rows,
        matching=matching,
        tracking=tracking,
        limit_px=limit_px,
    )
    before: TrackedFrame | None = None
    current: TrackedFrame | None = None
    images: FrameImages | None = None
    key, born = base, 0
    for i, m in enumerate(measured):
        monitor.step("tracks", i, len(measured))
        key = store.digest(key, m.key)
        tracked = _from_checkpoint(results, m.frame, key)
        if tracked is None:
            if current is not None and images is None:
                images = load_images(footage, current.frame)
            tracked, images = _advance(footage, view, before, current, images, m, born, i, monitor)
            _checkpoint(results, tracked, key)
        else:
            images = None
        born = max([born, *(tracked.identity[-1:] + 1)])
        before, current = current, tracked
        yield tracked


def _advance(
    footage: Footage,
    view: TrackingView,
    before: TrackedFrame | None,
    current: TrackedFrame | None,
    images: FrameImages | None,
    m: MeasuredFrame,
    born: int,
    index: int,
    monitor: Monitor,
) -> tuple[TrackedFrame, FrameImages]:
    following = load_images(footage, m.frame)
    if current is None or images is None:
        return start_tracks(m.field, m.frame, view.tracking), following
    tracked = track_step(view, before, current, images.spline, following.spline, following.grey, images.grey, m.frame, monitor)
    every = view.tracking.regenerate_every
    if every and index % every == 0:
        tracked = regenerate(tracked, m.field, view.reference, born, view.tracking)
    return tracked, following


def _checkpoint(results: Results, tracked: TrackedFrame, key: str) -> None:
    arrays = {f.name: getattr(tracked, f.name) for f in fields(TrackedFrame) if f.name != "frame"}
    results.save_checkpoint("tracks", f"{tracked.frame:04d}", key, arrays)


def _from_checkpoint(results: Results, frame: int, key: str) -> TrackedFrame | None:
    arrays = results.load_checkpoint("tracks", f"{frame:04d}", key)
    return None if arrays is None else TrackedFrame(frame=frame, **arrays)
