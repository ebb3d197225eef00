"""Radii of balls so that a chain of stout bones has one smooth outline, where the fields of bones that meet are summed.

Solved bone by bone (metaballs.three_balls) the balls of a trunk add up to ledges at its joints, because they reach far into the next bone.
Here the visible radii are joined along the whole chain, and the cross radii l of all its balls are adjusted to that outline together:

    √(−½ ln F(X)) − √(½ ln 2) = 0 at points X of the outline,   ln l = its value bone by bone ± `FREE`
"""

from dataclasses import replace

import numpy as np

from .metaballs import VISIBLE, Metaballs, field_and_derivatives
from .skeleton import Skeleton, bone_frames

SAMPLES = 10  # of the outline, per bone
FREE, TOLERANCE = 0.5, 0.02  # sigmas of ln l and of the equations
STEPS = 25
STOUT, PARALLEL = 0.4, 0.98  # mean radius over length of a bone that is no limb; cosine between bones of one chain


def stout_chain(skeleton: Skeleton, lengths_m: np.ndarray, visible_radii_m: np.ndarray) -> list[int]:
    """The first bone and those that go on from it in its direction, as far as they are stout; `visible_radii_m` (B, 3, 2)."""
    chain, stout = [0], visible_radii_m.mean(axis=(1, 2)) / lengths_m > STOUT  # False where there are no balls (NaN)
    for b in range(1, len(skeleton.bones)):
        direction = skeleton.bones[b].R_rest[:, 1] @ skeleton.bones[chain[-1]].R_rest[:, 1]
        if skeleton.parents[b] == chain[-1] and skeleton.starts_at_tail[b] and stout[b] and direction > PARALLEL:
            chain.append(b)
    return chain if stout[0] and len(chain) > 1 else []


def smoothed(
    balls: Metaballs, skeleton: Skeleton, lengths_m: np.ndarray, chain: list[int], visible_radii_m: np.ndarray, stations: np.ndarray
) -> Metaballs:
    """The balls with the cross radii of the chain's balls adjusted to its outline. Arguments of all bones, as in `BodyModel`."""
    R, head = bone_frames(skeleton, lengths_m, np.zeros(len(skeleton.dofs)))
    X, bone = _outline(R, head, lengths_m, chain, visible_radii_m, stations)
    mine = np.flatnonzero(np.isin(balls.bone_index, chain))
    active = skeleton.neighbours[bone][:, balls.bone_index] & np.isin(balls.bone_index, chain)
    return with_radii_for(balls, mine, lengths_m, R, head, X, active, np.full(len(X), VISIBLE), np.ones(len(X)))


def with_radii_for(
    balls: Metaballs,
    mine: np.ndarray,
    lengths_m: np.ndarray,
    R: np.ndarray,
    head: np.ndarray,
    xyz_m: np.ndarray,
    active: np.ndarray,
    root: np.ndarray,
    weight: np.ndarray,
    free: float = FREE,
) -> Metaballs:
    """The balls with the cross radii of `mine` (K,) such that √(−½ ln F) is `root` (N,) at points (N, 3), with weights (N,).

    `active` (N, M) as in `metaballs.field`. ln l keeps its value ± `free`; Gauss-Newton steps of 0.2 at most.
    """
    start = np.log(balls.radii_m[mine][:, [0, 2]])
    x, held = start.copy(), (weight.sum() / start.size) * (TOLERANCE / free) ** 2
    for _ in range(STEPS):
        radii = balls.radii_m.copy()
        radii[np.ix_(mine, np.array([0, 2]))] = np.exp(x)
        balls = replace(balls, radii_m=radii)
        F, _, dF, _ = field_and_derivatives(balls, lengths_m, R, head, xyz_m, active)
        F = np.maximum(F, 1e-6)
        found = np.sqrt(np.maximum(-0.5 * np.log(np.minimum(F, 0.99)), 0.03))
        J = (-0.25 / (F * found))[:, None] * dF[:, mine][..., [0, 2]].reshape(len(F), -1)
        N = (J.T * weight) @ J + np.eye(x.size) * held
        g = J.T @ (weight * (found - root)) + held * (x - start).ravel()
        x = x - np.clip(np.linalg.solve(N, g), -0.2, 0.2).reshape(x.shape)
    return balls


def _outline(
    R: np.ndarray, head: np.ndarray, lengths_m: np.ndarray, chain: list[int], visible_radii_m: np.ndarray, stations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of the outline in front, behind and at the sides at rest, and their bones (N,)."""
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
