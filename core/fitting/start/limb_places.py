"""Where the limbs of an explanation may be: poses of one limb all around, and what each explains that no other part of the body does.

    p(pose) ∝ exp(gain / g)                                                                               (1)

The gain is that of `explained.limb_gains` [voxels], less the penalty for missed clicks. A forearm before the trunk, or without measured
points, explains little wherever it is: its places are then about equally probable, and it is not certain, however well the rest fits.
"""

from dataclasses import dataclass

import numpy as np

from ...foundation.progress import Monitor
from ..context import FitContext
from ..explained import limb_gains
from ..inputs.cloud_points import CloudPoints
from ..limb import Limb, whole_limbs
from .refine import Explanation
from .search import click_penalty

ANYWHERE, IMPROVED, AROUND, AROUND_RAD = 400, 6, 24, float(np.radians(15.0))  # poses of a limb: all around, the best, and around each
BESIDE = ((48, AROUND_RAD), (100, float(np.radians(45.0))))  # poses around its own, within which angles
NEAR_M, VOXELS_PER_NAT = 0.15, 20.0  # a limb so far from its place is wrong; g of (1)
COARSE_M, FINE_M = 0.03, 0.02  # widths of the weights of what they explain


@dataclass(frozen=True, eq=False, kw_only=True)
class LimbPlaces:
    """Poses (N, D) of one limb, the first as it was found, the places of its joints (N, E, 3), and what it explains there [voxels]."""

    limb: Limb
    poses: np.ndarray
    ends_m: np.ndarray
    gain: np.ndarray

    @property
    def off_m(self) -> np.ndarray:
        """The distances (N, E) of its joints from where they were found."""
        return np.asarray(np.linalg.norm(self.ends_m - self.ends_m[0], axis=2))

    @property
    def probability(self) -> np.ndarray:
        """The probability (N,) of each pose.  (1)"""
        weight = np.exp((self.gain - self.gain.max()) / VOXELS_PER_NAT)
        return np.asarray(weight / weight.sum())

    @property
    def certainty(self) -> float:
        """The probability that all of its joints are within `NEAR_M` of where they were found."""
        return float(self.probability[self.off_m.max(axis=1) <= NEAR_M].sum())

    @property
    def doubt(self) -> dict[str, float]:
        """The mean square [m²] of the distance of each of its joints."""
        joints = [self.limb.parameters.skeleton.bones[bone].tail_joint for bone in self.limb.bones.tolist()]
        return dict(zip(joints, (self.probability @ self.off_m**2).tolist()))


def limb_places(fit: FitContext, points: CloudPoints, found: Explanation, monitor: Monitor) -> list[LimbPlaces]:
    """Where each limb of an explanation may be in its frame: poses all around, and more of them near the best ones and near its own."""
    evidence, state, places = fit.seen(found.t, points), fit.parameters.state(found.pose, found.vector), list[LimbPlaces]()
    for limb in whole_limbs(fit.parameters):
        monitor.check()
        near, own = evidence.near(limb, state), found.pose[limb.columns]
        anywhere = limb.poses(found.pose, limb.samples(own, ANYWHERE, np.pi))
        coarse = limb_gains(near.thinned(), limb, anywhere, found.vector, COARSE_M)
        best = anywhere[np.argsort(-coarse, kind="stable")[:IMPROVED]]
        around = [limb.poses(found.pose, limb.samples(pose[limb.columns], AROUND, AROUND_RAD)) for pose in best]
        beside = [limb.poses(found.pose, limb.samples(own, count, spread)) for count, spread in BESIDE]
        tried = np.concatenate([found.pose[None], best, *around, *beside])
        gain, ends = limb_gains(near, limb, tried, found.vector, FINE_M), limb.ends(tried, found.vector)
        places.append(LimbPlaces(limb=limb, poses=tried, ends_m=ends, gain=gain - _click_penalty(fit, found.t, limb, ends)))
    return places


def _click_penalty(fit: FitContext, t: int, limb: Limb, ends_m: np.ndarray) -> np.ndarray:
    """The penalty (N,) of places (N, E, 3) of a limb's joints for their distances from clicks."""
    skeleton, penalty = fit.model.skeleton, np.zeros(len(ends_m))
    if t in fit.clicked:
        for e, bone in enumerate(limb.bones.tolist()):
            penalty += click_penalty(fit.clicked[t], skeleton.joint_names.index(skeleton.bones[bone].tail_joint), ends_m[:, e])
    return penalty
