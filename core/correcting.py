"""The user's corrections of a take (take.toml, [[corrections]]) applied to what was measured and tracked.

They come after measuring and tracking, whose checkpoints stay valid: a correction costs no new matching, and taking it back neither.
"""

from collections.abc import Collection, Sequence

import numpy as np

from .geometry.rig import Rig
from .progress import Monitor
from .surface.cloud import PointCloud
from .take import Correction
from .tracking.corrections import clicked, in_region, inside_polygon, without
from .tracking.settings import TrackingSettings
from .tracking.trajectories import Filtered, Trajectories, filter_trajectories


def corrected_cloud(cloud: PointCloud, corrections: Sequence[Correction], rig: Rig) -> PointCloud:
    """The cloud without the points inside the regions of its frame."""
    gone = np.zeros(len(cloud.xyz_m), dtype=bool)
    for c in corrections:
        if c.kind == "region" and cloud.frame in c.frames:
            gone |= inside_polygon(rig[c.view].project(cloud.xyz_m), c.xy_px)
    return cloud.select(~gone) if gone.any() else cloud


def corrected_tracks(
    raw: Trajectories, corrections: Sequence[Correction], rig: Rig, settings: TrackingSettings, monitor: Monitor, rows: range | None = None
) -> tuple[Filtered, dict[int, int]]:
    """The filtered trajectories without what the user took out; and, by the number of a correction, the column of `raw` that its click hit.

    Clicks in other frames than those of the `rows` (None: all) hit nothing.
    """
    left_out = np.zeros(raw.seen.shape, dtype=bool)
    for c in corrections:
        if c.kind == "region":
            left_out |= in_region(raw, rig[c.view], c.xy_px, c.frames)
    filtered, hit = filter_trajectories(raw, settings, monitor, left_out), dict[int, int]()
    here = raw.frames[slice(rows.start, rows.stop) if rows else slice(None)]
    for number, c in enumerate(corrections):
        if c.kind == "trajectory" and c.frames.start in here:
            source = clicked(filtered, rig[c.view], c.xy_px[0], c.frames.start)
            if source is not None:
                filtered, hit[number] = without(filtered, source), source
    return filtered, hit


def missed_clicks(corrections: Sequence[Correction], hit: Collection[int]) -> list[str]:
    """A sentence for each click of the corrections whose number is not among those that hit a trajectory."""
    missed = [c for number, c in enumerate(corrections) if c.kind == "trajectory" and number not in hit]
    where = [f"({c.xy_px[0][0]:g}, {c.xy_px[0][1]:g}) of view {c.view} in frame {c.frames.start}" for c in missed]
    return [f"The correction at {place} has no trajectory near it." for place in where]
