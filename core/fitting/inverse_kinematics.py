"""From clicked joints to a posture and bone lengths: a coarse search outwards along the skeleton, then least squares in the images."""

from itertools import product

import numpy as np

from ..body.skeleton import Skeleton, joint_positions
from .clicks import Clicks
from .observations import JointLimits, MotionPrior, Observation, ShapePrior
from .solver import Problem, Solution, solve
from .state import ShapeParameters

GRID_STEP = np.radians(25.0)
FREE_SPAN = np.pi  # search range of a DOF without limits
STEPS = 40


def inverse_kinematics(parameters: ShapeParameters, clicks: Clicks, priors: list[Observation], length_sigma: float) -> Solution:
    """Motion (1, D) and shape vector at the click frame. `priors`: limits and beliefs about the DOFs.

    Bone lengths are free (relative sigma `length_sigma` about the model's), radii are not.
    """
    vector = parameters.vector()
    start = coarse_posture(parameters, clicks)
    sigma = np.full(len(vector), length_sigma)
    problem = Problem(parameters=parameters, observe=lambda t, state: [clicks.observation, *priors],
                      of_shape=[ShapePrior(mean=vector, sigma=sigma)], free_shape=parameters.layout.set("lengths"))
    return solve(problem, start[None], vector, steps=STEPS)


def coarse_posture(parameters: ShapeParameters, clicks: Clicks) -> np.ndarray:
    """A motion vector (D,) near the located joints: for bone after bone the best on a grid of the DOFs that move its tail."""
    skeleton, lengths = parameters.skeleton, parameters.template.lengths_m
    motion = np.array([np.clip(0.0, *dof.limits) for dof in skeleton.dofs])
    names = list(skeleton.joint_names)
    known = np.flatnonzero(clicks.located)
    first = names[known[0]]
    base = skeleton.layout.set("base")
    for b, bone in enumerate(skeleton.bones):
        motion[base] += clicks.xyz_m[known[0]] - joint_positions(skeleton, lengths, motion)[first]
        target = clicks.xyz_m[names.index(bone.tail_joint)]
        dofs = _movers(skeleton, b)
        if not np.isfinite(target).all() or not len(dofs):
            continue
        grid = np.array(list(product(*(_values(skeleton, d) for d in dofs))))
        trial = np.repeat(motion[None], len(grid), axis=0)
        trial[:, dofs] = grid
        places = joint_positions(skeleton, lengths, trial)
        head = places[bone.head_joint]
        wanted = target - (clicks.xyz_m[names.index(bone.head_joint)] if clicks.located[names.index(bone.head_joint)] else head)
        angle = _angle(places[bone.tail_joint] - head, wanted)
        motion = trial[np.argmin(angle + 1e-3 * np.abs(grid).sum(axis=1))]
    motion[base] += clicks.xyz_m[known[0]] - joint_positions(skeleton, lengths, motion)[first]
    return motion


def other_postures(parameters: ShapeParameters, clicks: Clicks, motion: np.ndarray) -> list[np.ndarray]:
    """Further starts for bones whose tail nobody clicked: a coarse grid of the DOFs that move it, the others as in `motion` (D,)."""
    skeleton, starts = parameters.skeleton, []
    for b, bone in enumerate(skeleton.bones):
        dofs = _movers(skeleton, b)
        if clicks.located[skeleton.joint_names.index(bone.tail_joint)] or not len(dofs):
            continue
        for values in product(*(_values(skeleton, d)[1::2] for d in dofs)):
            start = motion.copy()
            start[dofs] = values
            starts.append(start)
    return starts


def dof_priors(skeleton: Skeleton, limit_sigma: float, about_m: np.ndarray) -> list[Observation]:
    """Soft limits, and the model's beliefs about DOFs; where it has none, a sigma of 180° or 10 m keeps the equations regular."""
    low, high = np.array([dof.limits for dof in skeleton.dofs]).T
    mean, sigma = np.array([(dof.prior_mean, dof.prior_sigma) for dof in skeleton.dofs]).T
    base = skeleton.layout.set("base")
    free = ~np.isfinite(sigma)
    mean[free] = np.clip(0.0, low, high)[free]
    sigma[free] = np.pi
    mean[base], sigma[base] = about_m, 10.0
    return [JointLimits(low=low, high=high, sigma=limit_sigma), MotionPrior(mean=mean, sigma=sigma)]


def _movers(skeleton: Skeleton, bone: int) -> np.ndarray:
    """DOFs that move a bone's tail but not its head: its own across the bone, and its parent's twist."""
    n = len(skeleton.base_dofs)
    return np.array([i for i, dof in enumerate(skeleton.dofs[n:], n)
                     if (skeleton.dof_bone[i] == bone and dof.axis != "y")
                     or (skeleton.dof_bone[i] == skeleton.parents[bone] and dof.axis == "y")], dtype=np.intp)


def _values(skeleton: Skeleton, dof: int) -> np.ndarray:
    low, high = skeleton.dofs[dof].limits
    low, high = max(low, -FREE_SPAN), min(high, FREE_SPAN)
    return np.linspace(low, high, max(2, int(np.ceil((high - low) / GRID_STEP)) + 1))


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine = (a * b).sum(-1) / np.maximum(np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1), 1e-12)
    return np.arccos(np.clip(cosine, -1, 1))
