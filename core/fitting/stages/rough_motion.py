"""Where the body is in every frame, about, before the background behind it is known.

Without measured points, a part of the person that stays where it is looks like the background: its outline is then wrong, and so is the
body that is fitted to it. The points that are followed in the views hold the body meanwhile. Tracked with them, it shows where the
background may be hidden all the time; there nothing is known, and the outlines elsewhere are right.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...foundation.arrays import LazySequence
from ...foundation.progress import Monitor
from ..inputs.fit_input import FitInput
from ..segmentation import surface_points
from ..settings import FitSettings
from ..state import ShapeParameters
from .click_frame import fit_click_frame
from .pose_tracking import Checkpoints, PoseTracking, track_poses
from .sequence import prepared
from .set_up import point_tracks


def rough_bodies(given: FitInput, settings: FitSettings, monitor: Monitor, checkpoints: Checkpoints | None = None) -> Sequence[np.ndarray]:
    """Points (P, 3) all over the surface of the body in each of T frames.

    Raises:
        InputError: as `fit_sequence`.
        Cancelled: the user asked to stop.
    """
    fit, points = prepared(given, replace(settings, search_limbs=False), monitor)
    first = fit_click_frame(fit, points[fit.click], monitor)
    tracks = point_tracks(given, fit)
    tracking = PoseTracking(fit=fit, points=points, time_s=given.time_s, first=first, tracks=tracks)
    motion, _ = track_poses(tracking, monitor, checkpoints)
    return bodies_in(fit.parameters, motion, first.vector)


def bodies_in(parameters: ShapeParameters, motion: np.ndarray, vector: np.ndarray) -> Sequence[np.ndarray]:
    """The same for a motion (T, D) and a shape vector (S,), made on demand."""
    return LazySequence([*motion], lambda pose: surface_points(parameters.state(pose, vector)))
