"""The user's corrections of a take (take.toml, [[corrections]]) applied to what was measured and tracked.

They come after measuring and tracking, whose checkpoints stay valid: a correction costs no new matching, and taking it back neither.
"""

from collections.abc import Sequence

import numpy as np

from .geometry.rig import Rig
from .progress import Monitor
from .surface.cloud import PointCloud
from .take import Correction
from .tracking.corrections import in_region, inside_polygon, without_clicked
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
    raw: Trajectories, corrections: Sequence[Correction], rig: Rig, settings: TrackingSettings, monitor: Monitor
) -> tuple[Filtered, list[str]]:
    """The filtered trajectories without what the user took out; and a sentence for each click that hit none."""
    left_out, missed = np.zeros(raw.seen.shape, dtype=bool), []
    for c in corrections:
        if c.kind == "region":
            left_out |= in_region(raw, rig[c.view], c.xy_px, c.frames)
    filtered = filter_trajectories(raw, settings, monitor, left_out)
    for c in corrections:
        if c.kind == "trajectory":
            after = without_clicked(filtered, rig[c.view], c.xy_px[0], c.frames.start)
            if after is None:
                x, y = c.xy_px[0]
                missed.append(f"The correction at ({x:g}, {y:g}) of view {c.view} in frame {c.frames.start} has no trajectory near it.")
            filtered = after or filtered
    return filtered, missed
