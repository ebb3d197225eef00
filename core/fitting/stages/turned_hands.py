"""The hands, turned as they are seen: their wrists' angles and the twist of their forearms.

The hand of the fitted body is flat and ends at the knuckles. Turned over, with the wrist bent the other way, it explains the points of a
palm as well, and where a fit begins it is as often the one as the other. With its fingers and its thumb (`hands`) it does not. Each hand is
therefore followed through all frames as limbs are (`limb_paths`), from any pose in the first one. It replaces the tracked angles, in all
frames between the first and the last in which the hand would be elsewhere, if it explains more by `LEAST_BETTER` voxels in the mean of the
frames in which the hand is seen, each of which counts with `MOST` at most. In the adjustment over the sequence the priors of these angles
are about what was found: the flat hand would slide away from it.
"""

from dataclasses import replace

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..limb import Limb, limbs_of
from ..observations import Observation, PosePrior
from .limb_paths import REPLACED_M, Way, best_way, gain_by_way
from .pose_tracking import PoseTracking

STAGE = "turn the hands"
LEAST_BETTER, MOST = 20.0, 40.0  # voxels a frame; where a hand lies on a thigh, wrong ones gain up to 17
UNSEEN = 1.0  # voxels: a frame in which two poses explain the same shows nothing of the hand
SIGMA = float(np.radians(21.0))  # of a hand's angles about those that were found


def turn_hands(given: PoseTracking, motion: np.ndarray, monitor: Monitor) -> np.ndarray:
    """The motion (T, D) with the hands on their best ways; the same where no background is known, or no surface.

    Raises:
        Cancelled: the user asked to stop.
    """
    motion, hands = motion.copy(), hands_looked_for(given.fit)
    for i, limb in enumerate(hands):
        way = best_way(given, motion, limb, [*range(len(motion))], True, monitor.part(STAGE, i, len(hands)))
        for t, angles in _better(given, motion, limb, way).items():
            motion[t, limb.columns] = angles
    return motion


def _better(given: PoseTracking, motion: np.ndarray, limb: Limb, way: Way) -> dict[int, np.ndarray]:
    """The hand's angles (C,) by frame, where its way explains more than a motion (T, D); none where the two are the same."""
    ends, angles = limb.ends(motion, given.first.vector), {t: a for t, a, _ in way}
    apart = [t for t, _, end in way if np.linalg.norm(end - ends[t], axis=1).max() > REPLACED_M]
    frames = range(min(apart, default=0), max(apart, default=-1) + 1)
    gain = np.array([gain_by_way(given, t, motion[t], limb, angles[t]) for t in frames])
    seen = np.abs(gain) > UNSEEN
    return {t: angles[t] for t in frames} if seen.any() and np.clip(gain[seen], -MOST, MOST).mean() > LEAST_BETTER else {}


def angles_of_hands(fit: FitContext, motion: np.ndarray) -> np.ndarray | None:
    """The angles (T, D) of the hands in a motion (T, D) in which they were turned, NaN of other DOFs; None where none were."""
    columns = [c for limb in hands_looked_for(fit) for c in limb.columns.tolist()]
    if not columns:
        return None
    found = np.full(motion.shape, np.nan)
    found[:, columns] = motion[:, columns]
    return found


def priors_at(fit: FitContext, t: int) -> list[Observation]:
    """The priors of the pose in frame index `t`: those of hands are about the angles that were found for them."""
    if fit.turned is None:
        return fit.priors
    found = np.isfinite(fit.turned[t])
    return [
        replace(p, mean=np.where(found, fit.turned[t], p.mean), sigma=np.where(found, SIGMA, p.sigma)) if isinstance(p, PosePrior) else p
        for p in fit.priors
    ]


def hands_looked_for(fit: FitContext) -> list[Limb]:
    """The hands that are looked for: not where outlines of views all around are all that shows them."""
    if not fit.background.known or not fit.settings.search_limbs or fit.in_views is not None:
        return []
    return [limb for limb in limbs_of(fit.parameters).values() if limb.hand is not None]
