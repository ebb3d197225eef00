"""Radii of the balls of a chain of stout bones (the trunk), adjusted together so that their summed field has a smooth outline.

Radii computed bone by bone (metaballs.three_balls) leave ledges at the trunk's joints, because its balls reach far into the next bone.
Here the visible radii are joined along the whole chain, and the cross radii l of all its balls are adjusted to that outline together:

    √(−½ ln F(X)) − √(½ ln 2) = 0 at points X of the outline,   ln l = its value bone by bone ± `FREE`
"""

from dataclasses import dataclass, replace

import numpy as np

from .metaballs import VISIBLE, Metaballs, field_and_derivatives
from .skeleton import Skeleton, bone_frames

SAMPLES = 10  # of the outline, per bone
FREE = 0.5  # sigma of the prior on ln l
TOLERANCE = 0.02  # sigma of the equations
STEPS = 25  # Gauss-Newton iterations
LARGEST_STEP = 0.2  # of ln l
LEAST_F = 1e-6  # bounds of F, so that its logarithm …
MOST_F = 0.99
LEAST_ROOT_SQUARED = 0.03  # … and the derivative of the root stay finite
STOUT = 0.4  # mean radius over length: bones above it belong to the trunk
PARALLEL = 0.98  # least cosine between consecutive bones of one chain


def stout_chain(skeleton: Skeleton, lengths_m: np.ndarray, visible_radii_m: np.ndarray) -> list[int]:
    """The first bone and those that continue it in its direction, as long as they are stout; `visible_radii_m` (B, 3, 2)."""
    chain, stout = [0], visible_radii_m.mean(axis=(1, 2)) / lengths_m > STOUT  # False where there are no balls (NaN)
    for b in range(1, len(skeleton.bones)):
        direction = skeleton.bones[b].R_rest[:, 1] @ skeleton.bones[chain[-1]].R_rest[:, 1]
        if skeleton.parents[b] == chain[-1] and skeleton.starts_at_tail[b] and stout[b] and direction > PARALLEL:
            chain.append(b)
    return chain if stout[0] and len(chain) > 1 else []


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FieldSamples:
    """Values that the field shall have: √(−½ ln F) is `root` (N,) at points xyz_m (N, 3), with weights (N,)."""

    xyz_m: np.ndarray
    active: np.ndarray  # (N, M) the balls that count at each point, as in `metaballs.field`
    root: np.ndarray
    weight: np.ndarray


def smoothed(
    balls: Metaballs, skeleton: Skeleton, lengths_m: np.ndarray, chain: list[int], visible_radii_m: np.ndarray, stations: np.ndarray
) -> Metaballs:
    """The balls with the cross radii of the chain's balls adjusted to its outline. Arguments of all bones, as in `BodyModel`."""
    R, head = bone_frames(skeleton, lengths_m, np.zeros(len(skeleton.dofs)))
    X, bone = _outline(R, head, lengths_m, chain, visible_radii_m, stations)
    mine = np.flatnonzero(np.isin(balls.bone_index, chain))
    active = skeleton.neighbours[bone][:, balls.bone_index] & np.isin(balls.bone_index, chain)
    samples = FieldSamples(xyz_m=X, active=active, root=np.full(len(X), VISIBLE), weight=np.ones(len(X)))
    return with_radii_for(balls, mine, lengths_m, R, head, samples)


def with_radii_for(
    balls: Metaballs,
    mine: np.ndarray,
    lengths_m: np.ndarray,
    R: np.ndarray,
    head: np.ndarray,
    samples: FieldSamples,
    free: float = FREE,
) -> Metaballs:
    """The balls with the cross radii of `mine` (K,) such that their field agrees with the samples.

    ln l keeps its value ± `free`; Gauss-Newton steps are limited to LARGEST_STEP.
    """
    root, weight = samples.root, samples.weight
    start = np.log(balls.radii_m[mine][:, [0, 2]])
    x, prior = start.copy(), (weight.sum() / start.size) * (TOLERANCE / free) ** 2
    for _ in range(STEPS):
        radii = balls.radii_m.copy()
        radii[np.ix_(mine, np.array([0, 2]))] = np.exp(x)
        balls = replace(balls, radii_m=radii)
        F, _, dF, _ = field_and_derivatives(balls, lengths_m, R, head, samples.xyz_m, samples.active)
        F = np.maximum(F, LEAST_F)
        found = root_of(F)
        J = (-0.25 / (F * found))[:, None] * dF[:, mine][..., [0, 2]].reshape(len(F), -1)
        N = (J.T * weight) @ J + np.eye(x.size) * prior
        g = J.T @ (weight * (found - root)) + prior * (x - start).ravel()
        x = x - np.clip(np.linalg.solve(N, g), -LARGEST_STEP, LARGEST_STEP).reshape(x.shape)
    return balls


def root_of(F: np.ndarray) -> np.ndarray:
    """√(−½ ln F): the distance from the axis over l, of one ball; bounded where the field is near 1, inside the body."""
    return np.asarray(np.sqrt(np.maximum(-0.5 * np.log(np.minimum(F, MOST_F)), LEAST_ROOT_SQUARED)))


def _outline(
    R: np.ndarray, head: np.ndarray, lengths_m: np.ndarray, chain: list[int], visible_radii_m: np.ndarray, stations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of the outline in the rest pose, in front, behind and at the sides, and their bones (N,)."""
    axis, base = R[chain[0]][:, 1], head[chain[0]]
    first = [(head[b] - base) @ axis for b in chain]
    known = np.concatenate([f + stations[b] * lengths_m[b] for f, b in zip(first, chain)])
    order = np.argsort(known)
    radii = np.concatenate([visible_radii_m[b] for b in chain])[order]
    points, bones = [], []
    for f, b in zip(first, chain):
        low = min(0.0, stations[b, 0]) if b == chain[0] else 0.0
        along = f + lengths_m[b] * np.linspace(low, 1.0 if b != chain[-1] else stations[b, 2], SAMPLES)
        for column, side in ((0, R[b][:, 0]), (1, R[b][:, 2])):
            radius = np.interp(along, known[order], radii[:, column])
            points.append(base + along[:, None] * axis + radius[:, None] * side)
            bones.append(np.full(SAMPLES, b))
    return np.concatenate(points), np.concatenate(bones)
