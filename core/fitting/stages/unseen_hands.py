"""Hands that the images do not show are as uncertain as what hands do.

Where few measured points are a hand's own, because it lies on the body or behind it, the adjustment turns it to points of something
else, and its normal equations call that certain. What the hand explains with its fingers and no other part of the body does (the first sums
of (3) in `explained`) tells: hands that are fitted right explain 20 to 90 voxels, those behind the body less than 10. Where the running
median over `WINDOW_S` is below `SHOWN`, s is 1, else 0; its mean s̄ over `BLEND_S` adds the prior's variance σ² to that of the angles of the
hand's own joint:

    K' = K + s̄ σ²                                                                                         (1)

A hand that is clicked is shown for `WINDOW_S` before and after.
"""

from collections.abc import Sequence

import numpy as np

from ..context import FitContext
from ..explained import explained
from ..inputs.cloud_points import CloudPoints
from ..limb import Limb
from ..solve.problem import Estimate
from .limb_modes import Elsewhere
from .limb_paths import FINE_M
from .turned_hands import hands_looked_for

SHOWN = 15.0  # voxels
WINDOW_S, BLEND_S = 0.2, 0.1  # before and after a frame
EQUAL_S = 1e-3  # differences of times


def unseen_hands(
    fit: FitContext, points: Sequence[CloudPoints], at: Estimate, time_s: np.ndarray, frames: range, limbs: Sequence[Limb]
) -> list[Elsewhere]:
    """What the hands of some limbs, where they are not seen, add to the covariance of some `frames` of a motion.

    Raises:
        Cancelled: the user asked to stop.
    """
    found, carried, skeleton = list[Elsewhere](), {bone for limb in limbs for bone in limb.outer.tolist()}, fit.model.skeleton
    for hand in hands_looked_for(fit):
        bone = int(hand.bones[0])
        if bone not in carried:
            continue
        share, own = _unseen(fit, hand, points, at, time_s)[frames], skeleton.dof_bone[hand.columns] == bone
        sigma = np.array([min(skeleton.dofs[d].prior_sigma, np.pi) for d in hand.columns]) * own
        length_m = float(fit.parameters.body(at.vector)[0][bone])
        of_end_m2 = share * length_m**2 * (sigma**2).sum() / 3
        found.append(Elsewhere(limb=hand, covariance=share[:, None, None] * np.diag(sigma**2), variance_m2=of_end_m2[:, None]))
    return found


def _unseen(fit: FitContext, hand: Limb, points: Sequence[CloudPoints], at: Estimate, time_s: np.ndarray) -> np.ndarray:
    """s̄ (T,) of a hand."""
    joint = fit.model.skeleton.joint_names.index(fit.model.skeleton.bones[int(hand.bones[0])].tail_joint)
    own = np.empty(len(time_s))
    for t, pose in enumerate(at.motion):
        fit.monitor.check()
        state = fit.parameters.state(pose, at.vector)
        near = fit.seen(t, points[t]).near(hand, state)
        own[t] = explained(near, hand, state, FINE_M)
    clicked = [t for t, clicks in fit.clicked.items() if (clicks.joint == joint).any()]
    around = np.abs(time_s[:, None] - time_s)
    unseen = np.array([np.median(own[row <= WINDOW_S + EQUAL_S]) < SHOWN for row in around], dtype=float)
    unseen[(around[:, clicked] <= WINDOW_S + EQUAL_S).any(axis=1)] = 0.0
    return np.array([unseen[row <= BLEND_S + EQUAL_S].mean() for row in around])
