"""Whether the motion that a start led to is contradicted: a rival of it explains more of several frames."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..inputs.cloud_points import CloudPoints
from ..inputs.start_joints import StartJoints
from .refine import LEAST_POINTS, ROUNDS, STAGE, adjusted, exchanged, exchanges_of, explanation, thinned_points

PLACES = (0.15, 0.5, 0.85)  # in the recording, of the frames that are judged
MORE = 120.0  # voxels by which a rival must explain more of them together
UNLIKELY = 0.05  # the probability of a start that is taken back


def taken_back(
    fit: FitContext, start: StartJoints, points: Sequence[CloudPoints], motion: np.ndarray, vector: np.ndarray, monitor: Monitor
) -> StartJoints | None:
    """The start with what contradicts the motion (T, D) of a body with the shape vector (S,) that follows from it; None if nothing does.

    Raises:
        Cancelled: the user asked to stop.
    """
    frames = np.unique((np.array(PLACES) * (len(motion) - 1)).round().astype(int)).tolist()
    judged = [t for t in frames if len(points[t].xyz_m) >= LEAST_POINTS]
    exchanges = exchanges_of(fit)
    more = dict.fromkeys(exchanges, 0.0)
    for i, t in enumerate(judged):
        part, thin = monitor.part(STAGE, i, len(judged)), thinned_points(points[t])
        found = adjusted(fit, thin, explanation(fit, t, thin, motion[t], vector), ROUNDS[-1:], part)
        for name, joints in exchanges.items():
            more[name] += exchanged(fit, thin, found, joints, part, close=-np.inf).score - found.score
    if not more or max(more.values()) < MORE:
        return None
    return replace(start, probability=UNLIKELY, rivals={max(more, key=lambda name: more[name]): 1 - UNLIKELY}, rival_m={})
