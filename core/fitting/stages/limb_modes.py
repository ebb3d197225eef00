"""Where a limb could be instead: other poses that explain about as much of what is seen, and how probable they are.

Normal equations describe the surroundings of one solution. Here the poses k of a limb in frame t that differ are rated by what they explain
(`explained.limb_gains`), and by how evenly the limb would move (forward–backward algorithm; Rabiner 1989, §III):

    ln p_k(t) = gain_k(t) / GAIN + ln Σ_j exp(ln p_j(t − 1) − m_jk) + ln Σ_l exp(ln p_l(t + 1) − m_kl)                          (1)
    m_jk = min(|X_k − X_j|² / 2σ², LARGEST_JUMP)
    K = Σ_k p_k (θ_k − θ)(θ_k − θ)ᵀ                                                                                          (2)

X are the ends of the limb's bones; GAIN and σ are those of `limb_paths`. (2), about the fitted pose θ, is added to its covariance: a limb
that the images show has no other pose of any weight, and one that they do not show is as uncertain as what it could do. The fitted pose is
always among the poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...body.skeleton import Skeleton
from ..context import FitContext
from ..explained import Evidence, limb_gains
from ..inputs.cloud_points import CloudPoints
from ..limb import Limb
from ..solve.problem import Estimate
from .limb_paths import COARSE_M, FINE_M, GAIN, unlikely

ANYWHERE, ANYWHERE_RAD = 300, np.pi  # poses all over the joints' range
AROUND, AROUND_RAD = 60, float(np.radians(40.0))  # poses around the fitted one
IMPROVED, IMPROVEMENTS, IMPROVED_RAD = 4, 24, float(np.radians(14.0))  # of the best poses, and those tried around each
MODES = 10  # that differ, of one frame
DIFFERENT_M = 0.05  # between the ends of two poses
FROM_OWN_M = 0.07  # … of one and the fitted one: nearer ones are in its surroundings
LARGEST_JUMP = 8.0
HOPELESS = 10.0  # ln of the probability ratio by which all other poses of a frame are less probable than the fitted one, to be left out


@dataclass(frozen=True, eq=False, kw_only=True)
class LimbModes:
    """K poses of one limb in one frame, the fitted one first."""

    angles: np.ndarray  # (K, C)
    ends_m: np.ndarray  # (K, E, 3) of its bones
    gain: np.ndarray  # (K,) voxels


@dataclass(frozen=True, eq=False, kw_only=True)
class Elsewhere:
    """What a limb's other poses add to the covariance of T frames."""

    limb: Limb
    covariance: np.ndarray  # (T, C, C) of its angles, (2)
    variance_m2: np.ndarray  # (T, E) of a coordinate of the ends of its bones


def elsewhere(
    fit: FitContext, points: Sequence[CloudPoints], at: Estimate, time_s: np.ndarray, frames: range, limbs: Sequence[Limb]
) -> list[Elsewhere]:
    """For each of some limbs the other places where it could be, in some of the frames whose points and motion are given.

    Raises:
        Cancelled: the user asked to stop.
    """
    found = list[list[LimbModes]]()
    for t in frames:
        fit.monitor.check()
        seen, state = fit.seen(t, points[t]), fit.parameters.state(at.motion[t], at.vector)
        found.append([_modes(limb, seen.near(limb, state), at.motion[t], at.vector) for limb in limbs])
    return [_mixed(limb, [frame[i] for frame in found], time_s[frames]) for i, limb in enumerate(limbs)]


def _modes(limb: Limb, near: Evidence, pose: np.ndarray, vector: np.ndarray) -> LimbModes:
    """The poses of one frame that differ, the fitted one first, the others from the best on."""
    own = pose[limb.columns][None]
    tried = np.concatenate([own, limb.samples(own[0], AROUND, AROUND_RAD), limb.samples(own[0], ANYWHERE, ANYWHERE_RAD)])
    poses, thinned = limb.poses(pose, tried), near.thinned()
    now = limb_gains(thinned, limb, poses[:1], vector, COARSE_M)
    least = now[0] - HOPELESS * GAIN
    coarse, ends = np.concatenate([now, limb_gains(thinned, limb, poses[1:], vector, COARSE_M, least)]), limb.ends(poses, vector)
    far = np.linalg.norm(ends - ends[0], axis=2).max(axis=1) > FROM_OWN_M
    if coarse[far].max(initial=-np.inf) <= least:
        return LimbModes(angles=own, ends_m=ends[:1], gain=coarse[:1])
    order = np.argsort(-coarse[1:], kind="stable")
    best = tried[1:][order[coarse[1:][order] > least]]
    more = [limb.samples(angles, IMPROVEMENTS, IMPROVED_RAD) for angles in best[:IMPROVED]]
    tried = np.concatenate([own, *more, best[: 4 * MODES]])
    poses = limb.poses(pose, tried)
    gain, ends = limb_gains(near, limb, poses, vector, FINE_M), limb.ends(poses, vector)
    kept = [0]
    for k in np.argsort(-gain, kind="stable").tolist():
        off = [float(np.linalg.norm(ends[k] - ends[j], axis=1).max()) for j in kept]
        if len(kept) < MODES and off[0] > FROM_OWN_M and min(off) > DIFFERENT_M:
            kept.append(k)
    return LimbModes(angles=tried[kept], ends_m=ends[kept], gain=gain[kept])


def _mixed(limb: Limb, modes: Sequence[LimbModes], time_s: np.ndarray) -> Elsewhere:
    """The probabilities (1) of the poses of all frames, and (2)."""
    step = np.diff(time_s)
    jump = [_jump(limb, a, b, float(h)) for a, b, h in zip(modes, modes[1:], step)]
    ahead, back = [np.zeros(len(modes[0].gain))], [np.zeros(len(modes[-1].gain))]
    for t, m in enumerate(jump):
        ahead.append(np.logaddexp.reduce((ahead[-1] + modes[t].gain / GAIN)[:, None] - m, axis=0))
    for t in range(len(jump) - 1, -1, -1):
        back.append(np.logaddexp.reduce((back[-1] + modes[t + 1].gain / GAIN)[None] - jump[t], axis=1))
    covariance, variance = [], []
    for mode, a, b in zip(modes, ahead, back[::-1]):
        log = mode.gain / GAIN + a + b
        p = np.exp(log - log.max())
        p /= p.sum()
        turn, off = mode.angles - mode.angles[0], mode.ends_m - mode.ends_m[0]
        covariance.append(np.einsum("k,ka,kb->ab", p, turn, turn))
        variance.append(np.einsum("k,kei->e", p, off**2) / 3)
    return Elsewhere(limb=limb, covariance=np.array(covariance), variance_m2=np.array(variance))


def of_joints(limbs: Sequence[Elsewhere], skeleton: Skeleton, frames: int) -> np.ndarray:
    """The variances (T, J) [m²] of a coordinate of all joints; what a limb carries moves with its end."""
    variance = np.zeros((frames, len(skeleton.joint_names)))
    for one in limbs:
        for b in one.limb.outer.tolist():
            end = np.flatnonzero(one.limb.bones == b)
            variance[:, skeleton.joint_names.index(skeleton.bones[b].tail_joint)] += one.variance_m2[:, end[0] if len(end) else -1]
    return variance


def _jump(limb: Limb, a: LimbModes, b: LimbModes, step_s: float) -> np.ndarray:
    """m (K, L) between the poses of two frames."""
    return np.minimum(unlikely(limb, b.ends_m[None] - a.ends_m[:, None], step_s), LARGEST_JUMP)
