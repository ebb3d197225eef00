"""The pose of a body whose joint is dragged: inverse kinematics by damped least squares, from the fitted pose, in milliseconds.

    |X(θ) − x|² / PLACE_SIGMA_M² + Σ (θ − θ₀)² / σ² → min ,   within the limits of the joints                                    (1)

θ₀ is the fitted pose and x the place to which the joint is dragged. The limb of the joint moves, or, with a joint of the trunk, trunk and
base, which carry all limbs: what *Fit Again* moves. σ is `TURN_SIGMA` of angles and `BASE_SIGMA_M` of the base; they divide a movement
between the joints that can make it.
"""

from collections.abc import Callable

import numpy as np

from ..limb import Limb, whole_limbs
from ..state import ShapeParameters
from .fit_again import limbs_with
from .joint_places import BASE_SIGMA_M, TURN_SIGMA

PLACE_SIGMA_M = 1e-4
STEPS = 40
MISSED_M = 1e-3  # further from its place, the search begins again with the limb bent a little: a straight one has no direction to bend to
BENT = float(np.radians(5.0))
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e6  # of the diagonal; at the most no step makes it better
ENOUGH = 1e-6  # a smaller relative gain ends the search


def moved_by_pull(parameters: ShapeParameters, joint: str) -> tuple[np.ndarray, np.ndarray]:
    """The DOFs (C,) that move when a joint is dragged, and the bones (K,) that move with them."""
    skeleton = parameters.skeleton
    limbs = limbs_with(parameters, [joint])
    if limbs:
        return limbs[0].columns, _carried(parameters, limbs[0])
    of_limbs = [limb.columns for limb in whole_limbs(parameters)]
    rest = np.setdiff1d(np.arange(len(skeleton.dofs)), np.concatenate([*of_limbs, skeleton.locked]))
    return rest.astype(np.intp), np.arange(len(skeleton.bones))


def _carried(parameters: ShapeParameters, limb: Limb) -> np.ndarray:
    """The bones that the DOFs of a limb move: the limb, and the bone before it, if that turns about itself."""
    return np.flatnonzero(parameters.skeleton.moved_by[:, limb.columns].any(axis=1))


def pulled_pose(parameters: ShapeParameters, pose: np.ndarray, joint: str, xyz_m: np.ndarray) -> np.ndarray:
    """The pose (D,) nearest to `pose` (D,) in which a joint of the body is at a place (3,) [m], or as near as its limb reaches.  (1)"""
    skeleton, vector, row = parameters.skeleton, parameters.vector(), parameters.skeleton.joint_names.index(joint)
    columns, _ = moved_by_pull(parameters, joint)
    low, high = np.array([skeleton.dofs[c].limits for c in columns]).reshape(-1, 2).T
    low, high = np.minimum(low, pose[columns]), np.maximum(high, pose[columns])  # a measured pose may exceed them
    sigma = np.where(np.isin(columns, skeleton.layout.group("base")), BASE_SIGMA_M, TURN_SIGMA)

    def equations(at: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        whole = pose.copy()
        whole[columns] = at
        X, dX = parameters.state(whole, vector).joint_jacobian
        r = np.concatenate([(X[row] - xyz_m) / PLACE_SIGMA_M, (at - pose[columns]) / sigma])
        J = np.concatenate([dX[row][:, columns] / PLACE_SIGMA_M, np.diag(1 / sigma)])
        return float(r @ r), J.T @ J, J.T @ r

    cost, at = _least(equations, pose[columns], low, high)
    if cost > (MISSED_M / PLACE_SIGMA_M) ** 2:
        cost, at = min((cost, at), _least(equations, _towards_middle(pose[columns], low, high), low, high), key=lambda found: found[0])
    found = pose.copy()
    found[columns] = at
    return found


Equations = Callable[[np.ndarray], tuple[float, np.ndarray, np.ndarray]]  # cost, normal matrix (C, C) and gradient (C,) at angles (C,)


def _least(equations: Equations, at: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[float, np.ndarray]:
    """The least cost within limits (C,) near some angles (C,), and its angles (Levenberg 1944)."""
    cost, A, g = equations(at)
    damping = DAMPING
    for _ in range(STEPS):
        free = ~(((at <= low) & (g > 0)) | ((at >= high) & (g < 0)))  # a DOF at its limit does not leave it
        if not free.any():
            break
        step, inner = np.zeros(len(at)), A[np.ix_(free, free)]
        step[free] = -np.linalg.solve(inner + damping * np.diag(np.diag(inner)), g[free])
        trial = np.clip(at + step, low, high)
        new = equations(trial)
        if new[0] < cost:
            gain, damping = 1 - new[0] / cost, max(damping / 10, LEAST_DAMPING)
            at, (cost, A, g) = trial, new
            if gain < ENOUGH:
                break
        elif damping > MOST_DAMPING:
            break
        else:
            damping *= 10
    return cost, at


def _towards_middle(at: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Angles (C,) a little towards the middle of their limits; those without limits stay."""
    bounded = np.isfinite(low) & np.isfinite(high)
    middle = np.where(bounded, (np.where(bounded, low, 0.0) + np.where(bounded, high, 0.0)) / 2, at)
    return np.asarray(at + np.clip(middle - at, -BENT, BENT))
