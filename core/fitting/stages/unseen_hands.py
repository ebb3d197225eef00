"""Hands that the images do not show: they hang relaxed, and are as uncertain as what hands do.

Where few measured points are a hand's own, because it lies on the body or behind it, the adjustment turns it to points of something
else, and its normal equations call that certain. What the hand explains with its fingers and no other part of the body does (the first sums
of (3) in `explained`) tells: hands that are fitted right explain 20 to 90 voxels, those behind the body less than 10. Where the running
median over `WINDOW_S` is below `SHOWN` for `LEAST_S` or more, s is 1, else 0; its mean s̄ over `BLEND_S` draws the angles θ of the hand's
own joint to their prior mean μ and adds the prior's variance:

    θ' = (1 − s̄) θ + s̄ μ ,   K' = K + s̄ σ²                                                               (1)

A hand that is clicked is shown for `WINDOW_S` before and after.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..context import FitContext
from ..explained import limb_gains, misplaced
from ..inputs.cloud_points import CloudPoints
from ..limb import Limb
from ..solve.problem import Estimate
from .limb_modes import Elsewhere
from .limb_paths import FINE_M
from .turned_hands import hands_looked_for

SHOWN = 15.0  # voxels
WINDOW_S, BLEND_S = 0.2, 0.1  # before and after a frame
LEAST_S = 0.4  # that a hand hangs: for less it is not drawn to rest and back
EQUAL_S = 1e-3  # differences of times


def with_unseen_hands(
    fit: FitContext, points: Sequence[CloudPoints], at: Estimate, time_s: np.ndarray, frames: range, limbs: Sequence[Limb]
) -> tuple[Estimate, list[Elsewhere]]:
    """The motion in which the hands of some limbs hang where they are not seen, and what that adds to the covariance of some `frames`.

    Raises:
        Cancelled: the user asked to stop.
    """
    motion, found, carried = at.motion.copy(), list[Elsewhere](), {bone for limb in limbs for bone in limb.outer.tolist()}
    for hand in hands_looked_for(fit):
        bone = int(hand.bones[0])
        if bone not in carried:
            continue
        share = _unseen(fit, hand, points, at, time_s)
        dofs = np.flatnonzero(fit.model.skeleton.dof_bone == bone)
        mean, sigma = (np.array([getattr(fit.model.skeleton.dofs[d], name) for d in dofs]) for name in ("prior_mean", "prior_sigma"))
        motion[:, dofs] += share[:, None] * (mean - at.motion[:, dofs])
        own, some = np.isin(hand.columns, dofs), share[frames]
        variance = np.zeros(len(hand.columns))
        variance[own] = np.minimum(sigma, np.pi) ** 2
        length_m = float(fit.parameters.body(at.vector)[0][bone])
        ends = hand.ends(at.motion[:1], at.vector).shape[1]
        found.append(
            Elsewhere(
                limb=hand,
                covariance=some[:, None, None] * np.diag(variance),
                variance_m2=np.repeat(some[:, None] * length_m**2 * variance.sum() / 3, ends, axis=1),
            )
        )
    return replace(at, motion=motion), found


def _unseen(fit: FitContext, hand: Limb, points: Sequence[CloudPoints], at: Estimate, time_s: np.ndarray) -> np.ndarray:
    """s̄ (T,) of a hand."""
    joint = fit.model.skeleton.joint_names.index(fit.model.skeleton.bones[int(hand.bones[0])].tail_joint)
    own = np.empty(len(time_s))
    for t, pose in enumerate(at.motion):
        fit.monitor.check()
        state = fit.parameters.state(pose, at.vector)
        near = fit.seen(t, points[t]).near(hand, state)
        own[t] = limb_gains(near, hand, pose[None], at.vector, FINE_M)[0] + misplaced(near, hand, state)
    clicked = [t for t, clicks in fit.clicked.items() if (clicks.joint == joint).any()]
    around = np.abs(time_s[:, None] - time_s)
    unseen = np.array([np.median(own[row <= WINDOW_S + EQUAL_S]) < SHOWN for row in around], dtype=float)
    unseen[(around[:, clicked] <= WINDOW_S + EQUAL_S).any(axis=1)] = 0.0
    for run in np.split(np.arange(len(unseen)), np.flatnonzero(np.diff(unseen)) + 1):
        if unseen[run[0]] and len(run) < len(unseen) and time_s[run[-1]] - time_s[run[0]] < LEAST_S - EQUAL_S:
            unseen[run] = 0.0  # between frames, or beside them, that show it
    return np.array([unseen[row <= BLEND_S + EQUAL_S].mean() for row in around])
