"""The trunk of a skeleton, and from which joints a pose can be begun."""

from collections.abc import Set

import numpy as np

from .skeleton import Skeleton

STIFF = np.radians(65.0)  # a joint that bends less belongs to the trunk
LEAST_TRUNK_JOINTS = 3  # for the rotation of the trunk
LEAST_JOINTS = 2  # for that of a limb


def trunk_joints(skeleton: Skeleton) -> list[str]:
    """The joints of the trunk: those of the first bone and of the bones on it that hardly bend."""
    stiff = [
        not b or max((abs(limit) for dof in bone.dofs for limit in dof.limits), default=0.0) <= STIFF
        for b, bone in enumerate(skeleton.bones)
    ]
    for b, p in enumerate(skeleton.parents):
        stiff[b] = stiff[b] and (p < 0 or stiff[p])
    return list(dict.fromkeys(j for bone, s in zip(skeleton.bones, stiff) if s for j in (bone.head_joint, bone.tail_joint)))


def suffice_for_pose(joints: Set[str], skeleton: Skeleton) -> bool:
    """Whether a pose can be begun from these located joints: three of the trunk, or any two where there is hardly a trunk."""
    trunk = trunk_joints(skeleton)
    if len(trunk) > LEAST_TRUNK_JOINTS:
        return len(joints & {*trunk}) >= LEAST_TRUNK_JOINTS
    return len(joints & {*skeleton.joint_names}) >= LEAST_JOINTS
