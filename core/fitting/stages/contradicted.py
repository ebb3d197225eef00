"""Limbs whose fitted place contradicts what is seen: such a limb is not called certain, and the user is told.

The evidence against a limb is the area of it that lies in the background, in another part of the body, or before measured points that it
would hide (the second sum of (2) in `explained`). Normal equations know none of this: they describe the surroundings of one solution.
"""

import numpy as np

from ..context import FitContext
from ..explained import misplaced
from ..inputs.cloud_points import CloudPoints
from ..limb import whole_limbs
from ..state import BodyState, ShapeParameters

CONTRADICTED = 40.0  # voxels: the area from which on a limb is contradicted
ANYWHERE_M, ANYWHERE_RAD, TINY = 0.15, float(np.radians(30.0)), 1e-12  # least sigmas of such a limb


def misplaced_limbs(fit: FitContext, t: int, points: CloudPoints, state: BodyState) -> np.ndarray:
    """The area (L,) [voxels] by which each whole limb of a body contradicts what is seen in frame index `t`; 0 without a background."""
    limbs, seen = whole_limbs(fit.parameters), fit.seen(t, points)
    return np.array([misplaced(seen, limb, state) if seen.cells else 0.0 for limb in limbs])


def widened(parameters: ShapeParameters, area: np.ndarray, covariance: np.ndarray, joint_sigma_m: np.ndarray) -> None:
    """Raise, in place, the covariance (D, D) and the sigmas of joints (J,) of limbs that their area (L,) contradicts: they may be anywhere
    near."""
    skeleton, limbs = parameters.skeleton, whole_limbs(parameters)
    for limb in [limbs[i] for i in np.flatnonzero(area > CONTRADICTED)]:
        tails = [skeleton.joint_names.index(skeleton.bones[b].tail_joint) for b in limb.outer]
        joint_sigma_m[tails] = np.maximum(joint_sigma_m[tails], ANYWHERE_M)
        factor = np.ones(len(covariance))
        factor[limb.columns] = np.maximum(1.0, ANYWHERE_RAD / np.sqrt(np.maximum(np.diag(covariance)[limb.columns], TINY)))
        covariance *= factor * factor[:, None]


def contradicted_joints(parameters: ShapeParameters, area: np.ndarray) -> np.ndarray:
    """Whether each joint (T, J) belongs to a limb that its area (T, L) contradicts."""
    skeleton = parameters.skeleton
    found = np.zeros((len(area), len(skeleton.joint_names)), dtype=bool)
    for limb, column in zip(whole_limbs(parameters), area.T):
        found[:, [skeleton.joint_names.index(skeleton.bones[b].tail_joint) for b in limb.outer]] |= column[:, None] > CONTRADICTED
    return found


def contradicted_frames(parameters: ShapeParameters, frames: np.ndarray, area: np.ndarray) -> dict[str, tuple[int, ...]]:
    """By the first bone of each limb the frames (T,) in which it is contradicted, from the areas (T, L); see `BodyFit.contradicted`."""
    names = [parameters.skeleton.bones[limb.bones[0]].name for limb in whole_limbs(parameters)]
    return {name: tuple(frames[column > CONTRADICTED].tolist()) for name, column in zip(names, area.T) if (column > CONTRADICTED).any()}
