"""Tracking of a whole take: the points of each frame tracked into the next, in the order of time, with a checkpoint per frame.

A frame in which next to no point is found, because one view is black or the recorder lost it, is left out: the points are tracked from
the frame before it into the one after.
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
from .tracking.relief import CurvatureCorrection
from .tracking.settings import TrackingSettings
from .tracking.step import FramePair, TrackingView
from .tracking.surface import on_surface, regenerate, start_tracks
from .tracking.templates import Templates, Tiles, cut_tiles, no_templates
from .tracking.tracked import TrackedFrame, joined, nothing
from .tracking.waiting import Guide, LostPoints, none_lost

ALGORITHM = "tracking 14"  # part of every key: raise it when the same input gives other numbers
MIN_PART_FOUND = 0.1  # of the points: where fewer are found in a frame, the frame is missing, and not the points


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingRules:
    """How the points of a recording are tracked: the settings concerned, and what its calibration allows."""

    matching: MatchingSettings
    tracking: TrackingSettings
    enhance: EnhanceSettings | None = None
    limit_px: float = 0.0  # rays were allowed to miss by as much when the surface was measured

    def view(self, footage: Footage) -> TrackingView:
        """What a tracking step needs to know of the recording."""
        return TrackingView(
            cameras=footage.rig.cameras,
            reference=footage.take.reference,
            field_layout=footage.take.field_layout,
            matching=self.matching,
            tracking=self.tracking,
            limit_px=max(self.tracking.max_residual_px, self.limit_px),
            dt_s=1 / footage.take.fps,
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _State:
    """What the next step needs."""

    before: TrackedFrame | None
    current: TrackedFrame | None
    templates: Templates
    lost: LostPoints
    next_identity: int

    def after(self, tracked: TrackedFrame, cut: Tiles, view: TrackingView, guide: Guide | None) -> "_State":
        """The state after a frame, with the templates that were cut in it; a frame that was left out changes nothing."""
        if self.current is not None and not len(tracked.identity) and not len(tracked.ended):
            return self
        lost = self.lost if self.current is None else self.lost.after(self.current, tracked, view.tracking, guide)
        wanted = np.concatenate([tracked.identity, lost.points.identity])
        return _State(
            before=self.current,
            current=tracked,
            templates=self.templates.only(wanted).with_tiles(cut, view.matching, view.rows.step),
            lost=lost,
            next_identity=max([self.next_identity, *(tracked.identity[-1:] + 1)]),
        )


def track_frames(
    footage: Footage,
    measured: Sequence[MeasuredFrame],
    rules: TrackingRules,
    results: Results,
    monitor: Monitor,
    guide: Guide | None = None,
) -> Iterator[TrackedFrame]:
    """Track points of the surface through the measured frames, in the order of time.

    Frames with a valid checkpoint are not tracked again; the settings of the filters do not invalidate it. With a `guide` for lost points
    the checkpoints are separate.
    """
    rules = replace(rules, tracking=rules.tracking.of_the_step)
    view = rules.view(footage)
    no_template = no_templates(view.matching, view.rows.step)
    state = _State(before=None, current=None, templates=no_template, lost=none_lost(len(view.cameras)), next_identity=0)
    key = store.digest(ALGORITHM, repr((rules.matching, rules.tracking, rules.limit_px, rules.enhance)), *([guide.key] if guide else []))
    group = "guided" if guide else "tracks"
    images: FrameImages | None = None
    for i, surface in enumerate(measured):
        monitor.step("tracks", i, len(measured))
        key = store.digest(key, surface.key)
        done = _from_checkpoint(results, group, surface.frame, key)
        if done is None:
            if state.current is not None and images is None:
                images = load_images(footage, state.current.frame, rules.enhance)
            next_images = load_images(footage, surface.frame, rules.enhance)
            start_new = bool(view.tracking.regenerate_every) and i % view.tracking.regenerate_every == 0
            tracked = _advance(view.at(surface.frame), state, _pair(images, next_images), surface, monitor, guide, start_new)
            done = tracked, _cut(view, tracked, next_images)
            _checkpoint(results, group, *done, key)
        else:
            next_images = None
        after = state.after(*done, view, guide)
        images = images if after is state else next_images
        state = after
        yield done[0]


def _pair(images: FrameImages | None, after: FrameImages) -> FramePair | None:
    if images is None:
        return None
    return FramePair(grey=images.grey, spline=images.spline, next_grey=after.grey, next_spline=after.spline)


def _advance(
    view: TrackingView,
    state: _State,
    images: FramePair | None,
    surface: MeasuredFrame,
    monitor: Monitor,
    guide: Guide | None,
    start_new: bool,
) -> TrackedFrame:
    """The tracked points in the frame of the view, whose surface is given; with `start_new` new ones where it has none."""
    in_space = view.tracking.scheme == "space"
    if in_space:
        view = replace(view, curvature=_curvature(view, surface))
    if state.current is None or images is None:
        return start_tracks(surface.field, surface.cloud, view)
    tracked = STEPS[view.tracking.scheme](view, state.before, state.current, state.templates, images, surface.frame, monitor)
    few = len(tracked.identity) < MIN_PART_FOUND * len(state.current.identity)
    if few and surface.frame - state.current.frame <= view.tracking.bridge_frames:
        return nothing(surface.frame, len(view.cameras))
    if in_space:
        lost = state.lost.carried(state.current, tracked, view.tracking, guide).in_sight(guide)
        reacquired = on_surface(lost.reacquired(view, state.templates, images.next_spline), surface.field, surface.cloud, view)
        tracked = joined(on_surface(tracked, surface.field, surface.cloud, view), reacquired)
    return regenerate(tracked, surface.field, surface.cloud, view, state.next_identity) if start_new else tracked


def _curvature(view: TrackingView, surface: MeasuredFrame) -> CurvatureCorrection:
    return CurvatureCorrection(
        field=surface.field,
        cloud=surface.cloud,
        camera=view.cameras[view.reference],
        reference=view.reference,
        half_patch=view.half_patch,
    )


def _cut(view: TrackingView, tracked: TrackedFrame, images: FrameImages) -> Tiles:
    """The tiles of the key templates that are cut in this frame: of new points, and of those that no longer match theirs."""
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
