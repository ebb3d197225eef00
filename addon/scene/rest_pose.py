"""Another rest pose for the armature: arms level (T) instead of 45° down (A).

A bone with three angles can take up any turn of its rest frame R_0 → Q R_0, for then

    Euler' = (Rest_rel')ᵀ · M_parentᵀ · M                                                                 (1)

has the three angles again; everything that descends from it turns along and keeps its channels. The pose, the metaballs and the skin are
the same; only those three channels, relative to another rest pose, differ from the values in motion.csv.
"""

import dataclasses

import numpy as np
from mathutils import Matrix

from ...core.body.shape import BodyShape
from ...core.body.skeleton import Dof, bone_frames, frames_and_axes
from ...core.body.skin.rays import swing

POSES = ("A", "T")
REST_POSE_KEY = "tricap_rest_pose"  # custom property of armature data
T_POSE_ARM = {".R": np.array([-1.0, 0.0, 0.0]), ".L": np.array([1.0, 0.0, 0.0])}
ARM = "upper_arm"


def with_rest_pose(shape: BodyShape, values: np.ndarray, sigma: np.ndarray, pose: str) -> tuple[BodyShape, np.ndarray, np.ndarray]:
    """The same person and motion (T, D), with sigmas (T, D), relative to the rest pose `pose` of POSES. "A" is the model's own."""
    skeleton = shape.skeleton
    turned = [b for b, bone in enumerate(skeleton.bones) if pose == "T" and bone.name[:-2] == ARM and len(bone.dofs) == 3]
    if not turned:
        return shape, values, sigma
    turn = [np.eye(3)] * len(skeleton.bones)
    for b, parent in enumerate(skeleton.parents):
        rest = skeleton.bones[b].R_rest
        turn[b] = swing(rest[:, 1], T_POSE_ARM[skeleton.bones[b].name[-2:]]) if b in turned else turn[parent] if parent >= 0 else np.eye(3)
    bones = tuple(
        dataclasses.replace(bone, R_rest=Q @ bone.R_rest, dofs=tuple(map(_unlimited, bone.dofs)) if b in turned else bone.dofs)
        for b, (bone, Q) in enumerate(zip(skeleton.bones, turn))
    )
    other = dataclasses.replace(shape, skeleton=dataclasses.replace(skeleton, bones=bones))
    known = np.isfinite(values).all(axis=1)
    new_values, new_sigma = values.copy(), sigma.copy()
    new_values[known] = _relative_to(shape, other, values[known], turned)
    new_sigma[known] = _propagated_sigma(shape, other, values[known], new_values[known], sigma[known], turned)
    return other, new_values, new_sigma


def _relative_to(shape: BodyShape, other: BodyShape, values: np.ndarray, turned: list[int]) -> np.ndarray:
    R, _ = bone_frames(shape.skeleton, shape.lengths_m, values)
    new = values.copy()
    for b in turned:
        bone, parent = other.skeleton.bones[b], shape.skeleton.parents[b]
        before = R[:, parent] @ other.skeleton.bones[parent].R_rest.T if parent >= 0 else np.broadcast_to(np.eye(3), (len(R), 3, 3))
        euler = np.swapaxes(before @ bone.R_rest, 1, 2) @ R[:, b]  # (1)
        columns = _columns(shape, b)
        previous = None
        for t, matrix in enumerate(euler):
            arguments = (bone.rotation_mode,) if previous is None else (bone.rotation_mode, previous)
            previous = Matrix(matrix).to_euler(*arguments)
            new[t, columns] = [previous["xyz".index(dof.axis)] for dof in bone.dofs]
    return new


def _propagated_sigma(
    shape: BodyShape, other: BodyShape, values: np.ndarray, new: np.ndarray, sigma: np.ndarray, turned: list[int]
) -> np.ndarray:
    """Both sets of angles rotate the same bone: A θ̇ = A' θ̇' with the axes A in the world, so θ̇' = A'⁻¹ A θ̇."""
    before, after = (frames_and_axes(s.skeleton, s.lengths_m, v)[2] for s, v in ((shape, values), (other, new)))
    carried = sigma.copy()
    for b in turned:
        columns = _columns(shape, b)
        A, B = (np.swapaxes(axes[:, columns], 1, 2) for axes in (before, after))
        J = np.linalg.pinv(B) @ A
        carried[:, columns] = np.sqrt(np.einsum("tij,tj->ti", J**2, sigma[:, columns] ** 2))
    return carried


def _unlimited(dof: Dof) -> Dof:
    """Remove the limits: they are relative to the model's own rest pose."""
    return dataclasses.replace(dof, limits=(-np.inf, np.inf))


def _columns(shape: BodyShape, b: int) -> np.ndarray:
    n = len(shape.skeleton.base_dofs)
    return np.flatnonzero((shape.skeleton.dof_bone == b) & (np.arange(len(shape.skeleton.dofs)) >= n))
