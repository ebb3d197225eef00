"""From clicked joints to a pose and bone lengths: the trunk as a rigid body, a coarse search outwards along the limbs, then least squares
in the images.
"""

from dataclasses import replace
from itertools import product

import numpy as np

from ...body.skeleton import Skeleton, joint_positions
from ...body.trunk import LEAST_TRUNK_JOINTS, trunk_joints
from ..inputs.clicks import Clicks
from ..observations import JointLimits, Observation, PosePrior, Proportions
from ..observations.shape_priors import STATURE_SIGMA
from ..solve.problem import Estimate, Problem
from ..solve.solver import Solution, solve
from ..state import FIRM_PRIOR, ShapeParameters

GRID_STEP = np.radians(25.0)  # of the coarse search
FREE_SPAN = np.pi  # search range of a DOF without limits
STEPS = 40
BASE_SIGMA_M = 10.0
SMALL_ANGLES = 1e-3  # the weight of angles in the coarse search: of poses that fit alike, the one nearest to rest
CORRELATION_S = 0.5  # poses closer in time are about the same
ENOUGH_BONES = 4  # between clicks, for a stature
OWN_SIGMA = 0.10  # of a clicked bone about its person's proportions
ANYONES_SIGMA = 0.15  # of a person, a child or a giant, about the model
CLICKED_STATURE_SIGMA = 0.02  # some sixteen lengths of about 8 % each


def inverse_kinematics(parameters: ShapeParameters, clicks: Clicks, priors: list[Observation], lengths: Proportions) -> Solution:
    """Pose (1, D) and shape vector at the click frame. `priors`: limits and priors of the DOFs.

    Bone lengths are free within their prior, radii are fixed.
    """
    vector = parameters.vector()
    start = coarse_pose(parameters, clicks)
    problem = Problem(
        parameters=parameters,
        observe=lambda t, state: [*clicks.observations, *priors],
        shape_observations=[lengths],
        free_shape=parameters.layout.group("lengths"),
        fixed=parameters.skeleton.locked,
    )
    return solve(problem, Estimate(motion=start[None], vector=vector), steps=STEPS)


def clicked_stature(parameters: ShapeParameters, clicks: Clicks, priors: list[Observation]) -> tuple[float, float]:
    """The person's stature over that of the parameters' template, and its relative sigma.

    It is that of the lengths that explain the clicks together with a pose. With a short base, clicks scatter along the view by many
    centimetres, which makes the distance between any two of them longer than it is; the pose absorbs that.

    With few clicked bones the stature is less precise than their own lengths: then 1.
    """
    skeleton, place = parameters.skeleton, dict(zip(parameters.skeleton.joint_names, clicks.xyz_m))
    clicked = [bone for bone in skeleton.bones if np.isfinite([place[bone.head_joint], place[bone.tail_joint]]).all()]
    if len(clicked) < ENOUGH_BONES:
        return 1.0, STATURE_SIGMA
    lengths = np.log(parameters.template.lengths_m)
    covariance = ANYONES_SIGMA**2 + OWN_SIGMA**2 * np.eye(len(lengths))
    found = inverse_kinematics(parameters, clicks, priors, Proportions(mean=lengths, covariance=covariance))
    return float(np.exp(np.mean(found.vector[parameters.layout.group("lengths")] - lengths))), CLICKED_STATURE_SIGMA


def coarse_pose(parameters: ShapeParameters, clicks: Clicks) -> np.ndarray:
    """A pose (D,) near the located joints: the trunk rotated as a whole, then for limb after limb the best on a grid of the DOFs that move
    its tail."""
    skeleton, lengths = parameters.skeleton, parameters.template.lengths_m
    motion = np.array([np.clip(0.0, *dof.limits) for dof in skeleton.dofs])
    names, trunk = list(skeleton.joint_names), trunk_joints(skeleton)
    placed = [names.index(j) for j in trunk if clicks.located[names.index(j)]]
    turned = len(placed) >= LEAST_TRUNK_JOINTS
    if turned:
        _turn_trunk(skeleton, lengths, clicks.xyz_m, placed, motion)
    placed = placed if turned else np.flatnonzero(clicks.located)[:1].tolist()
    _shift(skeleton, lengths, clicks.xyz_m, placed, motion)
    return _towards(skeleton, lengths, clicks.xyz_m, motion, trunk if turned else [], placed)


def pose_as_clicked(parameters: ShapeParameters, xyz_m: np.ndarray, motion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """The pose (D,) in which limbs lead to where their joints (J, 3; NaN: not located) were clicked; else as in the pose `motion` (D,) of a
    shape `vector`."""
    skeleton = parameters.skeleton
    return _towards(skeleton, parameters.state(motion, vector).lengths_m, xyz_m, motion, trunk_joints(skeleton), [])


def _towards(
    skeleton: Skeleton,
    lengths: np.ndarray,
    xyz_m: np.ndarray,
    motion: np.ndarray,
    trunk: list[str],
    placed: list[int],
) -> np.ndarray:
    """Limb after limb the best on a grid of the DOFs that move its tail towards its place (J, 3); the base brings the joints `placed` to
    theirs."""
    names, located = list(skeleton.joint_names), np.isfinite(xyz_m).all(axis=1)
    for b, bone in enumerate(skeleton.bones):
        target = xyz_m[names.index(bone.tail_joint)]
        dofs = _movers(skeleton, b)
        if not np.isfinite(target).all() or not len(dofs) or bone.tail_joint in trunk:
            continue
        grid = np.array(list(product(*(_values(skeleton, d) for d in dofs))))
        trial = np.repeat(motion[None], len(grid), axis=0)
        trial[:, dofs] = grid
        places = joint_positions(skeleton, lengths, trial)
        head = places[bone.head_joint]
        wanted = target - (xyz_m[names.index(bone.head_joint)] if located[names.index(bone.head_joint)] else head)
        angle = _angle(places[bone.tail_joint] - head, wanted)
        motion = trial[np.argmin(angle + SMALL_ANGLES * np.abs(grid).sum(axis=1))]
        if placed:
            _shift(skeleton, lengths, xyz_m, placed, motion)
    return motion


def _shift(skeleton: Skeleton, lengths: np.ndarray, xyz_m: np.ndarray, placed: list[int], motion: np.ndarray) -> None:
    """Bring the middle of the joints `placed` to its place, by the base."""
    places = np.stack(list(joint_positions(skeleton, lengths, motion).values()))
    motion[skeleton.layout.group("base")] += (xyz_m[placed] - places[placed]).mean(axis=0)


def _turn_trunk(skeleton: Skeleton, lengths: np.ndarray, xyz_m: np.ndarray, placed: list[int], motion: np.ndarray) -> None:
    """Rotate the first bone so that the trunk's joints fit best (Kabsch 1976)."""
    from scipy.spatial.transform import Rotation

    rest = np.stack(list(joint_positions(skeleton, lengths, np.zeros(len(motion))).values()))[placed]
    found = xyz_m[placed]
    U, _, Vt = np.linalg.svd((found - found.mean(axis=0)).T @ (rest - rest.mean(axis=0)))
    turn = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    bone, R = skeleton.bones[0], skeleton.bones[0].R_rest
    order = bone.rotation_mode[::-1]
    angles = dict(zip(order.lower(), Rotation.from_matrix(R.T @ turn @ R).as_euler(order)))
    for dof in bone.dofs:
        motion[skeleton.layout[dof.name]] = np.clip(angles[dof.axis], *dof.limits)


def other_poses(parameters: ShapeParameters, clicks: Clicks, motion: np.ndarray) -> list[np.ndarray]:
    """Further starts for bones whose tail was not clicked: a coarse grid of the DOFs that move it, the others as in `motion` (D,).

    There are none for bones with a firm prior.
    """
    skeleton, starts = parameters.skeleton, []
    trunk = trunk_joints(skeleton)
    turned = sum(clicks.located[skeleton.joint_names.index(j)] for j in trunk) >= LEAST_TRUNK_JOINTS
    for b, bone in enumerate(skeleton.bones):
        dofs = _movers(skeleton, b)
        firm = all(dof.prior_sigma <= FIRM_PRIOR for dof in bone.dofs)
        if clicks.located[skeleton.joint_names.index(bone.tail_joint)] or firm or (turned and bone.tail_joint in trunk):
            continue
        for values in product(*(_values(skeleton, d)[1::2] for d in dofs)):
            start = motion.copy()
            start[dofs] = values
            starts.append(start)
    return starts


def dof_priors(skeleton: Skeleton, limit_sigma: float, about_m: np.ndarray) -> list[Observation]:
    """Soft limits, and the model's priors of the DOFs; where it has none, a sigma of 180° or `BASE_SIGMA_M` makes the equations regular."""
    low, high = np.array([dof.limits for dof in skeleton.dofs]).T
    mean, sigma = np.array([(dof.prior_mean, dof.prior_sigma) for dof in skeleton.dofs]).T
    base = skeleton.layout.group("base")
    free = ~np.isfinite(sigma)
    mean[free] = np.clip(0.0, low, high)[free]
    sigma[free] = np.pi
    mean[base], sigma[base] = about_m, BASE_SIGMA_M
    return [JointLimits(low=low, high=high, sigma=limit_sigma), PosePrior(mean=mean, sigma=sigma)]


def shared_over_time(priors: list[Observation], time_s: np.ndarray) -> list[Observation]:
    """The priors of one frame for every frame of a sequence: poses within `CORRELATION_S` are correlated, so their frames share one prior.

    Not so firm priors: they concern what is hardly measured, and compete with the model's error, which is the same in all frames.
    """
    step = float(np.median(np.diff(time_s))) if len(time_s) > 1 else CORRELATION_S
    frames = min(max(1.0, CORRELATION_S / step), float(len(time_s)))
    return [_inflated(p, frames) if isinstance(p, PosePrior) else p for p in priors]


def _inflated(prior: PosePrior, frames: float) -> PosePrior:
    """The prior of one of so many frames that share it; a firm one stays."""
    return replace(prior, sigma=np.where(prior.sigma <= FIRM_PRIOR, prior.sigma, prior.sigma * np.sqrt(frames)))


def _movers(skeleton: Skeleton, bone: int) -> np.ndarray:
    """DOFs that move a bone's tail but not its head: its own across the bone, and its parent's twist."""
    n = len(skeleton.base_dofs)
    return np.array(
        [
            i
            for i, dof in enumerate(skeleton.dofs[n:], n)
            if (skeleton.dof_bone[i] == bone and dof.axis != "y") or (skeleton.dof_bone[i] == skeleton.parents[bone] and dof.axis == "y")
        ],
        dtype=np.intp,
    )


def _values(skeleton: Skeleton, dof: int) -> np.ndarray:
    low, high = skeleton.dofs[dof].limits
    low, high = max(low, -FREE_SPAN), min(high, FREE_SPAN)
    return np.linspace(low, high, max(2, int(np.ceil((high - low) / GRID_STEP)) + 1))


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine = (a * b).sum(-1) / np.maximum(np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1), 1e-12)
    return np.arccos(np.clip(cosine, -1, 1))
