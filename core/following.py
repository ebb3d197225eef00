"""Tracking of a whole take: the points of each frame followed into the next, in the order of time, with a checkpoint per frame.

A frame in which next to nothing is found, black in one view or lost by the recorder, is left out: the points go on from the frame before it
into the one after.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from . import store
from .images.enhance import EnhanceSettings
from .matching.least_squares import MatchingSettings
from .measuring import FrameImages, MeasuredFrame, load_images
from .progress import Monitor
from .results import Results
from .take import Footage
from .tracking.published import STEPS
from .tracking.relief import Relief
from .tracking.settings import TrackingSettings
from .tracking.step import FramePair, TrackingView
from .tracking.surface import on_surface, regenerate, start_tracks
from .tracking.templates import Templates, Tiles, cut_tiles, no_templates
from .tracking.tracked import TrackedFrame, joined, nothing
from .tracking.waiting import Guide, Waiting, nobody

ALGORITHM = "tracking 13"  # part of every key: raise it when the same input gives other numbers
DROPOUT = 0.1  # of the points: where fewer are found in a frame, it is the frame that is missing


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _State:
    """What the next step needs."""

    before: TrackedFrame | None
    current: TrackedFrame | None
    templates: Templates
    waiting: Waiting
    born: int  # the next identity

    def after(self, tracked: TrackedFrame, cut: Tiles, view: TrackingView, guide: Guide | None) -> "_State":
        """The state after a frame, with the templates that were cut in it; a frame that was left out changes nothing."""
        if self.current is not None and not len(tracked.identity) and not len(tracked.ended):
            return self
        waiting = self.waiting if self.current is None else self.waiting.after(self.current, tracked, view.tracking, guide)
        wanted = np.concatenate([tracked.identity, waiting.points.identity])
        return _State(
            before=self.current,
            current=tracked,
            templates=self.templates.only(wanted).with_tiles(cut, view.matching, view.rows.step),
            waiting=waiting,
            born=max([self.born, *(tracked.identity[-1:] + 1)]),
        )


def track_frames(
    footage: Footage,
    measured: Sequence[MeasuredFrame],
    limit_px: float,
    matching: MatchingSettings,
    tracking: TrackingSettings,
    results: Results,
    monitor: Monitor,
    enhance: EnhanceSettings | None = None,
    guide: Guide | None = None,
) -> Iterator[TrackedFrame]:
    """Follow the surface through the frames (in the order of time), in which rays were allowed to miss by `limit_px`.

    Frames that were tracked before are not tracked again for other knobs of the filters. Lost points can have a `guide`; what is tracked
    with one has checkpoints of its own.
    """
    tracking = tracking.of_the_step
    view = tracking_view(footage, matching, tracking, limit_px)
    none = no_templates(view.matching, view.rows.step)
    state = _State(before=None, current=None, templates=none, waiting=nobody(len(view.cameras)), born=0)
    key = store.digest(ALGORITHM, repr((matching, tracking, limit_px, enhance)), *([guide.key] if guide else []))
    group = "guided" if guide else "tracks"
    images: FrameImages | None = None
    for i, m in enumerate(measured):
        monitor.step("tracks", i, len(measured))
        key = store.digest(key, m.key)
        done = _from_checkpoint(results, group, m.frame, key)
        if done is None:
            if state.current is not None and images is None:
                images = load_images(footage, state.current.frame, enhance)
            following = load_images(footage, m.frame, enhance)
            tracked = _advance(view.at(m.frame), state, images, following, m, i, monitor, guide)
            done = tracked, _cut(view, tracked, following)
            _checkpoint(results, group, *done, key)
        else:
            following = None
        after = state.after(*done, view, guide)
        images = images if after is state else following
        state = after
        yield done[0]


def tracking_view(footage: Footage, matching: MatchingSettings, tracking: TrackingSettings, limit_px: float) -> TrackingView:
    """What tracking needs to know of a recording whose rays were allowed to miss by `limit_px`."""
    return TrackingView(
        cameras=footage.rig.cameras,
        reference=footage.take.reference,
        instants=footage.take.instants,
        matching=matching,
        tracking=tracking,
        limit_px=max(tracking.max_residual_px, limit_px),
        dt_s=1 / footage.take.fps,
    )


def _advance(
    view: TrackingView,
    state: _State,
    images: FrameImages | None,
    following: FrameImages,
    m: MeasuredFrame,
    index: int,
    monitor: Monitor,
    guide: Guide | None,
) -> TrackedFrame:
    if view.tracking.scheme == "space":
        view = replace(view, relief=_relief(view, m))
    if state.current is None or images is None:
        return start_tracks(m.field, m.cloud, view)
    pair = FramePair(grey=images.grey, spline=images.spline, next_grey=following.grey, next_spline=following.spline)
    tracked = STEPS[view.tracking.scheme](view, state.before, state.current, state.templates, pair, m.frame, monitor)
    if len(tracked.identity) < DROPOUT * len(state.current.identity) and m.frame - state.current.frame <= view.tracking.bridge_frames:
        return nothing(m.frame, len(view.cameras))
    if view.tracking.scheme == "space":
        waiting = state.waiting.carried(state.current, tracked, view.tracking, guide).in_sight(guide)
        regained = on_surface(waiting.retaken(view, state.templates, following.spline), m.field, m.cloud, view)
        tracked = joined(on_surface(tracked, m.field, m.cloud, view), regained)
    every = view.tracking.regenerate_every
    return regenerate(tracked, m.field, m.cloud, view, state.born) if every and index % every == 0 else tracked


def _relief(view: TrackingView, m: MeasuredFrame) -> Relief:
    return Relief(field=m.field, cloud=m.cloud, camera=view.cameras[view.reference], reference=view.reference, half_patch=view.half_patch)


def _cut(view: TrackingView, tracked: TrackedFrame, images: FrameImages) -> Tiles:
    """The tiles of the key templates that begin in this frame: of new points, and of those that outgrew theirs."""
    new = tracked.renewed
    return cut_tiles(images.spline[view.reference], tracked.identity[new], tracked.xy[new, view.reference], view.matching, view.rows.step)


def _checkpoint(results: Results, group: str, tracked: TrackedFrame, cut: Tiles, key: str) -> None:
    arrays = tracked.arrays() | {f"cut_{f.name}": getattr(cut, f.name) for f in fields(Tiles)}
    results.save_checkpoint(group, f"{tracked.frame:04d}", key, arrays)


def _from_checkpoint(results: Results, group: str, frame: int, key: str) -> tuple[TrackedFrame, Tiles] | None:
    arrays = results.load_checkpoint(group, f"{frame:04d}", key)
    if arrays is None:
        return None
    cut = Tiles(**{f.name: arrays.pop(f"cut_{f.name}") for f in fields(Tiles)})
    return TrackedFrame(frame=frame, **arrays), cut
