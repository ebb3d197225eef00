"""The sigmas of joints in two parts, what is common to all frames and what is not, and whether a joint was seen, inferred or guessed.

A body differs from its metaballs, and this error is the same whenever the posture is: a Gaussian process over postures (Rasmussen &
Williams 2006, §4.2) with the variance s̄² that the normal equations give in the median frame. What they give beyond that is the frame's own:

    common² = s̄² mean_rs ρ(r, s) + place²                                                                     (1)
    frame_t² = min(s_t², s̄²) (1 − 2 mean_s ρ(t, s) + mean_rs ρ(r, s)) + max(0, s_t² − s̄²) + elsewhere_t² + CLOTH_M²            (2)
    ρ(t, s) = exp(−½ Σ_b α_b(t, s)² / TURN²)                                                                  (3)

α_b is the angle by which bone b, of those that meet in the joint, is turned between two frames; `place` the sigma of where the joint lies
in the flesh (`joint_places`); `elsewhere` what the limb's other places add (`limb_modes`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...body.motion import GUESSED, INFERRED, SEEN
from ...body.skeleton import Skeleton, bone_frames

TURN = float(np.radians(20.0))
CLOTH_M = 0.0007  # what a posture does not repeat
FRAMES = 100  # evenly over the recording, that stand for all
SEEN_M, GUESSED_M = 0.025, 0.05  # frame sigmas of a coordinate: up to where a joint is seen, and beyond which it is guessed


@dataclass(frozen=True, eq=False, kw_only=True)
class SigmaParts:
    """The sigmas of J joints [m]."""

    common_m: np.ndarray  # (J,)
    frame_m: np.ndarray  # (T, J)

    @property
    def total_m(self) -> np.ndarray:
        """(T, J)"""
        return np.sqrt(self.common_m**2 + self.frame_m**2)


def sigma_parts(
    skeleton: Skeleton,
    lengths_m: np.ndarray,
    motion: np.ndarray,
    sigma_m: np.ndarray,
    elsewhere_m2: np.ndarray,
    place_m: np.ndarray,
) -> SigmaParts:
    """(1) and (2) of a motion (T, D) with the sigmas (T, J) of the normal equations, the variances (T, J) of limbs elsewhere and the
    sigmas of the joints' places (J,)."""
    usual = np.median(sigma_m, axis=0) ** 2
    model = np.minimum(sigma_m**2, usual)
    R = bone_frames(skeleton, lengths_m, motion)[0]
    some = np.unique(np.linspace(0, len(motion) - 1, min(FRAMES, len(motion))).round().astype(int))
    common, own = np.empty(len(usual)), np.empty_like(sigma_m)
    for j, joint in enumerate(skeleton.joint_names):
        with_some = _same(R, R[some], _meeting(skeleton, joint)).mean(axis=1)
        among = float(with_some[some].mean())
        common[j] = usual[j] * among
        own[:, j] = model[:, j] * np.maximum(1 - 2 * with_some + among, 0.0)
    frame = own + sigma_m**2 - model + elsewhere_m2 + CLOTH_M**2
    return SigmaParts(common_m=np.sqrt(common + place_m**2), frame_m=np.sqrt(frame))


def known(skeleton: Skeleton, observed: np.ndarray, contradicted: np.ndarray, frame_m: np.ndarray) -> tuple[tuple[str, ...], ...]:
    """SEEN, INFERRED or GUESSED of every joint (T, J).

    `observed` (T, B): whether the bones have enough observations of their own, or need none; those of one bone show both of its ends.
    `contradicted` (T, J) by the images.
    """
    evident = np.stack([observed[:, _meeting(skeleton, joint)].any(axis=1) for joint in skeleton.joint_names], axis=1)
    guessed = contradicted | (frame_m > GUESSED_M)
    words = np.where(guessed, GUESSED, np.where(evident & (frame_m <= SEEN_M), SEEN, INFERRED))
    return tuple(tuple(row) for row in words.tolist())


def _meeting(skeleton: Skeleton, joint: str) -> list[int]:
    """The bones that begin or end at a joint."""
    return [b for b, bone in enumerate(skeleton.bones) if joint in (bone.head_joint, bone.tail_joint)]


def _same(R: np.ndarray, others: np.ndarray, bones: Sequence[int]) -> np.ndarray:
    """ρ (T, N) of frames with bones' axes (T, B, 3, 3) and (N, B, 3, 3).  (3)"""
    squares = np.zeros((len(R), len(others)))
    for b in bones:
        trace = R[:, b].reshape(len(R), 9) @ others[:, b].reshape(len(others), 9).T
        squares += np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0)) ** 2
    return np.asarray(np.exp(-0.5 * squares / TURN**2))
