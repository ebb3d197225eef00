"""Where the measurement begins when the first frame shows nothing: in another frame, or with points that only two views match.

In the first frame the person may be absent, hidden or out of focus: other frames, spread over the take, are tried. If none of them has
enough points, the cameras stand too far apart for three views, or one of them is poor: points matched in two views are then accepted,
too (`growing.pairs`), where this at least doubles their number.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..foundation.progress import Monitor
from ..geometry.view_angles import WIDEST_DEG, neighbours_deg, no_view_alike
from ..results.folder import Results
from ..take.footage import Footage
from .measure import NothingMeasured, measure_frames
from .starts import MeasureSettings, first_frame

OTHERS = 4  # frames that are tried besides the first
ENOUGH = 500  # points of a frame; with fewer, points in two views are tried
MORE = 2.0  # times as many points there must be with them


@dataclass(frozen=True, kw_only=True, slots=True)
class Beginning:
    """The frame from which the others are measured, how many points it has, and whether two views are enough for a point."""

    frame: int
    points: int
    pairs: bool

    def sentences(self, instead: NothingMeasured) -> list[str]:
        """For the user, if this is another beginning than that of the run, in which nothing or hardly anything was measured."""
        changes = [f"The measurement begins in frame {self.frame}."] if self.frame != instead.frame else []
        changes += ["Points matched in only two views are accepted, as with growing.pairs=true."] if self.pairs else []
        found = f"{'Hardly any' if instead.points else 'No'} surface was found in frame {instead.frame}."
        return [" ".join([found, *changes])] if changes else []


def other_beginning(footage: Footage, settings: MeasureSettings, results: Results, monitor: Monitor, points: int = 0) -> Beginning | None:
    """Where to begin if the first frame shows no more than some `points`; None if there is nothing in it, nor in the other frames that
    were tried, or if every other view looks from too far apart from the reference view.

    Raises:
        InputError: the images cannot be read.
        Cancelled: the user asked to stop.
    """
    first, degrees = first_frame(footage), neighbours_deg(footage.rig.cameras, footage.take.reference)
    usual = Beginning(frame=first, points=points, pairs=settings.growing.pairs)
    if no_view_alike(footage.rig.cameras, footage.take.reference):
        return usual if points else None
    frames = other_frames(footage, first, automatic_seeds=settings.growing.seed_spacing_px > 0)
    can_pair = len(degrees) > 1 and degrees[1] <= WIDEST_DEG and not settings.growing.pairs
    parts = len(frames) + can_pair * (1 + len(frames))
    tried = [_tried(footage, settings, results, frame, monitor.part("surface", i, parts)) for i, frame in enumerate(frames)]
    best = max([usual, *tried], key=lambda one: one.points)
    if can_pair and best.points < ENOUGH:
        paired = replace(settings, growing=replace(settings.growing, pairs=True))
        for i, frame in enumerate(dict.fromkeys((best.frame, first, *frames))):
            found = _tried(footage, paired, results, frame, monitor.part("surface", len(frames) + i, parts))
            if found.points > MORE * best.points:
                best = found
            if best.points >= ENOUGH:
                break
    return best if best.points else None


def other_frames(footage: Footage, first: int, *, automatic_seeds: bool) -> list[int]:
    """Frames spread over the take, of both fields those on the rows of the first; none where seeds are clicked in the first frame only."""
    if not automatic_seeds:
        return []
    alike = np.array(footage.frames)[(np.array(footage.frames) - first) % footage.take.field_layout.per_image == 0]
    some = alike[np.unique(np.linspace(0, len(alike) - 1, OTHERS + 1).round().astype(int))]
    return [frame for frame in some.tolist() if frame != first][:OTHERS]


def _tried(footage: Footage, settings: MeasureSettings, results: Results, frame: int, monitor: Monitor) -> Beginning:
    """The points of a frame from which the measurement would begin."""
    try:
        points = len(next(measure_frames(footage, settings, results, monitor, frame)).cloud.xyz_m)
    except NothingMeasured:
        points = 0
    return Beginning(frame=frame, points=points, pairs=settings.growing.pairs)
